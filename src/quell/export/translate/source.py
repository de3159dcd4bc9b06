"""The source of kernels and of NamedTuples: syntax trees, docstrings and comments."""

from __future__ import annotations

import ast
import copy
import functools
import inspect
import io
import re
import sys
import textwrap
import tokenize
import unicodedata
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from quell.export.translate.values import TranslationError

# Signs in docstrings and comments, and what stands for them in C: compilers for small processors
# do not all read other than ASCII characters.
_SIGNS = {
    "−": "-", "–": "-", "…": "...", "·": "*", "×": "*", "≤": "<=", "≥": ">=", "≈": "~", "→": "->",
    "←": "<-", "∞": "inf", "√": "sqrt ", "Σ": "sum ", "∫": "integral ", "∂": "d", "±": "+-",
    "⁻": "-", "⁺": "+", "ᵀ": "'",
    "₀": "0", "½": "1/2", "’": "'", "“": '"', "”": '"', "∈": "in", "‖": "|", "ᵢ": "i",
    "Δ": "D", "Φ": "Phi", "Γ": "Gamma", "Λ": "Lambda", "Ω": "Omega", "µ": "u", "∇": "grad ",
}  # fmt: skip
_POWERS = dict(zip("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-", strict=True))
_ACCENTS = {"\u0302": "_hat", "\u0303": "_tilde", "\u0304": "_bar", "\u0305": "_bar"}


def ascii_text(text: str) -> str:
    """Return a text in ASCII: Greek letters by name, accents of symbols as ``_hat``."""
    found = []
    text = re.sub("[⁰¹²³⁴⁵⁶⁷⁸⁹⁻]*[⁰¹²³⁴⁵⁶⁷⁸⁹]", _power, text)
    for sign in unicodedata.normalize("NFD", text):
        if sign.isascii():
            found.append(sign)
        elif sign in _SIGNS or sign in _ACCENTS:
            found.append(_SIGNS.get(sign) or _ACCENTS[sign])
        elif not unicodedata.combining(sign):
            name = unicodedata.name(sign, "?").lower()
            found.append(name.rsplit(" ", 1)[-1] if name.startswith("greek") else "?")
    return "".join(found)


def _power(found: re.Match[str]) -> str:
    return "^" + "".join(_POWERS[sign] for sign in found[0])


@dataclass
class Comments:
    """The comments of a piece of source by line."""

    before: dict[int, list[str]] = field(default_factory=dict)  # whole lines before a line
    behind: dict[int, str] = field(default_factory=dict)  # at the end of a line

    def of(self, node: ast.AST) -> tuple[list[str], str]:
        """Return the comments before a statement, and the one behind its first or last line."""
        first, last = getattr(node, "lineno", 0), getattr(node, "end_lineno", 0)
        if isinstance(node, ast.If | ast.For):
            last = first
        return self.before.get(first, []), self.behind.get(first, self.behind.get(last, ""))


def _comments(text: str) -> Comments:
    found, waiting = Comments(), []
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        line = token.start[0]
        if token.type == tokenize.COMMENT:
            comment = ascii_text(token.string.lstrip("# "))
            if comment.startswith(("type:", "noqa", "fmt:")):
                continue
            if token.line.lstrip().startswith("#"):
                waiting.append(comment)
            else:
                found.behind[line] = re.sub(r"\s*# (noqa|type:).*", "", comment)
        elif waiting and token.type not in (tokenize.NL, tokenize.INDENT, tokenize.DEDENT):
            found.before[line] = waiting
            waiting = []
    return found


@dataclass(frozen=True)
class Source:
    """A Python function as the translator reads it."""

    tree: ast.FunctionDef
    comments: Comments
    doc: str  # without indentation, in ASCII
    module: str  # for example quell.guard.kernels
    name: str
    names: dict[str, Any]  # what global names stand for

    @functools.cached_property
    def occurring(self) -> frozenset[str]:
        """All names in the function."""
        return frozenset(part.id for part in ast.walk(self.tree) if isinstance(part, ast.Name))

    @functools.cached_property
    def stored(self) -> frozenset[str]:
        """The names that the function sets."""
        return frozenset(
            part.id
            for part in ast.walk(self.tree)
            if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store)
        )


@functools.cache
def read_function(function: Callable[..., Any]) -> Source:
    """Return the source of a function.

    Raises ``TranslationError`` if there is none, for example in an interactive session.
    """
    function = getattr(function, "py_func", function)
    name, module = function.__name__, function.__module__
    if name == "<lambda>":
        return _read_lambda(function)
    try:
        text = textwrap.dedent(inspect.getsource(function))
    except (OSError, TypeError):
        rule = "its source is not in a file; define it in a module"
        raise TranslationError(f"{module}.{name}: {rule}") from None
    tree = ast.parse(text).body[0]
    if not isinstance(tree, ast.FunctionDef):
        rule = "must be written as a function with def"
        raise TranslationError(f"{module}.{name}: {rule}")
    names = _names(function)
    doc = doc_of(function)
    return Source(tree, _comments(text), doc, module, name, names)


def doc_of(function: Any) -> str:
    """Return the docstring of a function, in ASCII."""
    return ascii_text(inspect.getdoc(function) or "")


def _names(function: Any) -> dict[str, Any]:
    return {**function.__globals__, **inspect.getclosurevars(function).nonlocals}


def _read_lambda(function: Any) -> Source:
    """Return a lambda as a function with a return statement."""
    where = f"the lambda in {function.__module__}"
    try:
        tree = ast.parse("".join(inspect.findsource(function)[0]))
    except (OSError, SyntaxError):
        tree = ast.Module([], [])
    code = function.__code__
    arguments = list(code.co_varnames[: code.co_argcount])
    found = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Lambda)
        and node.lineno == code.co_firstlineno
        and [argument.arg for argument in node.args.args] == arguments
    ]
    if len(found) != 1:
        raise TranslationError(f"{where} can't be found in its file; write it as a function")
    body: list[ast.stmt] = [ast.Return(found[0].body)]
    definition = ast.FunctionDef("user_function", found[0].args, body, [], None)
    ast.fix_missing_locations(definition)
    names = _names(function)
    return Source(definition, Comments(), "", function.__module__, "user_function", names)


def into_procedure(source: Source) -> Source:
    """Return a function that writes the numbers of its tuple to an array, its last argument."""
    tree = copy.deepcopy(source.tree)
    tree.args.args.append(ast.arg("out"))
    _Returns(f"{source.module}.{source.name}").visit(tree)
    return replace(source, tree=ast.fix_missing_locations(tree))


class _Returns(ast.NodeTransformer):
    """Replacement of return statements by assignments to the array ``out``."""

    def __init__(self, where: str) -> None:
        self.where = where

    def visit_Return(self, node: ast.Return) -> list[ast.stmt]:
        value = node.value
        is_array = isinstance(value, ast.Call) and getattr(value.func, "attr", "") == "array"
        if is_array and isinstance(value, ast.Call):
            value = value.args[0]
        if not isinstance(value, ast.Tuple | ast.List):
            raise TranslationError(f"{self.where}: must return a tuple of numbers, written as one")
        lines: list[ast.stmt] = []
        for i, number in enumerate(value.elts):
            place = ast.Subscript(ast.Name("out", ast.Load()), ast.Constant(i), ast.Store())
            lines.append(ast.copy_location(ast.Assign([place], number), node))
        return [*lines, ast.copy_location(ast.Return(None), node)]


@functools.cache
def field_comments(kind: type) -> dict[str, str]:
    """Return the comment of each field of a NamedTuple or record, where there is one."""
    try:
        text = textwrap.dedent(inspect.getsource(kind))
    except (OSError, TypeError):
        return {}
    comments, found = _comments(text), {}
    body = ast.parse(text).body[0]
    for node in getattr(body, "body", []):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            before, behind = comments.of(node)
            found[node.target.id] = behind or " ".join(before)
    return {name: comment for name, comment in found.items() if comment}


@functools.cache
def local_names(module: str) -> frozenset[str]:
    """Return the names of all parameters and variables in the functions of a module."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError):
        return frozenset()
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    nodes = [node for function in functions for node in ast.walk(function)]
    stored = {node.id for node in nodes if isinstance(node, ast.Name)
              and isinstance(node.ctx, ast.Store)}  # fmt: skip
    return frozenset(stored | {node.arg for node in nodes if isinstance(node, ast.arg)})


def module_doc(module: str) -> str:
    """Return the docstring of a module in ASCII."""
    return ascii_text(inspect.getdoc(sys.modules[module]) or "")
