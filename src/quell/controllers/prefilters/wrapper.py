"""The base class of controllers around another: behind a prefilter, or in single precision."""

from __future__ import annotations

import copy
from typing import Any

from quell.controllers.adrc.adrc import ADRC
from quell.controllers.base import status_flags
from quell.controllers.limits import Limits, RateLimit
from quell.controllers.stateful import StatefulController
from quell.observers.eso import ESO
from quell.types import Channels, Status


class Wrapper(StatefulController):
    """A controller around ``controller``, of which it has limits, features and channels.

    If that is an ADRC, or a wrapper of one, the methods for start, manual operation and retuning
    are those of the ADRC.
    """

    controller: Any

    def __copy__(self) -> Any:
        """Return a copy with a controller of its own, which shares no state with this one."""
        made = type(self).__new__(type(self))
        made.__setstate__({**self.__getstate__(), "controller": copy.copy(self.controller)})
        return made

    def _take_parameters(self) -> None:
        """Use the parameters that the controller has now."""
        self._update_parameters()
        self._pack_again()

    @property
    def _inner(self) -> Any:
        """The controller, acting on this state; an error if it has no methods for hand-over."""
        if isinstance(self.controller, ADRC | Wrapper):
            return self.controller
        raise ValueError(
            f"controller = {type(self.controller).__name__}: must be an ADRC to start under load, "
            "hand over or retune"
        )

    @property
    def _adrc(self) -> ADRC:
        """The ADRC behind all wrappers, acting on this state."""
        inner = self._inner
        return inner if isinstance(inner, ADRC) else inner._adrc

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return float(self.controller.dt)

    @property
    def limits(self) -> Limits:
        """Limits of the control signal."""
        limits: Limits = self.controller.limits
        return limits

    def set_limits(
        self,
        *,
        u_min: float | None = None,
        u_max: float | None = None,
        rate_limit: RateLimit | None = None,
    ) -> None:
        """Change limits while running, see ``ADRC.set_limits``."""
        self.controller.set_limits(u_min=u_min, u_max=u_max, rate_limit=rate_limit)
        self._take_parameters()

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the features whose coefficients the channel ``theta`` has."""
        return tuple(self.controller.features)

    @property
    def channels(self) -> Channels:
        """Name and width of what ``write_row`` writes, in order."""
        channels: Channels = self.controller.channels
        return channels

    @property
    def status(self) -> Status:
        """Status flags of the last step."""
        return Status(int(status_flags(self.parameters, self._state)))

    def start(self, y: float, u: float = 0.0, r: float | None = None) -> None:
        """Start at a plant that rests at ``y`` under ``u``, see ``ADRC.start``."""
        self._inner.start(y, u, r)

    def start_at(self, x: Any, f: float = 0.0, *, u: float = 0.0, r: float | None = None) -> None:
        """Start with given estimates, see ``ADRC.start_at``."""
        self._inner.start_at(x, f, u=u, r=r)

    def hand_over(self) -> None:
        """End manual operation, see ``ADRC.hand_over``."""
        self._inner.hand_over()

    def retune(self, *, omega_c: float | None = None, observer: ESO | None = None) -> None:
        """Change bandwidths while running, see ``ADRC.retune``."""
        self._inner.retune(omega_c=omega_c, observer=observer)
        self._take_parameters()

    @property
    def estimate(self) -> Any:
        """Estimates and status of the ADRC after the last step, see ``ADRC.estimate``."""
        return self.read(self._state)

    def read(self, state: Any) -> Any:
        """Return the estimates and the status of the ADRC in ``state``."""
        raise NotImplementedError
