"""The base class of controllers: a running state to step, save, restore and copy.

A compiled controller step, called from Python one sample at a time.

Numba unpacks a NamedTuple at each call, array by array: 2.7 µs for ten arrays. A packed controller
holds the same parameters and state as the words that compiled code needs, in the memory of one
Python object. A call of the compiled function itself with it, without the look-up of its argument
types, costs a tenth of a microsecond. The words are written from Python, so packing compiles
nothing.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numba import types as nb_types
from numba.extending import NativeValue, intrinsic, models, register_model, unbox
from numpy.typing import NDArray

from quell import checks
from quell.checks import Described
from quell.controllers.base import (
    Limits,
    RateLimit,
    change_parameters,
    changed_limits,
    check_runs_alone,
    control,
    set_applied_control,
)
from quell.controllers.memory import (
    Layout,
    images_of,
    named_arrays,
    read_image,
    start_from_rest,
    written_image,
)
from quell.hints import OF_CONTROLLERS, Hinted
from quell.kernels import dispatch
from quell.kernels.dispatch import compiled_call, dispatcher_for, explain_compile_errors
from quell.kernels.sized import Constant, ConstantFlag, SizedArray, layout_of, type_of


class PackedType(nb_types.Type):
    """The Numba type of a packed controller; ``content`` is that of (parameters, state)."""

    def __init__(self, content: Any) -> None:
        self.content = content
        super().__init__(f"Packed({content})")


register_model(PackedType)(models.OpaqueModel)


class PackedController(bytes):
    """Parameters and state of a controller for compiled code; shares the state's arrays.

    The bytes are the words that Numba passes to a compiled function for them, 8 bytes each.

    Parameters
    ----------
    design, state
        of the controller.
    before
        one with the same state, and with parameters of the same ``layout_of``: then only the new
        parameters are packed.

    Raises
    ------
    TypeError
        if they contain something that compiled code can not receive.
    """

    type: PackedType
    arrays: Any

    def __new__(
        cls, design: Any, state: Any, before: PackedController | None = None
    ) -> PackedController:
        """Pack a controller."""
        kind = PackedType(type_of((design, state))) if before is None else before.type
        parameters = _words(kind.content[0], design)
        rest = _words(kind.content[1], state) if before is None else before[len(parameters) :]
        packed = super().__new__(cls, parameters + rest)
        packed.type, packed.arrays = kind, (design, state)  # keeps the arrays alive
        return packed


def _words(kind: Any, value: Any) -> bytes:
    """Return the words of a value of a Numba type."""
    formats: list[str] = []
    words: list[float] = []

    def add(kind: Any, value: Any) -> None:
        # Questions about a Numba type are slow; those about the value come first.
        if isinstance(value, tuple):
            for part, entry in zip(kind, value, strict=True):
                add(part, entry)
        elif type(kind) in (Constant, ConstantFlag):
            pass  # compiled code knows it
        elif type(kind) is SizedArray:
            formats.append("q")
            words.append(value.ctypes.data)
        elif isinstance(value, np.ndarray):
            formats.append("qqqqq" + 2 * value.ndim * "q")
            owners = (0, 0)  # nothing is counted
            words.extend((*owners, value.size, value.itemsize, value.ctypes.data))
            words.extend((*value.shape, *value.strides))
        elif kind is nb_types.float64:
            formats.append("d")
            words.append(value)
        elif kind is nb_types.float32:
            formats.append("f4x")
            words.append(value)
        elif isinstance(kind, nb_types.Integer | nb_types.Boolean):
            formats.append("Q")
            words.append(int(value) % 2**64)
        elif value is None:
            formats.append("q")
            words.append(0)
        else:
            raise TypeError(
                f"parameters or state contain {value!r}: must be numbers, arrays, or tuples of them"
            )

    add(kind, value)
    return struct.pack("".join(formats), *words)


@unbox(PackedType)
def _address(kind: Any, packed: Any, c: Any) -> Any:
    return NativeValue(c.pyapi.bytes_as_string(packed))


@intrinsic
def unpacked(typing_context: Any, packed: Any) -> Any:
    """Return parameters and state of a packed controller."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        packer = context.get_arg_packer([packed.content])
        arguments = []
        for i, kind in enumerate(packer.argument_types):
            address = builder.gep(values[0], [context.get_constant(nb_types.intp, 8 * i)])
            arguments.append(builder.load(builder.bitcast(address, kind.as_pointer())))
        return packer.from_arguments(builder, arguments)[0]

    return packed.content(packed), generate


@compiled_call
def step_packed(packed: Any, r: float, y: float) -> float:
    """Take one sample; see ``controllers.base.control``."""
    design, state = unpacked(packed)
    return control(design, state, r, y)


def entry_point(dispatcher: Any, packed: PackedController) -> Callable[[Any, float, float], float]:
    """Return the compiled function of ``dispatcher`` for controllers of one type.

    It checks its arguments less than the dispatcher: pass only packed controllers of this type, and
    numbers.
    """
    if dispatch.interpret_all:
        return _step_as_python
    return dispatcher.compile((packed.type, nb_types.float64, nb_types.float64))


def _step_as_python(packed: Any, r: float, y: float) -> float:
    design, state = packed.arrays
    with np.errstate(all="ignore"):  # compiled code does not warn
        return float(control(design, state, r, y))


# A copy makes these again: compiled functions and shared arrays belong to one process.
_NOT_COPIED = ("parameters", "_state", "_arrays", "_packed", "_step", "_axis", "_acts")


@compiled_call
def change_packed(old: Any, new: Any) -> None:
    """Go over to other parameters; both controllers are packed with the same state."""
    before, state = unpacked(old)
    after, _ = unpacked(new)
    change_parameters(before, after, state)


def changing(dispatcher: Any, packed: PackedController) -> Callable[[Any, Any], None]:
    """Return the compiled function of ``dispatcher`` for controllers of one type."""
    if dispatch.interpret_all:
        return lambda old, new: change_parameters(old.arrays[0], *new.arrays)
    return dispatcher.compile((packed.type, packed.type))


class Retuning(NamedTuple):
    """Other parameters of a running controller, and what sets its attributes for them."""

    parameters: Any
    take: Callable[[], None]


class StatefulController(Described, Hinted):
    """A controller with its own running state, which ``simulate`` does not touch.

    A subclass sets its attributes, then calls ``_initialise``. It defines ``_update_parameters``,
    which makes ``parameters`` from them, and ``initial_state``. If a field of the state refers to
    an object outside of its arrays, the subclass also defines ``_external_fields``,
    ``_external_snapshots`` and ``_restore_external``.
    """

    parameters: Any  # parameters of the compiled functions, a NamedTuple
    _state: Any
    _limits: Limits
    _packed: Any
    _step: Callable[..., Any]
    _axis = ""  # its name, if it is one of ``quell.Axes``; a copy is none

    def _meant(self) -> Mapping[str, str]:
        return OF_CONTROLLERS

    def described(self) -> dict[str, Any]:
        """Return what ``repr`` prints: arguments by name, and finite limits of u and its rate."""
        found, dt = super().described(), float(getattr(self, "dt", math.nan))
        limits = vars(self).get("_limits")
        if limits is None:
            return found
        rates = tuple(change / dt for change in (limits.least_change, limits.most_change))
        known = {"u_min": limits.low, "u_max": limits.high}
        found |= {name: value for name, value in known.items() if math.isfinite(value)}
        if any(map(math.isfinite, rates)):
            found["rate_limit"] = rates[1] if rates[0] == -rates[1] else rates
        return found

    def _initialise(self) -> None:
        self._update_parameters()
        self._use_state(self.initial_state())

    def _use_state(self, state: Any) -> None:
        """Run on ``state`` from now on."""
        self._state = state
        self._arrays = named_arrays(state)
        self._packed = None

    def _pack_again(self) -> None:
        """Update the arguments of the compiled step after a change of the parameters.

        If they have other shapes now, the next step is compiled for these.
        """
        before = self._packed
        if before is not None and layout_of(self.parameters) == layout_of(before.arrays[0]):
            self._packed = PackedController(self.parameters, self._state, before)
        else:
            self._packed = None

    def _change_to(self, design: Callable[[], Retuning], compiles: bool) -> Callable[[], None]:
        """Return a function that goes over to the parameters that ``design`` returns.

        If it ``compiles``, they are packed and the change is compiled beforehand. After new limits
        they are designed again.
        """
        self._check_own("retune")
        found, limits = design(), self.limits
        ready: PackedController | None = None
        change: Any = None
        if compiles:
            if self._packed is None:
                self.prepare()
            if layout_of(found.parameters) == layout_of(self.parameters):
                ready = PackedController(found.parameters, self._state, self._packed)
                change = changing(dispatcher_for(change_packed, found.parameters), ready)

        def apply() -> None:
            packed, same = self._packed, self.limits is limits
            if (
                same
                and ready is not None
                and packed is not None
                and packed.arrays[1] is ready.arrays[1]
            ):
                change(packed, ready)
                found.take()
                self.parameters, self._packed = found.parameters, ready
                return
            now, old = found if same else design(), self.parameters
            now.take()
            self.parameters = now.parameters
            change_parameters(old, self.parameters, self._state)
            self._pack_again()

        return apply

    def _check_own(self, change: str) -> None:
        """Raise a ``ValueError`` for an axis: its parameters are also those of all axes."""
        if self._axis:
            use = {
                "retune": f"axes.retune({self._axis!r}, ...)",
                "set_limits": "axes.set_limits(...), whose limits are those of the actuators",
            }
            raise ValueError(
                f"{change}: is the axis {self._axis!r} of quell.Axes, which would not know of the "
                f"change; call {use[change]}"
            )

    def _update_parameters(self) -> None:
        raise NotImplementedError

    def initial_state(self) -> Any:
        """Return a state before the first sample."""
        raise NotImplementedError

    def prepare(self) -> None:
        """Compile ``step``, or load it from the disk cache, so that its first call is fast.

        Raises ``ValueError`` for an axis of ``quell.Axes`` whose learner sees all axes.
        """
        check_runs_alone("step", self)
        packed = PackedController(self.parameters, self._state)
        with explain_compile_errors(self.parameters):
            self._step = entry_point(dispatcher_for(step_packed, self.parameters), packed)
        self._packed = packed

    def step(self, r: float, y: float) -> float:
        """Take one sample: return the control signal [u-unit] for reference and measurement.

        ``r`` and ``y`` are in y-units. A value that is not finite is replaced by the last finite
        one, or by the one that an observer expects; ``status`` reports it. The controller assumes
        that the returned value is applied: set limits by ``u_min``, ``u_max`` and ``rate_limit``.

        The first call compiles, or loads from the disk cache; ``prepare`` does that beforehand.
        """
        if self._packed is None:
            self.prepare()
        try:
            u: float = self._step(self._packed, r, y)
        except TypeError:
            raise TypeError(f"r = {r!r}, y = {y!r}: must be numbers") from None
        return u

    def applied(self, u: float) -> None:
        """Set the control signal that was really applied since the last ``step`` [u-unit].

        Call it before the next ``step``. Limits that are known beforehand belong in ``u_min``,
        ``u_max`` and ``rate_limit``.
        """
        set_applied_control(self.parameters, self._state, checks.signal("u", u))

    @property
    def limits(self) -> Limits:
        """Limits of the control signal: ``low``, ``high``, and the largest changes in a sample."""
        return self._limits

    def set_limits(
        self,
        *,
        u_min: float | None = None,
        u_max: float | None = None,
        rate_limit: RateLimit | None = None,
    ) -> None:
        """Change limits of the control signal while running; allowed in every sample.

        What is not given stays. The next ``step`` is within the new range of u, even if u has to
        change faster than the rate limit for that. Nothing is compiled again. A run or rig that
        was started before keeps its limits.

        Parameters
        ----------
        u_min, u_max
            new limits [u-unit].
        rate_limit
            new limit of the rate in both directions, or (lowest, highest) [u-unit/s].

        Raises
        ------
        ValueError
            as for a new controller, and for an axis of ``quell.Axes``; then the limits are
            unchanged.
        """
        self._check_own("set_limits")
        this: Any = self
        self._limits = changed_limits(self._limits, float(this.dt), u_min, u_max, rate_limit)
        self.parameters = self.parameters._replace(limits=self._limits)
        self._pack_again()

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy, also one in another process, is made from."""
        kept = {name: value for name, value in vars(self).items() if name not in _NOT_COPIED}
        return kept | {"state": self.state}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        vars(self).update({name: value for name, value in kept.items() if name != "state"})
        # Parameters may hold addresses of compiled functions, and arrays of a state may share
        # memory: make both again.
        self._initialise()
        self.state = kept["state"]

    def reset(self) -> None:
        """Return to the state before the first sample and forget what was learned."""
        self.state = self._saved(self.initial_state())

    @property
    def state(self) -> dict[str, NDArray[Any]]:
        """The whole running state as copies of named arrays.

        ``numpy.savez(file, **controller.state)`` saves it. Assign such a dictionary to restore it;
        a ``ValueError`` names what does not fit, and then nothing has changed. A learner that is a
        Python object appears as an array () of objects, which is valid in this process; quell does
        not pickle or unpickle it.
        """
        return self._saved(self._state)

    @state.setter
    def state(self, saved: Mapping[str, Any]) -> None:
        if set(saved) != set(self._arrays):
            raise ValueError(f"state has {sorted(saved)}: must have {sorted(self._arrays)}")
        checked = {}
        snapshots = {}
        for name, array in self._arrays.items():
            if name in self._external_fields:
                snapshots[name] = np.asarray(saved[name])[()]
                continue
            try:
                checked[name] = np.asarray(saved[name], dtype=np.float64)
            except (TypeError, ValueError):
                raise ValueError(f"state[{name!r}]: must be an array of numbers") from None
            shape = checked[name].shape
            if shape != array.shape:
                raise ValueError(f"state[{name!r}] has shape {shape}: must have {array.shape}")
        if snapshots:
            self._restore_external(self._state, snapshots)
        for name, value in checked.items():
            self._arrays[name][...] = value

    def memory(self) -> bytes:
        """Return the whole running state, with what was learned, as a memory image.

        The bytes are those of ``NAME_save`` of the exported controller in the same precision; the
        module ``quell.controllers.memory`` describes them. Write them to a file, and hand them to
        ``restore`` of a controller that is made in the same way.

        Raises
        ------
        ValueError
            for a learner that is a Python object: its memory is not made of numbers.
        """
        return written_image(self._images())

    def restore(self, image: bytes, *, running: bool = False) -> None:
        """Take over what is in a memory image; an image that does not fit changes nothing.

        Parameters
        ----------
        image
            bytes from ``memory()``, or from ``NAME_save`` of the exported controller.
        running
            whether to continue the running loop, bit by bit, at its next sample. By default the
            loop starts from rest with what was learned, as after the power was off: the estimates
            in the image are of another time.

        Raises
        ------
        ValueError
            for an image that is cut, damaged, of another controller or precision, or has numbers
            that are not finite; with ``running`` also for one of other parameters.
        """
        found = read_image(self._images(), image, running=checks.flag("running", running))
        for name, array in found.items():
            self._arrays[name][...] = array
        if not running:
            start_from_rest(self.parameters, self._state)

    def _images(self) -> Layout:
        """Return the layout of the images of this controller, with the arrays of its state."""
        if self._external_fields:
            raise ValueError(
                f"{type(self).__name__}: its learner is a Python object, whose memory an image can "
                "not hold; save that object by its own library and make the controller with it, or "
                "take a learner of quell.learners such as Kalman() or RLS()"
            )
        this: Any = self
        return images_of(self.parameters, self._state, float(this.dt), getattr(this, "names", ()))

    @property
    def _external_fields(self) -> tuple[str, ...]:
        """Names of state entries that refer to an object outside of the state."""
        return ()

    def _external_snapshots(self, state: Any) -> dict[str, Any]:
        """Return copies of the objects that ``state`` refers to, by name."""
        return {}

    def _restore_external(self, state: Any, snapshots: Mapping[str, Any]) -> None:
        """Restore what ``_external_snapshots`` returned."""

    def _saved(self, state: Any) -> dict[str, NDArray[Any]]:
        arrays = named_arrays(state).items()
        saved: dict[str, NDArray[Any]] = {name: array.copy() for name, array in arrays}
        for name, snapshot in self._external_snapshots(state).items():
            saved[name] = np.empty((), dtype=object)
            saved[name][()] = snapshot
        return saved
