"""What the text of exported C shows by itself: no recursion or allocation, loops that end, arrays.

The translator writes each function after those that it calls, and knows one form of loop, ``for``
over a range of integers. That is read here from the text and not taken from the translator, so that
it is checked for the file that is delivered.

The number of passes is an upper bound for a call: that of all loops, in all branches, each with the
most passes that its ends allow. Ends are constants, variables of the loops around, arguments whose
range the call tells, sums and products of them, and the smaller of
such a number and another one.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass, field

_KEYWORDS = frozenset({"if", "for", "while", "switch", "return", "sizeof", "do"})
_FUNCTION = re.compile(r"^(?:[A-Za-z_][\w ]*[ *])(\w+)\(([^;{}]*)\)\n\{\n(.*?)^\}", re.M | re.S)
_LOOP = re.compile(
    r"for \(int (\w+) = ((?:[^;,]|\([^();]*\))+?)(?:, (\w+) = ([^;]+))?; "
    r"\1 (<|>) ([^;]+); \1(\+\+|--| \+= (-?\d+))\) \{"
)
_CALL = re.compile(r"(?<![\w.>])([A-Za-z_]\w*)\(")


Interval = tuple[int | None, int | None]


@dataclass
class Structure:
    """Facts that were read from the text.

    Attributes
    ----------
    library
        functions that are called and not defined: those of the C library.
    passes
        the most passes of loops in a call of each function; None where they depend on data.
    by_data
        places ``line: header`` of loops in a step whose passes depend on data.
    problems
        what is not as claimed.
    """

    library: set[str] = field(default_factory=set)
    passes: dict[str, int | None] = field(default_factory=dict)
    by_data: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def structure(source: str, step: str) -> Structure:
    """Read the text of a C file, whose function of each sample is ``step``."""
    text = re.sub(r"/\*.*?\*/", lambda found: re.sub(r"[^\n]", " ", found[0]), source, flags=re.S)
    found = Structure()
    constants = re.findall(r"^static const int (\w+) = (-?\d+);", text, re.M)
    counter = _Counter(found, {name: (int(value), int(value)) for name, value in constants})
    for each in _FUNCTION.finditer(text):
        line = text.count("\n", 0, each.start(3)) + 1
        given = " ".join(each[2].split())
        names = tuple(re.findall(r"(\w+)(?:\[\w*\])*(?:,|$)", given))
        counter.functions[each[1]] = _Function(each[1], names, each[3], line)
        lengths = {name: [int(size) for size in re.findall(r"\d+", sizes)]
                   for name, sizes in re.findall(r"(\w+)((?:\[\d+\])+)(?:,|$)", given)}  # fmt: skip
        found.problems += counter.outside(counter.functions[each[1]], lengths)
    if step not in counter.functions:
        found.problems.append(f"there is no function {step}")
    seen: set[str] = set()
    for name, function in counter.functions.items():
        called = set(_CALL.findall(function.body)) - _KEYWORDS
        for other in sorted(called & set(counter.functions) - seen):
            rule = "which is defined later: recursion is possible"
            found.problems.append(f"{name} calls {other}, {rule}")
        seen.add(name)
        found.library |= called - set(counter.functions)
        found.problems += function.problems()
    allocating = found.library & {"malloc", "calloc", "realloc", "alloca", "free"}
    found.problems += [f"{each} is called" for each in sorted(allocating)]
    if not found.problems:
        found.passes[step] = counter.passes(step, ())
        found.by_data = list(counter.by_data)
        for name in counter.functions:
            found.passes[name] = counter.passes(name, ())
    return found


class _Function:
    """A function of the file, with its loops and what they span."""

    def __init__(self, name: str, parameters: tuple[str, ...], body: str, line: int) -> None:
        self.name, self.parameters, self.body = name, parameters, body
        self.loops = list(_LOOP.finditer(body))
        self.spans = [(loop.end(), _end_of(body, loop.end())) for loop in self.loops]
        self.lines = [line + body.count("\n", 0, loop.start()) for loop in self.loops]

    def problems(self) -> list[str]:
        """Return what is no loop over a range of integers with an end that stays."""
        found = [
            f"{self.name} has '{word}'" for word in re.findall(r"\b(?:while|do|goto)\b", self.body)
        ]
        if len(self.loops) != len(re.findall(r"\bfor\b", self.body)):
            found.append(f"{self.name} has a loop that is no range of integers")
        for loop, (begin, end), line in zip(self.loops, self.spans, self.lines, strict=True):
            names = {loop[1], *re.findall(r"(?<![\w.>])[A-Za-z_]\w*(?!\w*\()", loop[3] or loop[6])}
            for name in sorted(names):
                change = rf"(?<![\w.>])(?:{name} ?(?:[-+*/]?=[^=]|\+\+|--)|(?:\+\+|--){name}\b)"
                if re.search(change, self.body[begin:end]):
                    found.append(f"{self.name} changes {name} in its loop, line {line}")
            if "->" in (loop[3] or loop[6]):
                found.append(f"{self.name} has a loop whose end may change, line {line}")
        return found


class _Counter:
    """The passes of functions for known ranges of their arguments."""

    def __init__(self, found: Structure, constants: dict[str, tuple[int, int]]) -> None:
        self.found, self.constants = found, constants
        self.functions: dict[str, _Function] = {}
        self.by_data: list[str] = []
        self._known: dict[tuple[str, tuple[Interval, ...]], int | None] = {}

    def passes(self, name: str, arguments: tuple[Interval, ...]) -> int | None:
        """Return the most passes of loops in a call of a function."""
        key = name, arguments
        if key not in self._known:
            self._known[key] = self._count(self.functions[name], arguments)
        return self._known[key]

    def outside(self, function: _Function, lengths: dict[str, list[int]]) -> list[str]:
        """Return the places where an array that is an argument is used beyond its length.

        Eva takes the state for one object, in which an index may run from one array into the next.
        What is checked are indices whose range is known in the function itself.
        """
        ranges: list[dict[str, tuple[int, int]]] = []
        for loop in function.loops:
            known = self._known_at(function, ranges, loop.start())
            first, last = _range(loop[2], known), _range(loop[4] or loop[6], known)
            ranges.append(_values(loop[1], first, last, loop[5]))
        problems, plain = [], _LOOP.sub("", function.body)
        tested = set(re.findall(r"(?<![\w.>])([A-Za-z_]\w*) (?:[<>]=?|[!=]=) ", plain))
        for use in re.finditer(r"(?<![\w.>])(\w+)((?:\[[^\[\]]+\])+)", function.body):
            known = self._known_at(function, ranges, use.start())
            indices = re.findall(r"\[([^\[\]]+)\]", use[2])
            for index, length in zip(indices, lengths.get(use[1], []), strict=False):
                if any(each in tested for each in re.findall(r"[A-Za-z_]\w*", index)):
                    continue  # a condition may narrow its range
                low, high = _range(index, known)
                if (low is not None and low < 0) or (high is not None and high >= length):
                    problems.append(f"{function.name} uses {use[0]}, of {length} entries")
        return problems

    def _known_at(
        self, function: _Function, ranges: list[dict[str, tuple[int, int]]], at: int
    ) -> dict[str, tuple[int, int]]:
        """Return the ranges of constants, and of the variables of the loops around a place."""
        names = dict(self.constants)
        for values, (begin, end) in zip(ranges, function.spans, strict=False):
            names |= values if begin <= at < end else {}
        return names

    def _count(self, function: _Function, arguments: tuple[Interval, ...]) -> int | None:
        given = dict(zip(function.parameters, arguments, strict=False))
        fixed = {name: (low, high) for name, (low, high) in given.items()
                 if low is not None and high is not None}  # fmt: skip
        most: list[int | None] = []
        ranges: list[dict[str, tuple[int, int]]] = []

        def known(at: int) -> dict[str, tuple[int, int]]:
            names = {**self.constants, **fixed}
            for values, (begin, end) in zip(ranges, function.spans, strict=False):
                names |= values if begin <= at < end else {}
            return names

        for loop, line in zip(function.loops, function.lines, strict=True):
            names = known(loop.start())
            first, last = _range(loop[2], names), _range(loop[4] or loop[6], names)
            step = {"++": 1, "--": -1}.get(loop[7]) or int(loop[8])
            most.append(_count(first, last, step, loop[5]))
            ranges.append(_values(loop[1], first, last, loop[5]))
            place = f"{line}: {loop[0].removesuffix(' {')}"
            if most[-1] is None and place not in self.by_data:
                self.by_data.append(place)
        total: int | None = 0
        for own, loop in zip(most, function.loops, strict=True):
            total = _sum(total, _times(own, _product(most, function.spans, loop.start())))
        for call in _CALL.finditer(function.body):
            if call[1] in self.functions:
                parts = _arguments(function.body, call.end())
                values = tuple(_range(part, known(call.start())) for part in parts)
                inner = self.passes(call[1], values)
                if inner != 0:
                    times = _product(most, function.spans, call.start())
                    total = _sum(total, _times(inner, times))
        return total


def _arguments(body: str, begin: int) -> list[str]:
    """Return the arguments of a call, which begin after its parenthesis."""
    found, depth = [""], 0
    for sign in body[begin:]:
        depth += {"(": 1, "[": 1, ")": -1, "]": -1}.get(sign, 0)
        if depth < 0:
            break
        if sign == "," and depth == 0:
            found.append("")
        else:
            found[-1] += sign
    return found


def _product(most: list[int | None], spans: list[tuple[int, int]], at: int) -> int | None:
    """Return how often a place is reached: the product of the passes of the loops around it."""
    product: int | None = 1
    for passes, (begin, end) in zip(most, spans, strict=True):
        if begin <= at < end:
            product = _times(product, passes)
    return product


def _end_of(body: str, begin: int) -> int:
    depth = 1
    for at in range(begin, len(body)):
        depth += {"{": 1, "}": -1}.get(body[at], 0)
        if depth == 0:
            return at
    return len(body)


def _sum(one: int | None, other: int | None) -> int | None:
    return None if one is None or other is None else one + other


def _times(one: int | None, other: int | None) -> int | None:
    return None if one is None or other is None else one * other


def _count(first: Interval, last: Interval, step: int, sign: str) -> int | None:
    ends = (first[0], last[1]) if sign == "<" else (last[0], first[1])
    if ends[0] is None or ends[1] is None or (step > 0) != (sign == "<"):
        return None
    return max(-((ends[0] - ends[1]) // abs(step)), 0)


def _values(name: str, first: Interval, last: Interval, sign: str) -> dict[str, tuple[int, int]]:
    """Return the range of a loop's variable, if it is known."""
    low, high = (first[0], last[1]) if sign == "<" else (last[0], first[1])
    if low is None or high is None:
        return {}
    low, high = (low, high - 1) if sign == "<" else (low + 1, high)
    return {name: (min(low, high), high)}


def _range(code: str, known: dict[str, tuple[int, int]]) -> Interval:
    """Return the least and the largest value of an expression of integers; None if unknown."""
    try:
        tree = ast.parse(code.strip().replace("->", "."), mode="eval").body
    except SyntaxError:
        return None, None
    return _interval(tree, known)


def _interval(node: ast.expr, known: dict[str, tuple[int, int]]) -> Interval:
    if isinstance(node, ast.Constant) and isinstance(node.value, int):
        return node.value, node.value
    if isinstance(node, ast.Name):
        return known.get(node.id, (None, None))
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        low, high = _interval(node.operand, known)
        return None if high is None else -high, None if low is None else -low
    if isinstance(node, ast.BinOp):
        return _operation(node.op, _interval(node.left, known), _interval(node.right, known))
    if isinstance(node, ast.Call) and len(node.args) == 2:
        name, pair = getattr(node.func, "id", ""), [_interval(each, known) for each in node.args]
        lows = [low for low, _ in pair if low is not None]
        highs = [high for _, high in pair if high is not None]
        if name == "minimum_int":
            return min(lows) if len(lows) == 2 else None, min(highs, default=None)
        if name == "maximum_int":
            return max(lows, default=None), max(highs) if len(highs) == 2 else None
    return None, None


def _operation(sign: ast.operator, one: Interval, other: Interval) -> Interval:
    if isinstance(sign, ast.Add):
        return _sum(one[0], other[0]), _sum(one[1], other[1])
    if isinstance(sign, ast.Sub):
        low = None if one[0] is None or other[1] is None else one[0] - other[1]
        return low, None if one[1] is None or other[0] is None else one[1] - other[0]
    if isinstance(sign, ast.Mult) and None not in (*one, *other):
        products = [a * b for a in one for b in other]  # type: ignore[operator]
        return min(products), max(products)
    return None, None
