"""What every controller of this package shares: a running state, one sample at a time, saved, restored, copied, sent."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers.base import set_applied_control
from quell.controllers.compiled_step import entry_point, pack, step_packed
from quell.controllers.limits import Limits
from quell.kernels.dispatch import compiling, for_types

# What only this process can use, or what can be made anew.
_MADE_ANEW = ("parameters", "_state", "_arrays", "_packed", "_step")


class StatefulController:
    """A controller with a running state of its own, which ``step`` moves on and ``simulate`` leaves alone.

    A subclass sets what it is made from, then calls ``_begin``. It has ``_prepare_design``, which makes ``parameters`` from that, and
    ``initial_state``. Where a part of its state lies outside of arrays, it says so in ``_outside``, ``_snapshots`` and ``_recall``.
    """

    parameters: Any
    """What the compiled functions need, a NamedTuple."""
    _state: Any
    _limits: Limits
    _packed: Any
    _step: Callable[[Any, float, float], float]

    def _begin(self) -> None:
        self._prepare_design()
        self._adopt(self.initial_state())

    def _adopt(self, state: Any) -> None:
        """Run on ``state`` from here on."""
        self._state = state
        self._arrays = named_arrays(state)
        self._packed = None

    def _prepare_design(self) -> None:
        raise NotImplementedError

    def initial_state(self) -> Any:
        """Return a state before the first sample."""
        raise NotImplementedError

    def prepare(self) -> None:
        """Compile ``step``, or load it from the disk cache, so that the first call takes no longer than the others."""
        dispatcher = for_types(step_packed, self.parameters)
        self._packed = pack(self.parameters, self._state)
        # The first call is made on a state of its own: it must not count as a sample.
        with compiling(self.parameters):
            dispatcher(pack(self.parameters, self.initial_state()), 0.0, 0.0)
        self._step = entry_point(dispatcher, self._packed, 0.0, 0.0)

    def step(self, r: float, y: float) -> float:
        """Take one sample: return the control signal [u-unit] for the reference ``r`` and the measurement ``y`` [y-unit].

        A value that is not finite is replaced by the last good one, or by what an observer expects, and said in ``status``. The returned
        value is taken for applied; limits belong in ``u_min``, ``u_max`` and ``rate_limit``, not behind the controller.

        The first call compiles, or loads; ``prepare`` does that beforehand.
        """
        if self._packed is None:
            self.prepare()
        try:
            return self._step(self._packed, r, y)
        except TypeError:
            raise TypeError(f"r = {r!r}, y = {y!r}: must be numbers") from None

    def applied(self, u: float) -> None:
        """Say what was really applied [u-unit] since the last ``step``, where something behind the controller changed it.

        To be called before the next ``step``. Limits that are known beforehand belong in ``u_min``, ``u_max`` and ``rate_limit``.

        Raises
        ------
        ValueError
            where u is not finite.
        """
        set_applied_control(self.parameters, self._state, checks.finite("u", u))

    @property
    def limits(self) -> Limits:
        """What the control signal keeps to: ``low`` and ``high`` [u-unit], and ``most_change`` in a sample."""
        return self._limits

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what only this process can use, so that controllers can be copied and sent to other processes."""
        return {name: value for name, value in vars(self).items() if name not in _MADE_ANEW} | {
            "state": self.state
        }

    def __setstate__(self, kept: dict[str, Any]) -> None:
        vars(self).update({name: value for name, value in kept.items() if name != "state"})
        # Parameters may hold addresses of compiled functions, and arrays of a state may share memory: both are made anew, not copied.
        self._begin()
        self.state = kept["state"]

    def reset(self) -> None:
        """Go back to the state before the first sample; what was learned is forgotten."""
        self.state = self._saved(self.initial_state())

    @property
    def state(self) -> dict[str, NDArray[Any]]:
        """The whole running state as named arrays, copied: ``numpy.savez(file, **controller.state)`` keeps it.

        Assigning such a dictionary restores it; a ``ValueError`` names what does not fit, and nothing has changed then. A learner that is
        a Python object is in it as an array () of objects, which is good in this process; quell does not pickle or unpickle it.
        """
        return self._saved(self._state)

    @state.setter
    def state(self, saved: Mapping[str, Any]) -> None:
        if set(saved) != set(self._arrays):
            raise ValueError(f"state has {sorted(saved)}: must have {sorted(self._arrays)}")
        checked = {}
        snapshots = {}
        for name, array in self._arrays.items():
            if name in self._outside:
                snapshots[name] = np.asarray(saved[name])[()]
                continue
            try:
                checked[name] = np.asarray(saved[name], dtype=np.float64)
            except (TypeError, ValueError):
                raise ValueError(f"state[{name!r}]: must be an array of numbers") from None
            if checked[name].shape != array.shape:
                raise ValueError(
                    f"state[{name!r}] has shape {checked[name].shape}: must have {array.shape}"
                )
        if snapshots:
            self._recall(self._state, snapshots)
        for name, value in checked.items():
            self._arrays[name][...] = value

    @property
    def _outside(self) -> tuple[str, ...]:
        """Names of what stands for something outside of the state's arrays."""
        return ()

    def _snapshots(self, state: Any) -> dict[str, Any]:
        """Return what stands outside of the arrays of ``state``, by name."""
        return {}

    def _recall(self, state: Any, snapshots: Mapping[str, Any]) -> None:
        """Put back what ``_snapshots`` returned."""

    def _saved(self, state: Any) -> dict[str, NDArray[Any]]:
        saved: dict[str, NDArray[Any]] = {
            name: array.copy() for name, array in named_arrays(state).items()
        }
        for name, snapshot in self._snapshots(state).items():
            box = np.empty((), dtype=object)
            box[()] = snapshot
            saved[name] = box
        return saved


def named_arrays(state: Any, prefix: str = "") -> dict[str, NDArray[np.float64]]:
    """Return the arrays of a nested NamedTuple by dotted name; the arrays themselves, not copies."""
    found: dict[str, NDArray[np.float64]] = {}
    for name, value in state._asdict().items():
        if isinstance(value, tuple):
            found |= named_arrays(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found
