"""The base class of controllers: a running state to step, save, restore and copy."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import set_applied_control
from quell.controllers.compiled_step import PackedController, entry_point, step_packed
from quell.controllers.limits import Limits, RateLimit, changed_limits
from quell.described import Described
from quell.kernels.dispatch import dispatcher_for
from quell.kernels.sized import layout_of
from quell.kernels.user_types import explain_compile_errors

# A copy makes these again: compiled functions and shared arrays belong to one process.
_NOT_COPIED = ("parameters", "_state", "_arrays", "_packed", "_step")


class StatefulController(Described):
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
    _step: Callable[[Any, float, float], float]

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

    def _update_parameters(self) -> None:
        raise NotImplementedError

    def initial_state(self) -> Any:
        """Return a state before the first sample."""
        raise NotImplementedError

    def prepare(self) -> None:
        """Compile ``step``, or load it from the disk cache, so that its first call is fast."""
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
            return self._step(self._packed, r, y)
        except TypeError:
            raise TypeError(f"r = {r!r}, y = {y!r}: must be numbers") from None

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
            as for a new controller; then the limits are unchanged.
        """
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


def named_arrays(state: Any, prefix: str = "") -> dict[str, NDArray[np.float64]]:
    """Return the arrays of a nested NamedTuple by dotted name, ``Scalars`` as a vector."""
    found: dict[str, NDArray[np.float64]] = {}
    for name, value in state._asdict().items():
        if isinstance(value, tuple):
            found |= named_arrays(value, f"{prefix}{name}.")
        else:
            is_record = value.dtype.names is not None
            found[prefix + name] = value.view(value.dtype[0]) if is_record else value
    return found
