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
    found = [m for path in sorted(paths) for m in mutants(repository, path) if wanted(m)]
    return random.Random(seed).sample(found, min(count, len(found)))


def mutants(repository: Path, path: str) -> list[Mutant]:
    """Return all mutants of a file."""
    source = (repository / path).read_text(encoding="utf-8")
    tree = ast.parse(source)
    lines = _lines_of_functions(tree)
    unique = {}
    for changed in (*_by_operators(source, set(lines)), *_without_a_statement(source, tree)):
        line, before, after = _difference(source, changed)
        if line in lines and _RECORD.sub("[]", before) != _RECORD.sub("[]", after):
            statement, function = lines[line]
            unique[changed] = Mutant(path, line, statement, function, before, after, changed)
    return list(unique.values())


def _by_operators(source: str, lines: set[int]) -> Iterator[str]:
    nodes = list(ast_nodes(get_ast(source)))
    for name in filter(_OPERATORS.fullmatch, operator_names()):
        operator = get_operator(name)()
        places = [place for node in nodes for place in operator.mutation_positions(node)]
        for i, (start, _) in enumerate(places):
            changed = mutate_code(source, operator, i) if start[0] in lines else None
            if changed is not None and changed != source:
                yield changed


def _without_a_statement(source: str, tree: ast.Module) -> Iterator[str]:
    lines = source.splitlines(keepends=True)
    for node in ast.walk(tree):
        if not isinstance(node, _SIMPLE) or _is_docstring(node) or node.end_lineno is None:
            continue
        first, last = node.lineno - 1, node.end_lineno
        yield "".join([*lines[:first], " " * node.col_offset + "pass\n", *lines[last:]])


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
