"""The two C files of a controller."""

from __future__ import annotations

from typing import Any

import numpy as np

from quell import checks
from quell.controllers.axes import Axes
from quell.controllers.base import (
    Limits,
    change_parameters,
    check_controller,
    control,
    reset_loop,
    set_held,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.compensated import compensating_part, takes_control
from quell.controllers.compensator import samples_to_settle
from quell.controllers.held import HeldDesign, rests_at_y
from quell.controllers.memory import images_of, learned_state
from quell.controllers.prefilters import Prefiltered, stopping_point, without_prefilters
from quell.controllers.safe_set import SafeSetDesign
from quell.controllers.single import SinglePrecision
from quell.export import c_files
from quell.export.axes_source import source_of_axes
from quell.export.c_files import CFiles, CSource, check_parts, refuse_state_feedback, translated
from quell.export.estimates import enums, estimate_lines, estimate_struct
from quell.export.translate.structs import Findings
from quell.export.translate.text import Array, Number, TranslationError, Value
from quell.types import Channels

# ---- The parts of a controller that exports look at, in double or single precision ----


def in_double_precision(controller: Any) -> Any:
    """Return the controller, or the one in double precision that it was made from."""
    return controller.controller if isinstance(controller, SinglePrecision) else controller


def parameters_of(controller: Any) -> Any:
    """Return the parameters of the kernels, in the controller's precision."""
    parameters = controller.parameters
    return parameters.controller if isinstance(controller, SinglePrecision) else parameters


def limits_path(controller: Any) -> str:
    """Return where the parameters have the limits of u, as ``controller.limits``; or nothing."""
    parameters, path = parameters_of(controller), ""
    while True:
        fields = getattr(parameters, "_fields", ())
        for name in fields:
            if isinstance(getattr(parameters, name), Limits):
                return f"{path}{name}"
        part = next((name for name in ("compensator", "controller") if name in fields), None)
        if part is None:
            return ""
        parameters, path = getattr(parameters, part), f"{path}{part}."


def at_path(parameters: Any, path: str) -> Any:
    """Return the part of nested parameters at a path such as ``controller.limits``."""
    for name in path.split("."):
        parameters = getattr(parameters, name)
    return parameters


# ---- The check that a controller may take y as counts from an origin that moves ----

# Samples of the trial, and the largest change of u that is rounding, relative to the largest u.
_SAMPLES, _ROUNDING = 200, 1e-6


def check_counts(controller: Any, resolution: float) -> None:
    """Check that another origin of y and r does not change a controller.

    The origin is moved in each sample of a trial, in double precision, and u is compared with that
    of the controller whose origin stays.

    Raises
    ------
    TranslationError
        if u changes: for a model with a position in it, such as a spring; for a learner; and for
        controllers whose origin can't be moved.
    """
    checks.positive("resolution", resolution, "y-unit per count")
    controller = in_double_precision(controller)
    design = controller.parameters
    if type(design) not in c_files.move_origin.implementations:
        raise TranslationError(
            f"resolution = {resolution!r}: {type(controller).__name__} can't take y as counts; an "
            "ADRC without prefilter can"
        )
    fixed, moved = controller.initial_state(), controller.initial_state()
    random, origin, y = np.random.default_rng(1), 0.0, 0.0
    u = np.empty((_SAMPLES, 2))
    with np.errstate(all="ignore"):
        for k in range(_SAMPLES):
            r = float(np.sin(0.05 * k))
            y += 0.1 * (r - y) + 0.01 * float(random.standard_normal())
            u[k, 0] = control(design, fixed, r, y)
            c_files.move_origin(design, moved, y - origin)
            origin = y
            u[k, 1] = control(design, moved, r - y, 0.0)
    same = np.max(np.abs(u[:, 1] - u[:, 0])) <= _ROUNDING * np.max(np.abs(u[:, 0]))
    parts = (getattr(design, name, None) for name in ("safe_set", "held"))
    remembers = any(isinstance(part, SafeSetDesign | HeldDesign) for part in parts)
    # What is learned acts much later than in this trial.
    if design.learns or remembers or not same:
        raise TranslationError(
            f"resolution = {resolution!r}: this controller needs the position itself, for a model "
            "with a spring, a learner, a safe set or held; hand over y in its unit (NAME_step)"
        )


# ---- The two C files of a controller ----


def c_source(
    controller: Any, name: str = "controller", *, resolution: float | None = None
) -> CSource:
    """Return the C code of a controller, translated from the kernels that simulate it.

    Parameters
    ----------
    controller
        any controller whose kernels are compiled; its parameters and its state before the first
        sample are written. One of ``controllers.in_single_precision`` becomes code in ``float``,
        ``quell.Axes`` code in ``double`` whose functions take arrays.
    name
        begins all public names.
    resolution
        of an encoder [y-unit per count]: the code then has ``NAME_step_counts``, which takes r and
        y as integers. For controllers that are not changed by another origin of y.

    Raises
    ------
    ValueError
        for what is no controller, and for a name that C can not have.
    TranslationError
        naming a kernel, or a part of the parameters, that has no counterpart in C; and for a
        resolution, if the controller needs the position itself.
    """
    check_controller(controller, several=True)
    refuse_state_feedback(controller)
    if isinstance(controller, Axes):
        if resolution is not None:
            raise TranslationError(
                f"resolution = {resolution!r}: several axes take y in its unit; count turns as "
                "integers before, and hand over differences to a position near the work"
            )
        return source_of_axes(controller, name)
    check_parts(controller)
    if resolution is not None:
        check_counts(controller, resolution)
    return translated(lambda findings: _Writer(controller, name, findings, resolution).write())


class _Writer:
    """Writer of the public functions of one controller."""

    def __init__(
        self, controller: Any, name: str, findings: Findings, resolution: float | None
    ) -> None:
        self.controller, self.name, self.resolution = controller, name, resolution
        self.described = in_double_precision(controller)
        parameters, state = parameters_of(controller), learned_state(controller)
        self.files = CFiles(name, parameters, state, findings)
        self.images = images_of(parameters, state, float(controller.dt))
        self.real = self.files.real
        self.state = f"{name}_state *state"
        has_own = isinstance(self.described, Prefiltered)  # derivatives, from its prefilter
        design = self.described.parameters
        self.moves = has_own and type(design.prefilter) in stopping_point.implementations
        self.derivatives = 0 if has_own else int(getattr(self.described, "derivatives", 0))
        self.signals = int(getattr(self.described, "external_signals", 0))
        # They are arguments of each step: whoever forgets them gets an error of the compiler.
        self.names = [f"r{i + 1}" for i in range(self.derivatives)]
        self.names += [f"signal_{i + 1}" for i in range(self.signals)]
        # What a step takes beside y: of a compensator alone the control signal u_0.
        self.given = "u_0" if takes_control(self.described) else "r"
        self.arguments = "".join(f", {self.real} {each}" for each in self.names)

    def write(self) -> CSource:
        """Return the files."""
        observing = compensating_part(without_prefilters(self.described))
        self.files.add_init()
        self._add_step()
        if self.resolution is not None:
            self._add_counts(self.resolution)
        if observing is not None:
            self._add_start(2 * samples_to_settle(observing.observer))
            self._add_manual_operation()
            if rests_at_y(observing.observer):
                self._add_held()
        self._add_retune()
        self._add_reset()
        self.files.add_memory(self.images, self.files.call(reset_loop, *self.files.both))
        if self.moves:
            self._add_stop()
        channels = tuple((name, width) for name, width in self.controller.channels if width)
        self._add_estimate(channels)
        kind, precision = type(self.described).__name__, "float" if self.files.single else "double"
        dt, name, upper = repr(float(self.controller.dt)), self.name, self.name.upper()
        title = [
            f"Controller {name}: {kind} in {precision}, one sample every {dt} s.",
            "",
            f"Call {name}_init once, then {name}_step every {dt} s. Several controllers may be",
            "linked into one program, and one controller may have several states. Generated by",
            "quell from the kernels that simulate it.",
        ]
        defines = [f"#define {upper}_SAMPLE_TIME {dt} /* [s] */"]
        defines.append(f"#define {upper}_MEMORY_SIZE {self.images.size} /* [bytes] */")
        if observing is not None:
            defines.append(f"#define {upper}_ORDER {observing.observer.order}")
        self.files.enums += enums(name, channels)
        doc = "What a controller knows after a sample."
        self.files.structs += estimate_struct(f"{name}_estimate", channels, self.real, doc)
        return self.files.write(title, channels, defines, self.derivatives, self.signals)

    def _add_step(self) -> None:
        files, real, both = self.files, self.real, self.files.both
        given = self.given
        r, y, u = map(files.number, (given, "y", "u"))
        what = "reference r" if given == "r" else "the control signal u_0 of another controller"
        files.add(
            "step",
            f"{real} NAME({self.state}, {real} {given}, {real} y{self.arguments})",
            f"Take one sample: return the control signal u for {what} and measurement y.\n\n"
            f"{self._about_target()}{self._about_derivatives()}"
            "A value that is not finite is replaced; the status says so. The controller assumes\n"
            "that u is applied until the next sample.",
            *self._derivatives(),
            f"    return {files.call(control, *both, r, y)};",
        )
        files.add(
            "applied",
            f"void NAME({self.state}, {real} u)",
            "Set the control signal that was really applied since the last step.\n\n"
            "One that is not finite is ignored; the status says so, until the next step.",
            f"    {files.call(c_files.set_applied, *both, u)};",
        )

    def _about_target(self) -> str:
        """Return the sentence on the reference of a controller that plans moves."""
        if not self.moves:
            return ""
        return (
            "r is the target of a move within the limits of speed, acceleration and jerk in\n"
            "parameters->prefilter; it may change in any sample, also during a move.\n"
        )

    def _about_derivatives(self) -> str:
        """Return the sentence on the last arguments of a step."""
        text, names = "", self.names[: self.derivatives]
        if names:
            verb = "are the derivatives" if self.derivatives > 1 else "is the derivative"
            primes = ", ".join("r" + "'" * (i + 1) for i in range(self.derivatives))
            text = f"{', '.join(names)} {verb} {primes} at this sample, fed forward.\n"
        if self.signals:
            verb = "are the signals" if self.signals > 1 else "is the signal"
            text += f"{', '.join(self.names[self.derivatives :])} {verb} that the gains follow.\n"
        return text

    def _derivatives(self) -> list[str]:
        """Return the lines that hand the last arguments of a step over."""
        if not self.names:
            return []
        count = len(self.names)
        given = Value(Array((count,), Number.REAL), "derivatives", root="derivatives")
        set_them = self.files.call(set_reference_derivatives, *self.files.both, given)
        values = ", ".join(self.names)
        return [
            f"    const {self.real} derivatives[{count}] = {{{values}}};",
            f"    {set_them};",
        ]

    def _add_counts(self, resolution: float) -> None:
        files, real, write = self.files, self.real, self.files.program.literals.write_real
        moved = f"({real})(int32_t)moved * resolution"
        files.members.append("int32_t origin; /* y is counted from here [counts] */")
        files.includes.append("#include <stdint.h>")
        files.add(
            "step_counts",
            f"{real} NAME({self.state}, int32_t r, int32_t count{self.arguments})",
            f"Take one sample with r and y as encoder counts of {resolution!r} y-units.\n\n"
            f"{self._about_derivatives()}"
            "Differences are taken as integers, which may overflow: the position is always exact.\n"
            "y is then counted from this sample's count: servo_start and servo_track take y and r\n"
            "as differences to state->origin.".replace("servo", self.name),
            f"    static const {real} resolution = {write(resolution)};",
            "    const uint32_t moved = (uint32_t)count - (uint32_t)state->origin;",
            "    const uint32_t ahead = (uint32_t)r - (uint32_t)count;",
            f"    {files.call(c_files.move_origin, *files.both, files.number(moved))};",
            "    state->origin = count;",
            f"    return {self.name}_step(state, ({real})(int32_t)ahead * resolution, "
            f"{write(0.0)}{''.join(f', {each}' for each in self.names)});",
        )

    def _add_start(self, samples: int) -> None:
        files, real = self.files, self.real
        given = self.given
        r, y, u = map(files.number, (given, "y", "u"))
        what = "that" if given == "u_0" else "the reference"
        usual = "u" if given == "u_0" else "y"
        count = Value(Number.INT, str(samples // 2))
        files.add(
            "start",
            f"void NAME({self.state}, {real} y, {real} u, {real} {given})",
            f"Start at a plant that rests at y under u: the next step continues from u.\n\n{given} "
            f"is {what} of the next step. What was learned is kept. The observer takes\n"
            f"{samples} samples to settle: do not call this in an interrupt. If y or u is not\n"
            f"finite nothing changes but the status; an {given} that is not finite is {usual}.",
            f"    {files.call(c_files.start_from, *files.both, count, y, u, r)};",
        )

    def _add_manual_operation(self) -> None:
        files, real = self.files, self.real
        r, y, u = map(files.number, (self.given, "y", "u"))
        files.add(
            "track",
            f"{real} NAME({self.state}, {real} {self.given}, {real} y, {real} u{self.arguments})",
            "Take one sample in manual operation: u is applied, unlimited, until the next sample."
            "\n\nReturn the control signal that the controller would have applied. A u that is not"
            "\nfinite is the one before; the status says so.",
            *self._derivatives(),
            f"    return {files.call(c_files.track, *files.both, r, y, u)};",
        )
        files.add(
            "hand_over",
            f"bool NAME({self.state})",
            "End manual operation: the next step continues from the u of the last one.\n\n"
            "Return false before the first sample: then nothing has changed.",
            f"    return {files.call(c_files.hand_over, *files.both)};",
        )

    def _add_held(self) -> None:
        files = self.files
        held = Value(Number.BOOL, "held")
        files.add(
            "set_held",
            f"void NAME({self.state}, bool held)",
            "Set whether the plant is held, by a brake for instance: u does not act until it is "
            "not.\n\nCall it when that changes. While it is held nothing winds up: the release "
            "makes no bump.",
            f"    {files.call(set_held, *files.both, held)};",
        )

    def _add_retune(self) -> None:
        files = self.files
        new = Value(files.design.kind, "parameters", root="new")
        call = files.call(change_parameters, files.design, new, files.memory)
        files.add(
            "retune",
            f"void NAME({self.state}, const {self.name}_parameters *parameters)",
            "Continue with other parameters of the same structure, without a jump of u.\n\n"
            "They must stay in memory. To change a limit, copy the default parameters.",
            *([f"    {call};"] if call else []),
            "    state->parameters = parameters;",
        )

    def _add_reset(self) -> None:
        files = self.files
        files.add(
            "reset",
            f"void NAME({self.state})",
            "Start from rest at the next sample; what was learned is kept.",
            f"    {files.call(reset_loop, *files.both)};",
        )
        files.add(
            "status",
            f"int NAME(const {self.state})",
            f"Return the flags of the last sample, see enum {self.name}_flag.",
            f"    return {files.call(status_flags, *files.both)};",
        )

    def _add_stop(self) -> None:
        files = self.files
        files.add(
            "stopping_point",
            f"{self.real} NAME(const {self.state})",
            "Return where the move can stop soonest: it does if this is r of the next steps.",
            f"    return {files.call(c_files.stop_of_move, *files.both)};",
        )

    def _add_estimate(self, channels: Channels) -> None:
        files, name, real = self.files, self.name, self.real
        total = sum(width for _, width in channels)
        row = Value(Array((total,), Number.REAL), "row", root="row", mutable=True)
        lines = [f"    {real} row[{total}] = {{0}};", f"    {name}_estimate estimate;"]
        lines.append(f"    {files.call(write_row, *files.both, row)};")
        lines += estimate_lines(files, "estimate", channels)
        files.add(
            "get_estimate",
            f"{name}_estimate NAME(const {self.state})",
            "Return what the controller knows after the last sample.",
            *lines,
            "    return estimate;",
        )
