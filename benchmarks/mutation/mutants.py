"""One-line changes of source files, drawn at random.

The operators are those of cosmic-ray that leave plausible code (``+`` for ``-``, ``<`` for ``<=``,
numbers off by one, negated or dropped conditions), and one of our own: a statement is deleted.
Annotations, docstrings and code outside of functions are left as they are.
"""

from __future__ import annotations

import ast
import random
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

_COMPARISONS = "(Eq|NotEq|Lt|LtE|Gt|GtE)"
_OPERATORS = re.compile(
    "core/(ReplaceBinaryOperator_(Add_Sub|Sub_Add|Mul_Div|Div_Mul)"
    f"|ReplaceComparisonOperator_{_COMPARISONS}_{_COMPARISONS}"
    "|ReplaceUnaryOperator_Delete_(USub|Not)|AddNot|ReplaceTrueWithFalse|ReplaceFalseWithTrue"
    "|ReplaceAndWithOr|ReplaceOrWithAnd|ReplaceBreakWithContinue|ReplaceContinueWithBreak"
    "|NumberReplacer|ZeroIterationForLoop)"
)
# An array of one record (``kernels/sized.py``): [-1] is the same and [1] never runs.
_RECORD = re.compile(r"\[ ?(0|1|-1)\]")
_SIMPLE = (ast.Assign, ast.AugAssign, ast.Expr, ast.Return, ast.Continue, ast.Break, ast.Raise)


class Mutant(NamedTuple):
    """A changed file."""

    path: str  # of the file, relative to the repository
    line: int
    statement: range  # lines of the innermost statement
    function: str  # name of the function
    before: str
    after: str
    source: str  # of the whole file

    @property
    def name(self) -> str:
        """The change in one line."""
        return f"{self.path}, {self.function}: {self.before} -> {self.after}"


def draw(
    repository: Path,
    paths: Iterable[str],
    count: int,
    seed: int,
    wanted: Callable[[Mutant], bool] = lambda mutant: True,
) -> list[Mutant]:
    """Return ``count`` different ``wanted`` mutants of the files, each as likely as any other."""
    modules = [_Module(repository, path) for path in sorted(paths)]
    places = [(module, *place) for module in modules for place in module.places()]
    random.Random(seed).shuffle(places)
    found: dict[str, Mutant] = {}
    for module, operator, number in places:  # only the sources that are wanted are made
        if len(found) == count:
            break
        mutant = module.mutant(operator, number)
        if mutant is not None and wanted(mutant):
            found.setdefault(mutant.source, mutant)
    return list(found.values())


class _Module:
    """A file, and the places at which it can be changed."""

    def __init__(self, repository: Path, path: str) -> None:
        self.path = path
        self.source = (repository / path).read_text(encoding="utf-8")
        tree = ast.parse(self.source)
        self.lines = _lines_of_functions(tree)
        self.statements = [
            node
            for node in ast.walk(tree)
            if isinstance(node, _SIMPLE) and not _is_docstring(node) and node.lineno in self.lines
        ]

    def places(self) -> Iterator[tuple[str, int]]:
        """Return operators, each with the number of its place; without a name: the statement."""
        nodes = list(ast_nodes(get_ast(self.source)))
        comparisons = [node for node in nodes if node.type == "comparison"]
        for name in filter(_OPERATORS.fullmatch, operator_names()):
            operator = get_operator(name)()
            among = comparisons if "ReplaceComparison" in name else nodes
            places = [place for node in among for place in operator.mutation_positions(node)]
            yield from ((name, i) for i, (at, _) in enumerate(places) if at[0] in self.lines)
        yield from (("", i) for i in range(len(self.statements)))

    def mutant(self, operator: str, number: int) -> Mutant | None:
        """Return the file with a change; None if the change has no effect."""
        if operator:
            changed = mutate_code(self.source, get_operator(operator)(), number)
        else:
            changed = self._without(self.statements[number])
        if changed is None:
            return None
        line, before, after = _difference(self.source, changed)
        if line not in self.lines or _RECORD.sub("[]", before) == _RECORD.sub("[]", after):
            return None
        statement, function = self.lines[line]
        return Mutant(self.path, line, statement, function, before, after, changed)

    def _without(self, node: ast.stmt) -> str:
        lines = self.source.splitlines(keepends=True)
        first, last = node.lineno - 1, node.end_lineno or node.lineno
        return "".join([*lines[:first], " " * node.col_offset + "pass\n", *lines[last:]])


def _is_docstring(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _lines_of_functions(tree: ast.Module) -> dict[int, tuple[range, str]]:
    """Return the innermost statement and function of each line of a statement in a function.

    Signatures and docstrings have none.
    """
    found: dict[int, tuple[range, str]] = {}
    for function in ast.walk(tree):  # from the outside inwards
        if not isinstance(function, ast.FunctionDef):
            continue
        for node in (inner for statement in function.body for inner in ast.walk(statement)):
            if isinstance(node, ast.stmt) and not _is_docstring(node):
                if isinstance(node, ast.FunctionDef | ast.ClassDef):
                    for line in range(node.lineno, (node.end_lineno or node.lineno) + 1):
                        found.pop(line, None)
                    continue
                lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
                header = range(lines.start, node.body[0].lineno) if hasattr(node, "body") else lines
                for line in lines:
                    found[line] = (header if line in header else lines), function.name
    return found


def _difference(source: str, changed: str) -> tuple[int, str, str]:
    """Return the number of the first line that differs, and this line in both sources."""
    pairs = zip(source.splitlines(), changed.splitlines(), strict=False)
    for number, (before, after) in enumerate(pairs, 1):
        if before != after:
            return number, before.strip(), after.strip()
    return 0, "", ""
