"""Translation of a function for arguments of given kinds: its parameters and its result."""

from __future__ import annotations

import ast
from dataclasses import replace
from typing import Any

from quell.export.translate.blocks import (
    Block,
    Line,
    names_in_block,
    place_declarations,
    remove_unused,
)
from quell.export.translate.expressions import Expressions
from quell.export.translate.interfaces import Translation
from quell.export.translate.naming import identifier
from quell.export.translate.source import Source
from quell.export.translate.statements import Body, ends
from quell.export.translate.values import (
    ATOM,
    NOTHING,
    Array,
    Kind,
    Number,
    Several,
    Struct,
    TranslationError,
    Value,
    join,
)
from quell.export.translate.variables import (
    Assumptions,
    WrongAssumptionError,
    same_constant,
    same_number,
)


class Function:
    """A C function; the result of translating a Python function for kinds of arguments.

    Attributes
    ----------
    name
        in C; empty if calls of it vanish.
    is_inline
        whether compilers should copy it into its callers.
    """

    def __init__(
        self,
        program: Translation,
        source: Source,
        arguments: list[Value],
        hints: tuple[str, ...],
        key: Any,
    ) -> None:
        self.key = key
        self.program, self.source = program, source
        names = [argument.arg for argument in source.tree.args.args]
        if len(names) != len(arguments):
            raise TranslationError(f"{source.module}.{source.name}: wrong number of arguments")
        parameters = {
            name: _parameter(name, argument, node.annotation)
            for name, argument, node in zip(names, arguments, source.tree.args.args, strict=True)
        }
        # Values of the parameters that are the same in all calls so far.
        self.constants: dict[str, Any] = {}
        for name, argument in zip(names, arguments, strict=True):
            if name in source.stored or not isinstance(argument.kind, Number):
                continue
            if argument.is_constant and (key, name) not in program.findings.parameters:
                self.constants[name] = argument.constant
                parameters[name] = replace(
                    parameters[name],
                    code=argument.code,
                    level=argument.level,
                    constant=argument.constant,
                )
        known = Assumptions()
        while True:
            try:
                body = Body(program, source, parameters, known)
                break
            except WrongAssumptionError:
                continue
        self.order = names
        self.parameters = parameters
        self.written = body.expressions.written
        local = {body.variables.names[name].code for name in body.variables.local}
        block = remove_unused(body.block, local)
        self._find_result(body, block, hints)
        used = names_in_block(block)
        self.used = [name for name in names if identifier(name) in used]
        place_declarations(
            block,
            local,
            lambda name, constant: self._declaration(body, name, constant),
        )
        self.block = block
        self.name = ""
        self.is_inline = False

    def _find_result(self, body: Body, block: Block, hints: tuple[str, ...]) -> None:
        """Set what the function returns, and complete its return statements."""
        self.inline: Value | None = None  # what a call is, if nothing else happens
        self.constant: Value | None = None  # what all calls return
        self.kind: Kind = NOTHING
        self.items: tuple[Value, ...] = ()
        self.result_members: list[tuple[str, Number]] = []
        values = [value for _, value in body.returns]
        falls = not ends(block)
        if not values or all(value.kind == NOTHING for value in values):
            self._return_nothing(body, block)
            if not block:
                self.inline = Value(NOTHING)
            return
        if falls:
            raise TranslationError(f"{body.expressions.where}: a path has no return value")
        if isinstance(values[0].kind, Several):
            self._find_items(body, block, hints)
            return
        first = values[0]
        if all(value.is_constant and same_constant(value, first) for value in values):
            self.constant = first
            self._return_nothing(body, block)
            self.inline = first if not block else None
            self.kind = NOTHING
            return
        if len(block) == 1 and first.code in {identifier(name) for name in self.order}:
            self.inline = first
            return
        kind = first.kind
        for value in values[1:]:
            kind = join(kind, value.kind, body.expressions.where)
        self.kind = kind
        for line, value in body.returns:
            if not value.is_number:
                raise TranslationError(f"{body.expressions.where}: returns an array")
            line.code = f"return {body.expressions.as_kind(value, kind).code}"

    def _find_items(self, body: Body, block: Block, hints: tuple[str, ...]) -> None:
        values = [value for _, value in body.returns]
        names = {identifier(name) for name in self.order}
        items: list[Value] = []
        known = len(block) == 1 and all(
            item.is_constant or item.code in names for item in values[0].items
        )
        for i in range(len(values[0].items)):
            each = [value.items[i] for value in values]
            first = each[0]
            if known or all(item.is_constant and same_constant(item, first) for item in each):
                items.append(first)
            else:
                kind = first.kind
                for item in each[1:]:
                    kind = join(kind, item.kind, body.expressions.where)
                hint = hints[i] if i < len(hints) and hints[i] not in ("", "_") else f"value{i + 1}"
                member = identifier(hint)
                if member in dict(self.result_members):
                    member = f"value{i + 1}"
                self.result_members.append((member, kind))
                items.append(Value(kind, f".{member}", ATOM))
        self.items = tuple(items)
        if not self.result_members:
            self._return_nothing(body, block)
            if not block:
                kinds = Several(tuple(item.kind for item in items))
                self.inline = Value(kinds, items=tuple(items))
            return
        single = len(self.result_members) == 1
        self.kind = self.result_members[0][1] if single else Several(tuple(i.kind for i in items))
        for line, value in body.returns:
            parts = [
                body.expressions.as_kind(item, kept.kind).code
                for item, kept in zip(value.items, items, strict=True)
                if kept.code.startswith(".")
            ]
            line.code = f"return {parts[0]}" if single else ", ".join(parts)
            line.returns_several = not single

    def _return_nothing(self, body: Body, block: Block) -> None:
        for line, _ in body.returns:
            line.code = "return"
        if block and isinstance(block[-1], Line) and block[-1].code == "return":
            del block[-1]

    def _declaration(self, body: Body, name: str, constant: bool) -> str:
        variables = body.variables
        value = next(v for key, v in variables.local.items() if variables.names[key].code == name)
        kind = value.kind
        if isinstance(kind, Number):
            return f"{'const ' if constant else ''}{self.program.structs.number(kind)} {name}"
        if value.calls and isinstance(kind, Struct):
            return f"const {kind.name} {name}"
        if not value.code:
            return self.program.structs.declaration(kind, name)
        is_const = not value.mutable or value.root not in self.written
        return self.program.pointer(kind, name, is_const)

    def names_used(self) -> set[str]:
        """Return the names in the function's code."""
        return names_in_block(self.block)

    def signature(self) -> str:
        """Return the C declaration of the function."""
        parts = []
        for name in self.used:
            value = self.parameters[name]
            if isinstance(value.kind, Number):
                parts.append(self.program.structs.declaration(value.kind, identifier(name)))
            else:
                # C has no conversion from arrays of numbers to arrays of constant numbers.
                is_matrix = isinstance(value.kind, Array) and len(value.kind.shape) > 1
                is_const = not value.mutable or not (is_matrix or name in self.written)
                # Parameters of a controller do not change, so no store can change what was read.
                never_stored = not value.mutable and isinstance(value.kind, Struct)
                declared = f"{'restrict ' if never_stored else ''}{identifier(name)}"
                parts.append(self.program.parameter(value.kind, declared, is_const))
        words = "static inline" if self.is_inline else "static"
        return f"{words} {self.result_type} {self.name}({', '.join(parts) or 'void'})"

    @property
    def result_type(self) -> str:
        """The C type of the result."""
        if isinstance(self.kind, Several):
            return f"{self.name}_result"
        return "void" if self.kind == NOTHING else self.program.structs.number(self.kind)

    def call(self, body: Expressions, arguments: list[Value]) -> Value:
        """Return the value of a call with these arguments."""
        by_name = dict(zip(self.order, arguments, strict=True))
        for name, constant in self.constants.items():
            number = by_name[name]
            if not (number.is_constant and same_number(number.constant, constant)):
                self.program.findings.add_parameter((self.key, name))
        for name in self.written:
            body.written.add(by_name[name].root)
        if self.inline is not None:
            return self._inlined(body, by_name)
        given = [self._passed(body, name, by_name[name]) for name in self.used]
        code = f"{self.name}({', '.join(given)})"
        if self.items and self.result_members:
            kinds = Several(tuple(item.kind for item in self.items))
            return Value(kinds, code, items=self.items, calls=True)
        if self.items:
            kinds = Several(tuple(item.kind for item in self.items))
            body.pending.append(code)
            return Value(kinds, items=self.items, calls=True)
        if self.constant is not None:
            body.pending.append(code)
            return self.constant
        return Value(self.kind, code, calls=True)

    def _inlined(self, body: Expressions, by_name: dict[str, Value]) -> Value:
        inline = self.inline
        if inline is None:
            raise AssertionError
        variables = {identifier(name): name for name in self.order}

        def argument(item: Value) -> Value:
            if item.is_constant or item.code not in variables:
                return item
            given = by_name[variables[item.code]]
            return body.real(given) if item.kind is Number.REAL else given

        if isinstance(inline.kind, Several):
            return replace(inline, items=tuple(map(argument, inline.items)))
        return argument(inline)

    def _passed(self, body: Expressions, name: str, argument: Value) -> str:
        kind = self.parameters[name].kind
        if isinstance(argument.kind, Struct):
            return argument.address
        if isinstance(argument.kind, Array):
            if len(argument.kind.shape) > 1 and argument.mutable:
                body.written.add(argument.root)
            return argument.code
        return body.as_kind(argument, kind).code


def _parameter(name: str, argument: Value, annotation: ast.expr | None) -> Value:
    kind = argument.kind
    if getattr(annotation, "id", "") == "float" and isinstance(kind, Number):
        kind = Number.REAL
    return Value(kind, identifier(name), root=name, mutable=argument.mutable)
