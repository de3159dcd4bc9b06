"""Translation of functions to C: variables, statements, parameters and result.

The local variables of a function in C.

A variable that has the same known value wherever it is set does not exist in C. That is assumed of
every variable; where it proves wrong, ``Assumptions`` keeps that, and the function is translated
again. The same holds for the kind of a number: an integer that is real elsewhere is real.

Translation of a function for arguments of given kinds: its parameters and its result.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass, field, replace
from typing import Any

from quell.export.translate.expressions import Expressions, Translation
from quell.export.translate.structs import Source, whole_kind
from quell.export.translate.text import (
    ATOM,
    NOTHING,
    SHIFT,
    UNARY,
    Array,
    Block,
    Branch,
    Kind,
    Line,
    Loop,
    Number,
    Several,
    Struct,
    TranslationError,
    Value,
    identifier,
    is_empty,
    join,
    join_numbers,
    lines_of,
    names_in_block,
    place_declarations,
    remove_unused,
    words,
)

# ---- The local variables of a function in C ----


class WrongAssumptionError(Exception):
    """An assumption about a local variable was wrong: the body must be translated again."""


@dataclass
class Assumptions:
    """Local variables that are not as assumed."""

    varying: set[str] = field(default_factory=set)  # variables that are not always the same
    kinds: dict[str, Number] = field(default_factory=dict)  # of numbers with several kinds

    def fail_as_varying(self, name: str) -> None:
        """Note that a variable is not always the same, and end this translation."""
        self.varying.add(name)
        raise WrongAssumptionError

    def fail_as(self, name: str, kind: Number) -> None:
        """Note the kind of a number, and end this translation."""
        self.kinds[name] = kind
        raise WrongAssumptionError


class Variables:
    """The variables of one function; ``expressions`` has the values of their names."""

    def __init__(
        self,
        expressions: Expressions,
        source: Source,
        arguments: dict[str, Value],
        assumptions: Assumptions,
    ) -> None:
        self.expressions, self.assumptions = expressions, assumptions
        self.program = expressions.program
        self.names = expressions.names
        self.names.update(arguments)
        self.local: dict[str, Value] = {}  # what the variables that exist in C were set to first
        self._parameters = set(arguments)
        self._taken = set(source.occurring)

    def fresh(self, name: str) -> str:
        """Return a name that no variable of the function has, for another one."""
        found, number = name, 2
        while found in self._taken or found in self.names:
            found, number = f"{name}{number}", number + 1
        self._taken.add(found)
        return found

    def set(self, name: str, value: Value, block: Block) -> None:
        """Set a variable, by a line in ``block`` if it exists in C."""
        if self._is_always_same(name, value) or is_empty(value):
            self.names[name] = value
        elif value.is_number:
            self._set_number(name, value, block)
        else:
            self._set_reference(name, value, block)

    def _is_always_same(self, name: str, value: Value) -> bool:
        """Return whether a variable has had this known value only, as far as is known."""
        before = self.names.get(name)
        if name not in self.assumptions.varying and value.is_constant and name not in self.local:
            if before is not None and not (before.is_constant and same_constant(before, value)):
                self.assumptions.fail_as_varying(name)
            return True
        if before is not None and before.is_constant and name not in self.assumptions.varying:
            self.assumptions.fail_as_varying(name)
        return False

    def _c_name(self, name: str) -> str:
        """Return the C name of a variable, which must not be that of a function."""
        variable = identifier(name)
        return f"{variable}_" if self.program.has_function(variable) else variable

    def _set_number(self, name: str, value: Value, block: Block) -> None:
        kind = self.assumptions.kinds.get(name, value.kind)
        known = self.local.get(name, self.names.get(name))
        before = kind if known is None else known.kind
        joined = join_numbers(Value(join(before, kind, name)), value, name)
        if joined is not kind or (name in self.local and joined is not before):
            self.assumptions.fail_as(name, joined)
        value, variable = self.expressions.as_kind(value, joined), self._c_name(name)
        if value.code == variable:  # x = x
            return
        if name not in self._parameters:
            self.local[name] = replace(value, kind=joined)
        self.names[name] = Value(joined, variable)
        block.append(Line(value.code, variable, calls=value.calls))

    def _set_reference(self, name: str, value: Value, block: Block) -> None:
        """Set a variable to an array, a struct or the result of a call."""
        where = f"{self.expressions.where}: {name}"
        if isinstance(value.kind, Several):
            raise TranslationError(f"{where}: a tuple must be unpacked")
        before = self.local.get(name)
        if before is not None and before.kind != value.kind:
            raise TranslationError(f"{where} refers to different arrays")
        is_result = value.code.split("(")[0] in self.program.results and value.calls
        self.local[name], variable = value, self._c_name(name)
        self.names[name] = replace(value.named(variable), pointer=not is_result)
        code = value.address if isinstance(value.kind, Struct) and not is_result else value.code
        block.append(Line(code, variable, calls=value.calls))


def same_constant(one: Value, other: Value) -> bool:
    """Return whether two known values are the same, not-a-number included."""
    return same_number(one.constant, other.constant)


def same_number(one: Any, other: Any) -> bool:
    """Return whether two numbers are of one type and equal, or both not a number."""
    return type(one) is type(other) and (one == other or (one != one and other != other))


# ---- Translation of the statements of a function ----


class Body:
    """The body of a function, translated once under given assumptions."""

    def __init__(
        self,
        program: Translation,
        source: Source,
        arguments: dict[str, Value],
        assumptions: Assumptions,
    ) -> None:
        where = f"{source.module}.{source.name}"
        self.program, self.source = program, source
        self.expressions = Expressions(program, source.names, where, source.module)
        self.variables = Variables(self.expressions, source, arguments, assumptions)
        self.returns: list[tuple[Line, Value]] = []
        self.block: Block = self._statements(source.tree.body)

    def _statements(self, nodes: list[ast.stmt]) -> Block:
        """Return the translation of statements, without what can not be reached."""
        block: Block = []
        for node in nodes:
            here: Block = []
            ends = self._statement(node, here)
            calls: Block = [Line(code, calls=True) for code in self.expressions.pending]
            self.expressions.pending.clear()
            here = calls + here
            if here:
                before, behind = self.source.comments.of(node)
                here[0].comments = before + here[0].comments
                here[0].behind = here[0].behind or behind
            block += here
            if ends:
                break
        return block

    def _statement(self, node: ast.stmt, block: Block) -> bool:
        """Add a statement to ``block``; return whether nothing after it is reached."""
        if isinstance(node, ast.Expr):
            if not isinstance(node.value, ast.Constant):
                self._call_statement(self.expressions.translate(node.value), block)
            return False
        if isinstance(node, ast.Return):
            self._return(node.value, block)
            return True
        if isinstance(node, ast.Continue | ast.Break):
            block.append(Line(type(node).__name__.lower()))
            return True
        if isinstance(node, ast.If):
            return self._if(node, block)
        method = getattr(self, f"_{type(node).__name__.lower()}_statement", None)
        if method is None:
            raise self.expressions.fail(node, "this statement can not be translated")
        method(node, block)
        return False

    def _pass_statement(self, node: ast.Pass, block: Block) -> None:
        pass

    def _raise_statement(self, node: ast.Raise, block: Block) -> None:
        raise self.expressions.fail(node, "C has no exceptions")

    def _call_statement(self, value: Value, block: Block) -> None:
        if value.calls:
            unused = "" if value.kind == NOTHING else "(void)"
            block.append(Line(f"{unused}{value.code}", calls=True))

    def _if(self, node: ast.If, block: Block) -> bool:
        test = self.expressions.translate(node.test)
        if test.is_constant:
            arm = self._statements(node.body if test.constant else node.orelse)
            block.extend(arm)
            return bool(arm) and ends(arm)
        body, orelse = self._statements(node.body), self._statements(node.orelse)
        if not body and orelse:
            test = self._not(test)
            body, orelse = orelse, []
        if body or orelse or test.calls:
            block.append(Branch(test.code, body, orelse))
        return bool(body and orelse and ends(body) and ends(orelse))

    def _not(self, test: Value) -> Value:
        return Value(Number.BOOL, f"!{test.at(UNARY)}", UNARY, calls=test.calls)

    def _for_statement(self, node: ast.For, block: Block) -> None:
        call = node.iter
        is_range = isinstance(call, ast.Call) and getattr(call.func, "id", "") == "range"
        if not (is_range and isinstance(node.target, ast.Name) and not node.orelse):
            raise self.expressions.fail(node, "only 'for … in range(…)' can be translated")
        bounds = [self.expressions.translate(part) for part in call.args]  # type: ignore[attr-defined]
        start = bounds[0] if len(bounds) > 1 else self.expressions.constant(0)
        stop = bounds[1] if len(bounds) > 1 else bounds[0]
        step = bounds[2].constant if len(bounds) > 2 else 1
        if (
            start.is_constant
            and stop.is_constant
            and not range(start.constant, stop.constant, step)
        ):
            return
        name = node.target.id if node.target.id != "_" else self.variables.fresh("k")
        variable = identifier(name)
        self.expressions.names[node.target.id] = Value(Number.INT, variable)
        body = self._statements(node.body)
        if not body:
            return
        end, more = stop.at(SHIFT), ""
        if not stop.is_constant and (stop.calls or words(stop.code) & _set_names(body)
                                     or "->" in stop.code):  # fmt: skip
            last = self.variables.fresh("end")
            end, more = last, f", {last} = {stop.code}"
        sign = "<" if step > 0 else ">"
        change = {1: f"{variable}++", -1: f"{variable}--"}.get(step, f"{variable} += {step}")
        header = f"for (int {variable} = {start.code}{more}; {variable} {sign} {end}; {change})"
        block.append(Loop(header, variable, body))

    def _return(self, node: ast.expr | None, block: Block) -> None:
        if isinstance(node, ast.IfExp) and isinstance(node.body, ast.Tuple):
            test = self.expressions.translate(node.test)
            if test.is_constant:
                self._return(node.body if test.constant else node.orelse, block)
                return
            arms: list[Block] = [[], []]
            self._return(node.body, arms[0])
            block.append(Branch(test.code, arms[0], []))
            self._return(node.orelse, block)
            return
        line = Line("return")
        value = Value(NOTHING)
        if node is not None:
            names = ()
            value = (
                self.expressions.call(node, names)
                if isinstance(node, ast.Call)
                else self.expressions.translate(node)
            )
        if isinstance(value.kind, Several) and not value.items:
            raise self.expressions.fail(
                self.source.tree, "returns the tuple of another function; unpack it"
            )
        codes = [item.code for item in value.items] if value.items else [value.code]
        line.code = f"return {', '.join(codes)}".strip()
        self.returns.append((line, value))
        block.append(line)

    def _assign_statement(self, node: ast.Assign, block: Block) -> None:
        if len(node.targets) == 1 and isinstance(node.targets[0], ast.Tuple):
            self._unpack(node.targets[0], node.value, block)
            return
        value = self.expressions.translate(node.value)
        for target in node.targets:
            self._store(target, value, block, node)
            if value.calls and len(node.targets) > 1:
                value = self.expressions.translate(node.targets[0])

    def _annassign_statement(self, node: ast.AnnAssign, block: Block) -> None:
        if node.value is not None:
            self._store(node.target, self.expressions.translate(node.value), block, node)

    def _unpack(self, targets: ast.Tuple, node: ast.expr, block: Block) -> None:
        names = tuple(str(getattr(part, "id", getattr(part, "attr", ""))) for part in targets.elts)
        value = (
            self.expressions.call(node, names)
            if isinstance(node, ast.Call)
            else self.expressions.translate(node)
        )
        if not isinstance(value.kind, Several):
            raise self.expressions.fail(node, "is not a tuple")
        items = value.items
        if value.code:  # a call that returns a struct with what is not known otherwise
            items = self._results(value, block)
        if isinstance(node, ast.Tuple):
            items = self._without_overlap(targets, node, items, block)
        for target, item in zip(targets.elts, items, strict=True):
            self._store(target, item, block, node)

    def _results(self, value: Value, block: Block) -> tuple[Value, ...]:
        """Return the numbers that a call returns, without those that are constant."""
        struct = self.program.results.get(value.code.split("(")[0])
        if struct is None:  # it returns the only one
            return tuple(
                replace(item, code=value.code, calls=True) if item.code.startswith(".") else item
                for item in value.items
            )
        result = self.variables.fresh("result")
        self.variables.set(result, replace(value, kind=struct), block)
        return tuple(
            replace(item, code=result + item.code) if item.code.startswith(".") else item
            for item in value.items
        )

    def _without_overlap(
        self, targets: ast.Tuple, node: ast.Tuple, items: tuple[Value, ...], block: Block
    ) -> tuple[Value, ...]:
        """Return the items, the later ones in new variables if an earlier target is in them."""
        found = list(items)
        for i, target in enumerate(targets.elts[:-1]):
            base = ast.unparse(target).split("[")[0]
            for k in range(i + 1, len(found)):
                used = [ast.unparse(part) for part in ast.walk(node.elts[k])
                        if isinstance(part, ast.Name | ast.Attribute)]  # fmt: skip
                if base in used and found[k].is_number and not found[k].is_constant:
                    name = self.variables.fresh("before")
                    self.variables.set(name, found[k], block)
                    found[k] = self.expressions.names[name]
        return tuple(found)

    def _store(self, target: ast.expr, value: Value, block: Block, node: ast.AST) -> None:
        if isinstance(target, ast.Name):
            self.variables.set(target.id, value, block)
            return
        if isinstance(target, ast.Subscript) and isinstance(target.value, ast.Attribute):
            array = self.expressions.translate(target.value)
            if isinstance(array.kind, Array) and not array.code:  # a scratch array is not kept
                return
        place = self.expressions.translate(target)
        if place.member is not None:
            same = value.is_constant and float(value.constant) == place.constant
            if not same:
                value = whole(value)
                self.program.structs.vary(place.member, needed_kind(value))
            if place.is_constant:
                return
        self._check_place(target, place)
        value = self._fitting(place.kind, value, node)
        self.expressions.written.add(place.root)
        block.append(Line(f"{place.code} = {value.code}", calls=True))

    def _check_place(self, target: ast.expr, place: Value) -> None:
        if not place.is_number or place.is_constant:
            raise self.expressions.fail(target, "only numbers can be assigned")
        if not place.mutable:
            raise self.expressions.fail(target, "parameters can not be changed")

    def _fitting(self, kind: Any, value: Value, node: ast.AST) -> Value:
        if kind is Number.REAL:
            return self.expressions.real(value)
        value = whole(value)
        if kind is Number.BOOL and value.is_constant:
            return self.expressions.constant(bool(value.constant))
        if kind is Number.INT and value.is_constant:
            return self.expressions.constant(int(value.constant))
        if not value.is_number or needed_kind(value).value > kind.value:
            if self.program.findings.is_new:
                return value  # the program will be translated again
            raise self.expressions.fail(node, "a real number is assigned to an integer")
        return value

    def _augassign_statement(self, node: ast.AugAssign, block: Block) -> None:
        value = self.expressions.translate(node.value)
        if value.constant == 0 and isinstance(node.op, ast.Add | ast.Sub | ast.BitOr):
            return
        if isinstance(node.target, ast.Name):
            before = self.expressions.names[node.target.id]
            if before.is_constant:
                self.variables.assumptions.fail_as_varying(node.target.id)
            found = self.expressions.operation(node, node.op, before, value)
            if found.kind is not before.kind:
                self.variables.assumptions.fail_as(node.target.id, found.kind)
            name, place = before.code, before
        else:
            place = self.expressions.translate(node.target)
            if place.member is not None:
                self.program.structs.vary(place.member, Number.REAL)
                if place.is_constant:
                    return
            self._check_place(node.target, place)
            self.expressions.written.add(place.root)
            found = self.expressions.operation(node, node.op, place, value)
            self._fitting(place.kind, found, node)
            name = ""
        if isinstance(node.op, ast.Pow | ast.Mod | ast.FloorDiv):
            code = f"{place.code} = {found.code}"
        else:
            value = self.expressions.as_kind(value, place.kind)
            sign = found.code[len(place.code) + 1 :].split(" ", 1)[0]
            code = f"{place.code} {sign}= {value.code}"
        block.append(Line(code, name, calls=not name or value.calls, updates=bool(name)))


def whole(value: Value) -> Value:
    """Return a value as a truth value if it is one that was made real."""
    return value.whole if value.whole is not None else value


def needed_kind(value: Value) -> Number:
    """Return the kind of number that can hold a value."""
    if value.is_constant:
        return whole_kind(value.constant)
    return value.kind if isinstance(value.kind, Number) else Number.REAL


def ends(block: Block) -> bool:
    """Return whether nothing after a block is reached."""
    last = block[-1] if block else None
    if isinstance(last, Line):
        return last.code.startswith(("return", "continue", "break")) and not last.target
    return isinstance(last, Branch) and ends(last.body) and ends(last.orelse)


def _set_names(block: Block) -> set[str]:
    return {line.target for line in lines_of(block) if line.target}


# ---- Translation of a function for arguments of given kinds ----


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
            block, local, lambda name, constant: self._declaration(body, name, constant)
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
