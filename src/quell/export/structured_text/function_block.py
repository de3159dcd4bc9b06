"""``st``: a controller as a function block in Structured Text, for the PLCs of IEC 61131-3."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.axes import Axes
from quell.controllers.base import check_controller
from quell.controllers.prefilters import without_prefilters
from quell.controllers.state_space import StateFeedback
from quell.export import controller_source
from quell.export.c_files import CSource
from quell.export.library.precision import Comparison, checked_comparison
from quell.export.library.vectors import fill
from quell.export.structured_text.c_reader import Assign, CFile, Evaluate, Member
from quell.export.structured_text.places import Node, Place, Record, Variable, Whole
from quell.export.structured_text.translator import Translator
from quell.export.translate.text import TranslationError, checked_name, wrapped
from quell.files import check_folder, write_folder
from quell.learners.base import NoLearner
from quell.simulation.scenario import Scenario

# Inputs besides r, y and what a step takes further: when they act is in the README.
_MANUAL = (("manual", "BOOL"), ("u_manual", "REAL"))
_APPLIED = (("limited", "BOOL"), ("u_limited", "REAL"))
_RESET = (("restart", "BOOL"),)


class FunctionBlock(NamedTuple):
    """A controller that was written as a function block."""

    files: tuple[Path, ...]  #: all files in the folder
    comparison: Comparison | None  #: single to double precision, if they were compared


def st(
    controller: Any,
    folder: str | os.PathLike[str],
    *,
    name: str = "controller",
    precision: str = "double",
    plant: Any = None,
    scenario: Scenario | None = None,
    accept: bool = False,
    overwrite: bool = False,
) -> FunctionBlock:
    """Write a controller as a function block in Structured Text (IEC 61131-3).

    The text is translated from the C code, operation by operation. Compiled by MATIEC and gcc it
    gives the bits of the C code (``tests/test_structured_text.py``); a compiler of a PLC that
    changes the order of operations, or rounds otherwise, changes the last bits.

    Parameters
    ----------
    controller
        a controller without learner of one u and one y, with finite limits of u; with what its
        observer knows, from rest.
    folder
        where to write ``NAME.st`` and ``README.md``; must be new or empty.
    name
        of the function block.
    precision
        ``"double"`` for ``LREAL``, ``"single"`` for ``REAL``.
    plant, scenario
        for single precision, both: the loop in which it is compared with double.
    accept
        write in single precision even if nothing is compared, or the difference is too large.
    overwrite
        whether files of the same names in the folder may be replaced.

    Returns
    -------
    FunctionBlock
        the files, and the comparison.

    Raises
    ------
    ValueError
        for a name that Structured Text does not take, a folder with files, several axes, limits
        that are infinite, and a controller with a part that has no Structured Text, which is named
        (``TranslationError``); a plant or a scenario alone, or for double precision; and single
        precision that differs too much, or is not compared, without ``accept``. Nothing is written
        then.
    """
    check_folder(folder, checks.flag("overwrite", overwrite))
    text, values = _written(controller, name, precision)
    single = precision == "single" or controller_source.is_in_single(controller)
    comparison = checked_comparison(controller, single, plant, scenario, accept)
    templates = resources.files("quell.export") / "templates"
    readme = fill((templates / "structured_text.md").read_text("utf-8"), values)
    files = write_folder(folder, {f"{name}.st": text, "README.md": readme}, overwrite)
    return FunctionBlock(files, comparison)


def st_source(controller: Any, name: str = "controller", precision: str = "double") -> str:
    """Return the text that ``st`` writes as ``NAME.st``.

    Raises
    ------
    ValueError
        as ``st``, but for the folder.
    """
    return _written(controller, name, precision)[0]


def _written(controller: Any, name: str, precision: str) -> tuple[str, dict[str, object]]:
    """Return the function block, and the values of its README."""
    check_controller(controller, several=True)
    single = checks.one_of("precision", precision, ("double", "single")) == "single"
    given = controller_source.in_double_precision(controller)
    if isinstance(given, Axes):
        raise TranslationError(
            f"controller has {controller.outputs} axes: a function block is of one u and one y; "
            "export each axis by itself as an ADRC"
        )
    if isinstance(given, StateFeedback):
        raise TranslationError(
            "controller is StateFeedback: a function block is of one u and one y; use --to c"
        )
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z](_?[A-Za-z0-9])*", name):
        rule = "must be a letter, and then letters, digits and single _, for Structured Text"
        raise TranslationError(f"name = {name!r}: {rule}")
    checked_name(name, "Structured Text")
    learner = getattr(without_prefilters(given), "learner", None)
    if not isinstance(learner, NoLearner | None):
        raise TranslationError(
            f"learner = {type(learner).__name__}: learners have no Structured Text; leave it out "
            "(learner=None), or use --to c"
        )
    _check_limits(controller)
    source = controller_source.c_source(
        controller, name, precision="single" if single else "double"
    )
    if source.externals:
        raise TranslationError(
            f"controller calls {', '.join(source.externals)} in C: has no Structured Text; leave "
            "the function out, or use --to c"
        )
    try:
        block = _Block(source)
        return block.text(controller), block.values(controller)
    except TranslationError as error:
        kind = type(controller_source.in_double_precision(controller)).__name__
        raise TranslationError(
            f"controller = {kind}: {error}; take a controller without the part that needs it, or "
            "--to c"
        ) from None


def _check_limits(controller: Any) -> None:
    """Raise a ``ValueError`` for a u without limits: Structured Text has no infinity."""
    path = controller_source.limits_path(controller)
    if not path:
        return
    limits = controller_source.at_path(controller_source.parameters_of(controller), path)
    low, high = float(limits.low), float(limits.high)
    if not (np.isfinite(low) and np.isfinite(high)):
        raise TranslationError(
            f"u_min = {low:g}, u_max = {high:g}: Structured Text has no infinite numbers; give the "
            "controller both limits of u, which the output card has in any case"
        )


class _Block:
    """Writer of a function block."""

    def __init__(self, source: CSource) -> None:
        self.source, name = source, source.name
        self.file = CFile(source.header, source.source)
        self.given = source.given
        inputs = [(each, "REAL") for each in (self.given, "y", *source.further)]
        if "track" in source.operations:
            inputs += _MANUAL
        self.inputs = (*inputs, *_APPLIED, *_RESET)
        taken = (name, "u", "status", "SEL", *(each for each, _ in self.inputs))
        self.writer = Translator(self.file, source.precision == "single", taken)
        declared = self.file.constants[f"{name}_default_parameters"][1]
        self.parameters = Record(f"{name}_parameters", "", "parameter", declared)  # type: ignore[arg-type]
        self.state = Record(f"{name}_state", "", "state")
        self.state.members["parameters"] = self.parameters
        kind = Whole()
        kind.use("DWORD")
        self.status = Node(kind, lambda: "status", 9, True)
        self._write()

    # ---- The body ----

    def _write(self) -> None:
        writer, source = self.writer, self.source
        started = writer.variable("initialised", "bool", "state")
        self._initial, lines = writer.captured(self._write_initial)
        self.initial_lines = lines
        self.started = started
        writer.emit("IF limited THEN")
        self._within(lambda: self._operation("applied", ["u_limited"]))
        writer.emit("END_IF;")
        writer.emit("IF restart THEN")
        self._within(lambda: self._operation("reset", []))
        writer.emit("END_IF;")
        given = [self.given, "y"]
        u = Node("real", lambda: "u", 9, True)
        if "track" in source.operations:
            was = writer.variable("was_manual", "bool", "state")
            writer.emit("IF manual THEN")
            self._within(lambda: self._operation("track", [*given, "u_manual", *source.further]))
            self._within(lambda: writer.assign(u, self._applied(self.state)))
            writer.emit("ELSE")
            writer.emit(lambda: f"    IF {_text(was)} THEN")
            self._within(lambda: self._operation("hand_over", []), 2)
            writer.emit("    END_IF;")
            self._within(lambda: self._operation("step", [*given, *source.further], u))
            writer.emit("END_IF;")
            writer.emit(lambda: f"{_text(was)} := manual;")
        else:
            self._operation("step", [*given, *source.further], u)
        self._operation("status", [], self.status)

    def _within(self, work: Callable[[], Any], depth: int = 1) -> None:
        self.writer.indented(work, depth)

    def _write_initial(self) -> None:
        """Write what the state is before the first sample."""
        function = self.file.function(f"{self.source.name}_init")
        kept = tuple(
            each
            for each in function.body
            if not isinstance(each, Evaluate)
            and not (isinstance(each, Assign) and isinstance(each.target, Member)
                     and each.target.name == "parameters")
        )  # fmt: skip
        self.writer.run(function.name, {"state": self.state}, kept)

    def _operation(self, operation: str, given: list[str], result: Node | None = None) -> None:
        """Write an operation of the C code, with variables of the function block."""
        function = self.file.function(f"{self.source.name}_{operation}")
        nodes = [Node("real", lambda each=each: each, 9, True, True) for each in given]  # type: ignore[misc]
        found = self.writer.call(function, [self.state, *nodes], None)
        if result is not None and isinstance(found, Node):
            self.writer.assign(result, found)

    def _applied(self, state: Record) -> Node:
        """Return the variable with the u that acts, as the observer knows it.

        In manual operation it is ``u_manual``, or the u before where that is no number.
        """
        names = [each.name for each in self.file.structs[state.struct]]
        inner = next(each for each in ("u", "compensator", "controller", "loop") if each in names)
        found = self.writer.member(state, inner)
        if isinstance(found, Record):
            return self._applied(found)
        if not isinstance(found, Node):
            raise AssertionError
        return found

    # ---- The text ----

    def text(self, controller: Any) -> str:
        """Return the function block."""
        writer, real = self.writer, self.writer.real
        body = writer.text()
        first = [line() for line in writer.first]
        first += [f"{'    ' * depth}{line()}" for depth, line in self.initial_lines]
        started = _text(self.started)
        before = ""
        if first:
            inner = "".join(f"        {line}\n" for line in first)
            before = f"    IF NOT {started} THEN\n{inner}        {started} := TRUE;\n    END_IF;\n"
        used = {each.name for each in writer.variables["state"]}
        if not first and started in used:
            writer.variables["state"] = [
                each for each in writer.variables["state"] if each.name != started
            ]
        kind = type(controller_source.in_double_precision(controller)).__name__
        inputs = "".join(
            f"        {name} : {real if of == 'REAL' else of};\n" for name, of in self.inputs
        )
        sections = [
            f"(* {kind} in {real}, one sample every {float(controller.dt)!r} s: call it at this\n"
            "   interval, from a cyclic task. Generated by quell from code that simulates it. *)\n"
            f"FUNCTION_BLOCK {self.source.name}\n",
            f"    VAR_INPUT\n{inputs}    END_VAR\n",
            f"    VAR_OUTPUT\n        u : {real};\n        status : DWORD;\n    END_VAR\n",
            self._variables("VAR CONSTANT", "constant"),
            self._variables("VAR", "parameter"),
            self._variables("VAR", "state"),
            self._variables("VAR_TEMP", "local"),
            "\n",
            before,
            "".join(f"    {line}\n" for line in body.splitlines()),
            "END_FUNCTION_BLOCK\n",
        ]
        return "".join(sections)

    def _variables(self, head: str, section: str) -> str:
        found = self.writer.variables[section]
        if not found:
            return ""
        lines = [line for each in found for line in self._declared(each)]
        return f"    {head}\n" + "".join(f"        {line}\n" for line in lines) + "    END_VAR\n"

    def _declared(self, each: Variable) -> list[str]:
        kind = self.writer.kind_name(each.kind)
        if each.shape:
            kind = f"ARRAY[{', '.join(f'0..{n - 1}' for n in each.shape)}] OF {kind}"
        value = f" := {each.value()}" if each.value is not None else ""
        return wrapped(f"{each.name} : {kind}{value};")

    def values(self, controller: Any) -> dict[str, object]:
        """Return the values of the README."""
        has_manual = "track" in self.source.operations
        return {
            "name": self.source.name,
            "real": self.writer.real,
            "dt": repr(float(controller.dt)),
            "given": self.given,
            "given_text": "reference" if self.given == "r" else "u of another controller",
            "kind": type(controller_source.in_double_precision(controller)).__name__,
            "further": "".join(
                f"| `{each}` | {_meaning(each)} |\n" for each in self.source.further),
            "manual": "| `manual`, `u_manual` | manual operation: u is `u_manual`, which is NOT "
                "limited here, so limit it before; for no number u is the one before. The next "
                "sample without `manual` continues from it |\n" if has_manual else "",
        }  # fmt: skip


def _meaning(name: str) -> str:
    """Return what a further input of a step is."""
    kind, _, number = name.rpartition("_")
    if kind == "signal":
        return f"signal {number} that the gains follow"
    return f"derivative {name[1:]} of the reference, fed forward"


def _text(place: Place) -> str:
    if not isinstance(place, Node):
        raise AssertionError
    return place.text()
