"""The two C files of a controller: of one u and one y, or of several in arrays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.allocation import ActuatorLimits
from quell.controllers.axes import Axes, hand_over_all
from quell.controllers.base import (
    Limits,
    change_parameters,
    check_controller,
    control,
    reset_loop,
    set_axis_held,
    set_held,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.bumpless import samples_to_settle
from quell.controllers.compensated import compensating_part, takes_control
from quell.controllers.held import HeldDesign, rests_at_y
from quell.controllers.memory import images_of, learned_state
from quell.controllers.prefilters import Prefiltered, stopping_point, without_prefilters
from quell.controllers.safe_set import SafeSetDesign
from quell.controllers.several import control_all
from quell.controllers.shaped_references import are_shaped, plan_stops, stop_of_moves
from quell.controllers.single import SinglePrecision, in_single_precision
from quell.controllers.state_space import StateFeedback
from quell.export import axes_source, c_files
from quell.export.axes_source import (
    each_axis,
    estimate_lines_of_axes,
    estimate_structs_of_axes,
    places_of_axes,
)
from quell.export.c_files import CFiles, CSource, check_parts, translated
from quell.export.estimates import enums, estimate_lines, estimate_struct
from quell.export.translate.structs import Findings, arrays_of
from quell.export.translate.text import Array, Number, TranslationError, Value, checked_name
from quell.types import Channels

# ---- The parts of a controller that exports look at, in double or single precision ----


def in_double_precision(controller: Any) -> Any:
    """Return the controller, or the one in double precision that it was made from."""
    return controller.controller if is_in_single(controller) else controller


def is_in_single(controller: Any) -> bool:
    """Return whether a controller is one of ``in_single_precision``."""
    return isinstance(controller, SinglePrecision)


def parameters_of(controller: Any) -> Any:
    """Return the parameters of the kernels, in the controller's precision."""
    parameters = controller.parameters
    return parameters.controller if is_in_single(controller) else parameters


def limits_path(controller: Any) -> str:
    """Return where the parameters have the limits of u, as ``controller.limits``; or nothing."""
    parameters, path = parameters_of(controller), ""
    while True:
        fields = getattr(parameters, "_fields", ())
        for name in fields:
            if isinstance(getattr(parameters, name), Limits | ActuatorLimits):
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
    controller = in_double_precision(controller)
    if isinstance(controller, Axes | StateFeedback):
        what = "several axes take" if isinstance(controller, Axes) else "StateFeedback takes"
        raise TranslationError(
            f"resolution = {resolution!r}: {what} y in its unit; count turns as integers before, "
            "and hand over differences to a position near the work"
        )
    checks.positive("resolution", resolution, "y-unit per count")
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


# ---- What is exported: parameters and state in a precision, and the kernels ----


class Kernels(NamedTuple):
    """Kernels behind the public functions: of one u and one y, or of arrays of them."""

    step: Any
    applied: Any
    start: Any
    track: Any
    hand_over: Any
    set_held: Any


_OF_ONE = Kernels(
    control, c_files.set_applied, c_files.start_from, c_files.track, c_files.hand_over, set_held
)
_OF_SEVERAL = Kernels(
    control_all,
    axes_source.set_applied_controls,
    axes_source.start_axes_from,
    axes_source.track_axes,
    hand_over_all,
    set_axis_held,
)


class Parts(NamedTuple):
    """The parts of a controller that are exported.

    Attributes
    ----------
    controller
        in double precision: what describes it.
    parameters, state
        of the kernels in their precision, the state before the first sample with what was learned.
    kernels
        that are called.
    sizes
        numbers of r, y and u where they are arrays; None for one of each.
    counts
        of each reference: derivatives, and signals of a schedule, that a step takes.
    members
        names of several axes in C.
    """

    controller: Any
    parameters: Any
    state: Any
    kernels: Kernels
    sizes: tuple[int, int, int] | None
    counts: tuple[int, ...]
    members: tuple[str, ...]

    @property
    def single(self) -> bool:
        """Whether the state is in single precision."""
        return any(array.dtype == np.float32 for array in arrays_of(self.state))

    @property
    def compensating(self) -> tuple[Any, ...]:
        """The ADRCs and compensators, whose observers need time to settle."""
        if self.sizes is not None:
            return tuple(self.controller.axes)
        found = compensating_part(without_prefilters(self.controller))
        return () if found is None else (found,)


def parts_of(controller: Any, precision: str = "double") -> Parts:
    """Return what is exported of a controller, with a state of its own at each call.

    Raises
    ------
    ValueError
        for what single precision can not do.
    """
    if precision == "single":
        controller = in_single_precision(controller)
    described = in_double_precision(controller)
    parameters, state = parameters_of(controller), learned_state(controller)
    if isinstance(described, Axes | StateFeedback):
        counts = described.derivatives
        sizes = (len(counts), described.outputs, described.inputs)
        members = axes_source.names_in_c(described.names)
        return Parts(described, parameters, state, _OF_SEVERAL, sizes, counts, members)
    count = int(getattr(described, "external_signals", 0))
    if not isinstance(described, Prefiltered):  # it makes the derivatives itself
        count += int(getattr(described, "derivatives", 0))
    return Parts(described, parameters, state, _OF_ONE, None, (count,), ())


# ---- The two C files of a controller ----

# What the header says of functions, where that is not the same for one u and several.
_OF_ONE_TEXTS = {
    "title": "linked into one program, and one controller may have several states. Generated by\n"
    "quell from the kernels that simulate it.",
    "step": "return the control signal u for WHAT and measurement y.\n\n"
    "ABOUTA value that is not finite is replaced; the status says so. The controller assumes\n"
    "that u is applied until the next sample.",
    "applied": "Set the control signal that was really applied since the last step.",
    "start": "Start at a plant that rests at y under u: the next step continues from u.\n\n"
    "GIVEN is WHAT of the next step. What was learned is kept. The observer takes\n"
    "SAMPLES samples to settle: do not call this in an interrupt. If y or u is not\n"
    "finite nothing changes but the status; an GIVEN that is not finite is USUAL.",
    "track": "Return the control signal that the controller would have applied. A u that is not\n"
    "finite is the one before; the status says so.",
    "set_held": "Set whether the plant is held, by a brake for instance: u does not act until it "
    "is not.\n\nCall it when that changes. While it is held nothing winds up: the release makes no "
    "bump.",
    "retune": ", without a jump of u.\n\n"
    "They must stay in memory. To change a limit, copy the default parameters.",
    "status": "Return the flags of the last sample, see enum NAME_flag.",
}
_OF_AXES_TEXTS = {
    "title": "linked into one program, and one controller may have several states. Arrays are the\n"
    "caller's: r and y have a number for each axis [y-unit of the axis], u one for each\n"
    "actuator [u-unit]; r, y and u must be different arrays. Generated by quell from the\n"
    "kernels that simulate it.",
    "step": "write the control signals u for references r and measurements y.\n\n"
    "ABOUTA value that is not finite is replaced; the status says so. The controller assumes\n"
    "that u is applied until the next sample.",
    "applied": "Set the control signals that were really applied since the last step.",
    "start": "Start at a machine that rests at y under u: the next step continues from u.\n\n"
    "r are the references of the next step. What was learned is kept. The observers take\n"
    "SAMPLES samples to settle: do not call this in an interrupt. If a y or\n"
    "a u is not finite nothing changes but the status; an r that is not finite is y.",
    "track": "A u that is not finite is the one before; the status says so.",
    "set_held": "Set whether an axis is held, by a brake for instance: its v does not act until it "
    "is not.\n\naxis is its place, see enum NAME_axis; there is no other effect of another\n"
    "number. Call it when that changes. While it is held nothing winds up.",
    "retune": ", without a jump of what the axes ask for.\n\n"
    "They must stay in memory. To change a limit, copy the default parameters. B0 stays.",
    "status": "Return the flags of the last sample, of all axes and actuators, see enum NAME_flag.",
}
_OF_COMPENSATORS_TEXTS = _OF_AXES_TEXTS | {
    "title": "linked into one program, and one controller may have several states. Arrays are the\n"
    "caller's: y has a number for each axis [y-unit of the axis], u_0 and u one for each\n"
    "actuator [u-unit]; u_0, y and u must be different arrays. Generated by quell from the\n"
    "kernels that simulate it.",
    "step": "write u for the control signals u_0 of other controllers and measurements y.\n\n"
    "A value that is not finite is replaced; the status says so. The controller assumes\n"
    "that u is applied until the next sample.",
    "start": "Start at a machine that rests at y under u: the next step continues from u.\n\n"
    "u_0 changes nothing. What was learned is kept. The observers take\n"
    "SAMPLES samples to settle: do not call this in an interrupt. If a y or\n"
    "a u is not finite nothing changes but the status.",
}
_OF_FEEDBACK_TEXTS = _OF_AXES_TEXTS | {
    "title": "linked into one program, and one controller may have several states. Arrays are the\n"
    "caller's: r has a number for each controlled output, y one for each measurement, u one\n"
    "for each actuator [u-unit]; r, y and u must be different arrays. Generated by quell from\n"
    "the kernels that simulate it.",
    "step": "write the control signals u for references r and measurements y.\n\n"
    "An r that is not finite is the one before. A y that is not finite is missing, and the others\n"
    "correct; before the first step with all of them u is that of rest. The status says so. The\n"
    "controller assumes that u is applied until the next sample.",
    "start": "Start at a plant that rests at y under u.\n\n"
    "r are the references until a step has others. If a y or a u is not finite nothing\n"
    "changes but the status; an r that is not finite is the one before.",
    "retune": ".\n\nThey must stay in memory. To change a limit, copy the default parameters; u "
    "jumps where the gain is another one.",
    "status": "Return the flags of the last sample, see enum NAME_flag.",
}


def c_source(
    controller: Any,
    name: str = "controller",
    *,
    precision: str = "double",
    resolution: float | None = None,
) -> CSource:
    """Return the C code of a controller, translated from the kernels that simulate it.

    Parameters
    ----------
    controller
        any controller whose kernels are compiled; its parameters and its state before the first
        sample are written. One of ``controllers.in_single_precision`` becomes code in ``float``,
        and the functions of ``quell.Axes`` take arrays.
    name
        begins all public names.
    precision
        ``"double"`` or ``"single"``, in which real numbers are ``float``.
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
    checked_name(name)
    check_parts(controller)
    checks.one_of("precision", precision, ("double", "single"))
    if resolution is not None:
        check_counts(controller, resolution)
    parts = parts_of(controller, precision)
    return translated(lambda findings: _Writer(parts, name, findings, resolution).write())


class _Signal(NamedTuple):
    """An argument of a public function: a number, or an array of ``size``."""

    name: str
    size: int | None
    real: str

    @property
    def declared(self) -> str:
        """The argument in a function's head."""
        if self.size is None:
            return f"{self.real} {self.name}"
        return f"const {self.real} {self.name}[{self.size}]"

    @property
    def value(self) -> Value:
        """The argument of a kernel."""
        if self.size is None:
            return Value(Number.REAL, self.name)
        return Value(Array((self.size,), Number.REAL), self.name, root=self.name)


def _entries(name: str, count: int) -> tuple[str, int]:
    """Return the channel of an array in the estimate."""
    return (name, count) if count > 1 else (f"{name}[0]", 1)


class _Writer:
    """Writer of the public functions of one controller."""

    def __init__(
        self, parts: Parts, name: str, findings: Findings, resolution: float | None
    ) -> None:
        self.parts, self.name, self.resolution = parts, name, resolution
        self.described, self.kernels = parts.controller, parts.kernels
        self.files = CFiles(name, parts.parameters, parts.state, findings)
        names = getattr(self.described, "names", ())
        self.images = images_of(parts.parameters, parts.state, float(self.described.dt), names)
        self.real = self.files.real
        self.state = f"{name}_state *state"
        self.one = parts.sizes is None
        self.is_feedback = isinstance(self.described, StateFeedback)
        self.texts = _OF_FEEDBACK_TEXTS if self.is_feedback else _OF_AXES_TEXTS
        self.texts = _OF_ONE_TEXTS if self.one else self.texts
        # What a step takes beside y: of a compensator alone the control signal u_0.
        self.given = "u_0" if takes_control(self.described) else "r"
        if isinstance(self.described, Axes) and self.described.takes_u_0:
            self.given, self.texts = "u_0", _OF_COMPENSATORS_TEXTS
        sizes = parts.sizes or (None, None, None)
        self.r, self.y, self.u = (
            _Signal(each, size, self.real)
            for each, size in zip((self.given, "y", "u"), sizes, strict=True)
        )
        design = self.described.parameters
        has_own = isinstance(self.described, Prefiltered)  # derivatives, from its prefilter
        self.moves = has_own and type(design.prefilter) in stopping_point.implementations
        self.moves = self.moves or plan_stops(getattr(design, "given", None))
        self.signals = int(getattr(self.described, "external_signals", 0))
        self.derivatives = max(parts.counts) - self.signals
        # They are arguments of each step: whoever forgets them gets an error of the compiler.
        self.names = [f"r{i + 1}" for i in range(self.derivatives)]
        self.names += [f"signal_{i + 1}" for i in range(self.signals)]
        self.arguments = "".join(
            f", {_Signal(each, self.r.size, self.real).declared}" for each in self.names
        )

    def write(self) -> CSource:
        """Return the files."""
        files, observing = self.files, self.parts.compensating
        files.add_init()
        self._add_step()
        if self.resolution is not None:
            self._add_counts(self.resolution)
        if observing or self.is_feedback:
            self._add_start([samples_to_settle(each.observer) for each in observing])
        if observing:
            self._add_manual_operation()
            if all(rests_at_y(each.observer) for each in observing):
                self._add_held()
        self._add_retune()
        self._add_reset()
        files.add_memory(self.images, files.call(reset_loop, *files.both))
        if self.moves:
            self._add_stop()
        channels = self._add_estimate()
        defines = [
            f"#define {self.name.upper()}_{each}" for each in (
                f"SAMPLE_TIME {float(self.described.dt)!r} /* [s] */",
                f"MEMORY_SIZE {self.images.size} /* [bytes] */",
                *self._sizes(observing),
            )
        ]  # fmt: skip
        source = files.write(self._title(), channels, defines, self.derivatives, self.signals)
        return replace(source, axes=self.parts.members, sizes=self.parts.sizes, given=self.given)

    def _sizes(self, observing: tuple[Any, ...]) -> Iterator[str]:
        """Yield the defines of the sizes."""
        if self.is_feedback:
            yield f"REFERENCES {self.r.size} /* numbers in r */"
            yield f"MEASUREMENTS {self.y.size} /* numbers in y */"
            yield f"ACTUATORS {self.u.size} /* numbers in u */"
        elif self.parts.sizes is not None:
            both = "y" if self.given == "u_0" else "r and y"
            yield f"AXES {self.y.size} /* numbers in {both} */"
            yield f"ACTUATORS {self.u.size} /* numbers in u */"
        elif observing:
            yield f"ORDER {observing[0].observer.order}"

    def _title(self) -> list[str]:
        dt, name = repr(float(self.described.dt)), self.name
        precision = "float" if self.files.single else "double"
        what = type(self.described).__name__
        if self.is_feedback:
            what += f" of {self.y.size} measurements with {self.u.size} actuators"
        elif not self.one:
            what = f"{self.y.size} axes with {self.u.size} actuators"
        return [
            f"Controller {name}: {what} in {precision}, one sample every {dt} s.",
            "",
            f"Call {name}_init once, then {name}_step every {dt} s. Several controllers may be",
            *self._text("title").split("\n"),
        ]

    # ---- Functions ----

    def _text(self, operation: str, **words: str) -> str:
        """Return what the header says of a function, with its words filled in."""
        text = self.texts[operation]
        for word, value in {**words, "NAME": self.name}.items():
            text = text.replace(word, value)
        return text

    def _add_step(self) -> None:
        files, head = self.files, f"{self.state}, {self.r.declared}, {self.y.declared}"
        given, u = [self.r.value, self.y.value], self.u.value
        if self.one:
            kind, end, result = self.real, ")", "return "
        else:
            given.append(replace(u, mutable=True))
            kind, end, result = "void", f", {self.real} u[{self.u.size}])", ""
        usual = self.given == "r"
        about = self._about_target() + self._about_derivatives()
        what = "reference r" if usual else "the control signal u_0 of another controller"
        files.add(
            "step",
            f"{kind} NAME({head}{self.arguments}{end}",
            f"Take one sample: {self._text('step', WHAT=what, ABOUT=about)}",
            *self._derivatives(),
            f"    {result}{files.call(self.kernels.step, *files.both, *given)};",
        )
        files.add(
            "applied",
            f"void NAME({self.state}, {self.u.declared})",
            f"{self._text('applied')}\n\n"
            "One that is not finite is ignored; the status says so, until the next step.",
            f"    {files.call(self.kernels.applied, *files.both, u)};",
        )

    def _about_target(self) -> str:
        """Return the sentence on the reference of a controller that plans moves."""
        if not self.moves:
            return ""
        if not self.one:
            return (
                "r of an axis with a profile generator is the target of a move within the limits\n"
                "of its prefilter in parameters->given; it may change in any sample.\n"
            )
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
            at = "" if self.one else " of each axis"
            text = f"{', '.join(names)} {verb} {primes}{at} at this sample, fed forward.\n"
        if self.signals:
            verb = "are the signals" if self.signals > 1 else "is the signal"
            text += f"{', '.join(self.names[self.derivatives :])} {verb} that the gains follow.\n"
        return text

    def _derivatives(self) -> list[str]:
        """Return the lines that hand the last arguments of a step over."""
        declared: list[str] = []
        calls: list[str] = []
        if not any(self.parts.counts):
            return []
        axes = [self.files.both] if self.one else each_axis(self.files, len(self.parts.counts))
        for i, (owner, count) in enumerate(zip(axes, self.parts.counts, strict=True)):
            if count:
                name = "derivatives" if self.one else f"derivatives_{i + 1}"
                given = Value(Array((count,), Number.REAL), name, root=name)
                call = self.files.call(set_reference_derivatives, *owner, given)
                place = "" if self.one else f"[{i}]"
                values = ", ".join(f"{each}{place}" for each in self.names[:count])
                declared.append(f"    const {self.real} {name}[{count}] = {{{values}}};")
                calls.append(f"    {call};")
        return [*declared, *calls]

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

    def _add_start(self, counts: list[int]) -> None:
        files, given, usual = self.files, self.given, self.given == "r"
        samples, lines = Value(Number.INT, str(counts[0] if counts else 0)), []
        if counts and not self.one:
            samples = Value(Array((len(counts),), Number.INT), "samples", root="samples")
            each = ", ".join(map(str, counts))
            lines = [f"    static const int samples[{len(counts)}] = {{{each}}};", ""]
        what, rest = ("the reference", "y") if usual else ("that", "u")
        words = {"GIVEN": given, "WHAT": what, "USUAL": rest, "SAMPLES": str(2 * sum(counts))}
        arguments = self.y.value, self.u.value, self.r.value
        call = files.call(self.kernels.start, *files.both, samples, *arguments)
        files.add(
            "start",
            f"void NAME({self.state}, {self.y.declared}, {self.u.declared}, {self.r.declared})",
            self._text("start", **words),
            *lines,
            f"    {call};",
        )

    def _add_manual_operation(self) -> None:
        files, head = self.files, f"{self.state}, {self.r.declared}, {self.y.declared}"
        kind, result = (self.real, "return ") if self.one else ("void", "")
        given = self.r.value, self.y.value, self.u.value
        files.add(
            "track",
            f"{kind} NAME({head}, {self.u.declared}{self.arguments})",
            "Take one sample in manual operation: u is applied, unlimited, until the next sample."
            f"\n\n{self._text('track')}",
            *self._derivatives(),
            f"    {result}{files.call(self.kernels.track, *files.both, *given)};",
        )
        files.add(
            "hand_over",
            f"bool NAME({self.state})",
            "End manual operation: the next step continues from the u of the last one.\n\n"
            "Return false before the first sample: then nothing has changed.",
            f"    return {files.call(self.kernels.hand_over, *files.both)};",
        )

    def _add_held(self) -> None:
        files, which, head = self.files, [], ""
        if not self.one:
            which, head = [Value(Number.INT, "axis")], "int axis, "
        call = files.call(self.kernels.set_held, *files.both, *which, Value(Number.BOOL, "held"))
        files.add(
            "set_held",
            f"void NAME({self.state}, {head}bool held)",
            self._text("set_held"),
            f"    {call};",
        )

    def _add_retune(self) -> None:
        files = self.files
        new = Value(files.design.kind, "parameters", root="new")
        call = files.call(change_parameters, files.design, new, files.memory)
        files.add(
            "retune",
            f"void NAME({self.state}, const {self.name}_parameters *parameters)",
            f"Continue with other parameters of the same structure{self._text('retune')}",
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
            self._text("status"),
            f"    return {files.call(status_flags, *files.both)};",
        )

    def _add_stop(self) -> None:
        files = self.files
        if not self.one:
            r = replace(self.r.value, mutable=True)
            files.add(
                "stopping_point",
                f"void NAME(const {self.state}, {self.real} r[{self.r.size}])",
                "Write where the moves can stop soonest: they do if this is r of the next steps.\n"
                "Of an axis that plans no moves it is the reference that it followed last.",
                f"    {files.call(stop_of_moves, *files.both, r)};",
            )
            return
        files.add(
            "stopping_point",
            f"{self.real} NAME(const {self.state})",
            "Return where the move can stop soonest: it does if this is r of the next steps.",
            f"    return {files.call(c_files.stop_of_move, *files.both)};",
        )

    def _add_estimate(self) -> Channels:
        """Add the function that returns the estimate, and its struct; return its channels."""
        files, name, real, members = self.files, self.name, self.real, self.parts.members
        own = [
            tuple(each for each in part.channels if each[1])
            for part in (self.described.axes if members else (self.described,))
        ]
        files.enums += enums(name, tuple(each for channels in own for each in channels))
        if members:
            shaped = are_shaped(self.described.prefilters)
            channels: Channels = (_entries("v", len(own)), ("status", 1))
            for member, each in zip(members, own, strict=True):
                channels += tuple((f"{member}.{channel}", width) for channel, width in each)
            channels += (_entries("r_shaped", len(own)),) if shaped else ()
            files.enums += places_of_axes(name, members)
            files.structs += estimate_structs_of_axes(name, members, own, real, shaped)
            total, lines = estimate_lines_of_axes(files, members, own, shaped)
        else:
            (channels,) = own
            doc = "What a controller knows after a sample."
            files.structs += estimate_struct(f"{name}_estimate", channels, real, doc)
            total = sum(width for _, width in channels)
            row = Value(Array((total,), Number.REAL), "row", root="row", mutable=True)
            lines = [f"    {files.call(write_row, *files.both, row)};"]
            lines += estimate_lines(files, "estimate", channels)
        files.add(
            "get_estimate",
            f"{name}_estimate NAME(const {self.state})",
            "Return what the controller knows after the last sample.",
            f"    {real} row[{total}] = {{0}};",
            f"    {name}_estimate estimate;",
            *lines,
            "    return estimate;",
        )
        return channels
