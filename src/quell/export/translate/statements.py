"""Translation of the statements of a function."""

from __future__ import annotations

import ast
from dataclasses import replace
from typing import Any

from quell.export.translate.blocks import (
    Block,
    Branch,
    Line,
    Loop,
    lines_of,
    words,
)
from quell.export.translate.expressions import Expressions
from quell.export.translate.interfaces import Translation
from quell.export.translate.naming import identifier
from quell.export.translate.source import Source
from quell.export.translate.structs import whole_kind
from quell.export.translate.values import (
    NOTHING,
    SHIFT,
    UNARY,
    Array,
    Number,
    Several,
    Value,
)
from quell.export.translate.variables import Assumptions, Variables


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
