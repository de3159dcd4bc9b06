"""A C program that is made of Python kernels, function by function."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from quell.export.translate import structs
from quell.export.translate.expressions import Calls, Expressions
from quell.export.translate.statements import Function
from quell.export.translate.text import (
    Array,
    Kind,
    Literals,
    Struct,
    TranslationError,
    Value,
    block_lines,
    comment_block,
    function_name,
    snake_case,
    unique,
    words,
    wrapped,
)

# Helper functions in C; "real" stands for float or double, "" for the suffix of functions.
_HELPERS = {
    "minimum": ("real minimum(real a, real b)", "return b < a ? b : a;",
                "Return the smaller number; a if one is not a number."),
    "maximum": ("real maximum(real a, real b)", "return b > a ? b : a;",
                "Return the larger number; a if one is not a number."),
    "minimum_int": ("int minimum_int(int a, int b)", "return b < a ? b : a;",
                    "Return the smaller number."),
    "maximum_int": ("int maximum_int(int a, int b)", "return b > a ? b : a;",
                    "Return the larger number."),
    "absolute": ("int absolute(int a)", "return a < 0 ? -a : a;", "Return |a|."),
    "is_finite": ("bool is_finite(real a)", "return fabs(a) <= REAL_MAX;",
                  "Return whether a is finite."),
    "truncated": ("int truncated(real a)",
                  "return a > -{2147483648} && a < {2147483648} ? (int)a : 0;",
                  "Return a without its fraction; 0 if it is not a number or too large."),
    "remainder_int": ("int remainder_int(int a, int b)",
                      "const int rest = a % b;\n    return rest != 0 && (rest < 0) != (b < 0) "
                      "? rest + b : rest;", "Return a modulo b, with the sign of b."),
    "quotient_int": ("int quotient_int(int a, int b)",
                     "const int rest = a % b;\n    return a / b - "
                     "(rest != 0 && (rest < 0) != (b < 0) ? 1 : 0);",
                     "Return a / b, rounded down."),
    "remainder_real": ("real remainder_real(real a, real b)",
                       "const real rest = fmod(a, b);\n    return rest != {0} && (rest < {0}) != "
                       "(b < {0}) ? rest + b : rest;", "Return a modulo b, with the sign of b."),
    "quotient_real": ("real quotient_real(real a, real b)", "return floor(a / b);",
                      "Return a / b, rounded down."),
}  # fmt: skip


class Program:
    """The functions, structs and constants that a set of kernels needs.

    Parameters
    ----------
    prefix
        begins the names of structs.
    single
        whether real numbers are ``float``.
    findings
        of earlier translations of the same program.
    """

    def __init__(self, prefix: str, single: bool, findings: structs.Findings) -> None:
        self.findings = findings
        self.literals = Literals(single)
        self.structs = structs.Structs(prefix, self.literals, findings)
        self.calls = Calls(self)
        self.functions: list[Function] = []
        self.helpers: set[str] = set()
        self.externals: dict[str, str] = {}  # declarations of functions that the user has in C
        self.results: dict[str, Struct] = {}  # structs of results by the name of the function
        self._found: dict[Any, Function] = {}
        self._names = set(_HELPERS)
        self._constants: dict[str, tuple[Any, str]] = {}

    def function(
        self,
        python: Callable[..., Any],
        arguments: list[Value],
        declaration: Callable[..., Any] | None = None,
        hints: tuple[str, ...] = (),
        into_array: bool = False,
    ) -> Function:
        """Return the C function of a Python function for arguments like these.

        If it implements a generic function, that is the ``declaration``. With ``into_array``, the
        last of them is an array for the numbers that it returns.
        """
        key = (python, into_array, *((a.kind, a.mutable and not a.is_number) for a in arguments))
        found = self._found.get(key)
        if found is None:
            source = structs.read_function(python)
            if declaration is not None and not source.doc:
                source = replace(source, doc=structs.doc_of(declaration))
            if into_array:
                source = structs.into_procedure(source, len(arguments[-1].kind.shape))
            found = Function(self, source, arguments, hints, key)
            self._found[key] = found
            if found.inline is None:
                found.name = self._function_name(found.source, arguments, declaration)
                self.functions.append(found)
                if len(found.result_members) > 1:
                    self.results[found.name] = Struct(f"{found.name}_result", tuple, False)
        return found

    def _function_name(
        self, source: structs.Source, arguments: list[Value], declaration: Callable[..., Any] | None
    ) -> str:
        name = function_name(declaration.__name__ if declaration else source.name)
        if name in structs.local_names(source.module):
            name = f"{name}_value"
        head = arguments[0].kind if arguments else None
        if name in self._names and isinstance(head, Struct):
            kind = snake_case(head.python.__name__).removesuffix("_design").removesuffix("_model")
            name = f"{name.rstrip('_')}_{kind}"
        return unique(name, self._names)

    def has_function(self, name: str) -> bool:
        """Return whether a function has this name."""
        return name in self._names

    def named_constant(self, name: str, value: Any, module: str) -> str:
        """Return the C name of a constant of a module."""
        plain = name.lstrip("_")
        candidate = plain
        for part in reversed(module.split(".")):
            kept = self._constants.setdefault(candidate, (value, module))
            if kept[0] == value and type(kept[0]) is type(value):
                return candidate
            # Constants of several modules have this name: the module tells them apart.
            candidate = f"{candidate}_{part.upper()}"
        raise TranslationError(f"{module}.{name}: its module has no name of its own")

    def pointer(self, kind: Kind, name: str, const: bool) -> str:
        """Return the declaration of a variable that points to an array or a struct."""
        word = "const " if const else ""
        if isinstance(kind, Struct):
            return f"{word}{kind.name} *{name}"
        if not isinstance(kind, Array):
            raise AssertionError
        number = self.structs.number(kind.element)
        if len(kind.shape) == 1:
            return f"{word}{number} *{name}"
        return f"{word}{number} (*{name})[{kind.shape[1]}]"

    def parameter(self, kind: Kind, name: str, const: bool) -> str:
        """Return the declaration of a parameter that is an array or a struct."""
        if isinstance(kind, Array):
            return f"{'const ' if const else ''}{self.structs.declaration(kind, name)}"
        return self.pointer(kind, name, const)

    def entry_expressions(self) -> Expressions:
        """Return expressions outside of any kernel, for calls from the public functions."""
        return Expressions(self, {}, "entry point", "")

    def kernel_lines(self, used_by: str, step: str = "") -> list[str]:
        """Return constants, helpers and functions, as far as the code ``used_by`` needs them.

        ``step`` is the part of that code which runs in each sample.
        """
        needed = words(used_by)
        kept: list[Function] = []
        for function in reversed(self.functions):
            if function.name in needed:
                kept.append(function)
                needed |= function.names_used()
        self.functions = kept[::-1]
        self._find_inline(words(step))
        self.helpers &= needed
        for name in [name for name in self._constants if name not in needed]:
            del self._constants[name]
        externals = [self.externals[name] for name in self.externals if name in needed]
        constants = [line for each in self.constant_lines() for line in wrapped(each)]
        return ["", *externals, *constants, *self.helper_lines(), *self.function_lines()]

    def _find_inline(self, in_step: set[str]) -> None:
        """Mark what one function calls in each sample, and another one elsewhere.

        Compilers inline what is called once. The rare call would cost time in each sample.
        """
        callers: dict[str, set[str]] = {}
        for function in reversed(self.functions):
            for name in function.names_used():
                callers.setdefault(name, set()).add(function.name)
            if function.name in in_step:
                in_step |= function.names_used()
        for function in self.functions:
            by = callers.get(function.name, set())
            function.is_inline = len(by & in_step) == 1 and not by <= in_step

    def constant_lines(self) -> list[str]:
        """Return the definitions of named constants."""
        lines = []
        for name, (value, module) in self._constants.items():
            comment = f" /* {module} */"
            if isinstance(value, tuple):
                shape = f"[{len(value)}]"
                if isinstance(value[0], tuple):
                    shape += f"[{len(value[0])}]"
                head = f"static const {self.literals.real} {name}{shape}"
                lines.append(f"{head} = {self._braces(value)};{comment}")
            elif isinstance(value, int) and not isinstance(value, bool):
                lines.append(f"static const int {name} = {value};{comment}")
            else:
                number = self.literals.write(value)
                lines.append(f"static const {self.literals.real} {name} = {number};{comment}")
        return lines

    def _braces(self, value: Any) -> str:
        if isinstance(value, tuple):
            return "{" + ", ".join(map(self._braces, value)) + "}"
        return self.literals.write_real(value)

    def helper_lines(self) -> list[str]:
        """Return the definitions of helper functions."""
        lines: list[str] = []
        for name, (head, body, doc) in _HELPERS.items():
            if name in self.helpers:
                head, body = (self._in_precision(text) for text in (head, body))
                lines += ["", f"/* {doc} */", f"static {head}", "{", f"    {body}", "}"]
        return lines

    def _in_precision(self, text: str) -> str:
        text = text.replace("REAL_MAX", "FLT_MAX" if self.literals.single else "DBL_MAX")
        text = re.sub(r"\breal\b", self.literals.real, text)
        text = re.sub(r"\{(\d+)\}", lambda m: self.literals.write_real(float(m[1])), text)
        return re.sub(
            r"\b(fabs|fmod|floor)\(", lambda m: f"{self.literals.math_function(m[1])}(", text
        )

    def function_lines(self) -> list[str]:
        """Return the definitions of all functions, each after those that it calls."""
        lines: list[str] = []
        modules: set[str] = set()
        for function in self.functions:
            source = function.source
            if source.module not in modules and (doc := structs.module_doc(source.module)):
                modules.add(source.module)
                lines += ["", *comment_block(f"---- {source.module} ----\n\n{doc}")]
            if len(function.result_members) > 1:
                members = " ".join(f"{self.structs.declaration(kind, name)};"
                                   for name, kind in function.result_members)  # fmt: skip
                lines += ["", f"typedef struct {{ {members} }} {function.name}_result;"]
            origin = f"From {source.module}.{source.name}."
            doc = f"{source.doc}\n\n{origin}" if source.doc else origin
            lines += ["", *comment_block(doc), *wrapped(function.signature()), "{"]
            lines += [*block_lines(function.block, function.result_type), "}"]
        return lines
