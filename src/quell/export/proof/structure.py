"""What the text of exported C code shows by itself: no recursion, no allocation, loops that end.

The translator writes each function after those that it calls, and knows one form of loop, ``for``
over a range of integers. That is read here from the text and not taken from the translator, so that
it is checked for the file that is delivered.

The number of passes is an upper bound for a call: that of all loops, in all branches, each with the
most passes that its ends allow. Ends are constants, variables of the loops around, and sums and
products of them, or the smaller of such a number and another one.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass, field

_KEYWORDS = frozenset({"if", "for", "while", "switch", "return", "sizeof", "do"})
_FUNCTION = re.compile(r"^(?:[A-Za-z_][\w ]*[ *])(\w+)\(([^;{}]*)\)\n\{\n(.*?)^\}", re.M | re.S)
_LOOP = re.compile(
    r"for \(int (\w+) = ([^;,]+?)(?:, (\w+) = ([^;]+))?; "
    r"\1 (<|>) ([^;]+); \1(\+\+|--| \+= (-?\d+))\) \{"
)
_CALL = re.compile(r"(?<![\w.>])([A-Za-z_]\w*)\(")


@dataclass
class Structure:
    """What was read from the text.

    Attributes
    ----------
    library
        functions that are called and not defined: those of the C library.
    passes
        the most passes of loops in a call of each function; None where they depend on data.
    by_data
        places ``line: header`` of loops whose passes depend on data.
    problems
        what is not as claimed.
    """

    library: set[str] = field(default_factory=set)
    passes: dict[str, int | None] = field(default_factory=dict)
    by_data: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def structure(source: str) -> Structure:
    """Read the text of a C file."""
    text = re.sub(r"/\*.*?\*/", lambda found: re.sub(r"[^\n]", " ", found[0]), source, flags=re.S)
    found = Structure()
    constants = {
        name: int(value)
        for name, value in re.findall(r"^static const int (\w+) = (-?\d+);", text, re.M)
    }
    functions = list(_FUNCTION.finditer(text))
    every = {each[1] for each in functions}
    for each in functions:
        name, body = each[1], each[3]
        called = set(_CALL.findall(body)) - _KEYWORDS
        for other in sorted(called & every - set(found.passes)):
            found.problems.append(
                f"{name} calls {other}, which is defined later: recursion is possible"
            )
        found.library |= called - every
        line = text.count("\n", 0, each.start(3)) + 1
        found.passes[name] = _passes(name, body, line, constants, found)
    allocating = found.library & {"malloc", "calloc", "realloc", "alloca", "free"}
    found.problems += [f"{each} is called" for each in sorted(allocating)]
    return found


def _passes(
    function: str, body: str, line: int, constants: dict[str, int], found: Structure
) -> int | None:
    """Return the most passes of loops in a call of a function."""
    for word in re.findall(r"\b(?:while|do|goto)\b", body):
        found.problems.append(f"{function} has '{word}'")
    loops = list(_LOOP.finditer(body))
    if len(loops) != len(re.findall(r"\bfor\b", body)):
        found.problems.append(f"{function} has a loop that is no range of integers")
    spans = [(loop.start(), loop.end(), _end_of(body, loop.end())) for loop in loops]
    most: list[int | None] = []  # passes of each loop, for a pass of the one around it
    ranges: list[dict[str, tuple[int, int]]] = []  # of the variables in each loop
    for i, loop in enumerate(loops):
        around = [k for k in range(i) if spans[k][0] < loop.start() < spans[k][2]]
        known = {name: (value, value) for name, value in constants.items()}
        for k in around:
            known |= ranges[k]
        inside = body[loop.end() : spans[i][2]]
        at = line + body.count("\n", 0, loop.start())
        for name in {loop[1], loop[3]} - {None}:
            if re.search(
                rf"(?<![\w.>])(?:{name} ?(?:[-+*/]?=[^=]|\+\+|--)|(?:\+\+|--){name}\b)", inside
            ):
                found.problems.append(f"{function} changes {name} in its loop, line {at}")
        first, last = _range(loop[2], known), _range(loop[4] or loop[6], known)
        step = 1 if loop[7] == "++" else -1 if loop[7] == "--" else int(loop[8])
        most.append(_count(first, last, step, loop[5]))
        ranges.append(_values(loop[1], first, last, loop[5]))
        if most[-1] is None:
            found.by_data.append(f"{at}: {loop[0].removesuffix(' {')}")
    total: int | None = 0
    for i, own in enumerate(most):
        total = _sum(total, _times(own, _product(most, spans, spans[i][0])))
    for call in _CALL.finditer(body):
        inner = found.passes.get(call[1])
        if call[1] in found.passes and inner != 0:
            total = _sum(total, _times(inner, _product(most, spans, call.start())))
    return total


def _product(most: list[int | None], spans: list[tuple[int, int, int]], at: int) -> int | None:
    """Return how often a place is reached: the product of the passes of the loops around it."""
    product: int | None = 1
    for passes, (_, begin, end) in zip(most, spans, strict=True):
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


Interval = tuple[int | None, int | None]


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
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "minimum_int":
        one, other = (_interval(each, known) for each in node.args)
        highs = [each for each in (one[1], other[1]) if each is not None]
        low = None if one[0] is None or other[0] is None else min(one[0], other[0])
        return low, min(highs, default=None)
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
