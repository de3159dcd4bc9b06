"""A controller that calculates in single precision, as it does on a processor without double.

Its parameters are designed in double precision and then rounded, its state is single, and its
observer or linear law is in delta form (``observers/delta.py``). The plant, the clock and the
record stay in double: r and y are rounded where the controller receives them.
"""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import numba
import numpy as np

from quell import checks
from quell.controllers.adrc.adrc import ADRC
from quell.controllers.adrc.handover import change_design, manual_operation
from quell.controllers.base import (
    Controller,
    bumpless_transfer,
    check_controller,
    control,
    reset_loop,
    set_applied_control,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.controllers.limits import Limits, RateLimit
from quell.controllers.prefilters.prefilter import Prefiltered
from quell.controllers.single.parts import single_design, single_state
from quell.controllers.stateful import StatefulController
from quell.kernels import dispatch
from quell.kernels.functions import single
from quell.kernels.linking import KERNEL_OPTIONS
from quell.kernels.single_literals import in_both_precisions
from quell.observers.eso import ESO
from quell.types import Channels, Status, Vector


class SingleDesign(NamedTuple):
    """Parameters of a controller in single precision, whose functions take and return double."""

    controller: Any


@control.register(SingleDesign)
@in_both_precisions
def _control(design: SingleDesign, state: Any, r: float, y: float) -> float:
    return np.float64(control(design.controller, state, single(r), single(y)))


@set_reference_derivatives.register(SingleDesign)
@in_both_precisions
def _set_reference_derivatives(design: SingleDesign, state: Any, derivatives: Vector) -> None:
    set_reference_derivatives(design.controller, state, derivatives)


@write_row.register(SingleDesign)
@in_both_precisions
def _write_row(design: SingleDesign, state: Any, row: Vector) -> None:
    write_row(design.controller, state, row)


@status_flags.register(SingleDesign)
def _status_flags(design: SingleDesign, state: Any) -> int:
    return status_flags(design.controller, state)


@reset_loop.register(SingleDesign)
def _reset_loop(design: SingleDesign, state: Any) -> None:
    reset_loop(design.controller, state)


@set_applied_control.register(SingleDesign)
@in_both_precisions
def _set_applied_control(design: SingleDesign, state: Any, u: float) -> None:
    set_applied_control(design.controller, state, single(u))


@bumpless_transfer.register(SingleDesign)
def _bumpless_transfer(design: SingleDesign, state: Any) -> None:
    bumpless_transfer(design.controller, state)


def check_compilable() -> None:
    """Raise a ``ValueError`` if this Numba would compile single precision as double.

    Literals of kernels become single by a pass of our compiler, which other versions do without.
    """
    if not KERNEL_OPTIONS:
        raise ValueError(
            f"precision = 'single': is compiled with Numba 0.68 only, and this is "
            f"{numba.__version__}; install that, or run with interpret=True"
        )


def in_single_precision(controller: Controller) -> SinglePrecision:
    """Return a controller that calculates what ``controller`` does, in single precision.

    Raises
    ------
    ValueError
        for what is no controller; for a parameter out of the range of single precision; and for
        models in Python and ``features.Custom``, which work in double precision only.

    Examples
    --------
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=0.01)
    >>> single = in_single_precision(ql.ADRC(observer, omega_c=2.0, u_max=0.1))
    >>> single.step(r=1.0, y=0.0)
    0.10000000149011612
    """
    if isinstance(controller, SinglePrecision):
        return controller
    return SinglePrecision(controller)


class SinglePrecision(StatefulController):
    """A controller in single precision; make it with ``in_single_precision``.

    The given controller is copied and not changed; ``parameters.controller`` and the state are
    single. If it is an ADRC, or one behind a prefilter, the methods for start, manual operation and
    retuning are available here, too.
    """

    def __init__(self, controller: Controller) -> None:
        check_controller(controller)
        self.controller: Any = copy.deepcopy(controller)  # in double: it designs the parameters
        self._initialise()

    def prepare(self) -> None:
        """Compile ``step``, or load it from the disk cache, so that its first call is fast."""
        if not dispatch.interpret_all:
            check_compilable()
        super().prepare()

    def _update_parameters(self) -> None:
        self.parameters = SingleDesign(single_design(self.controller.parameters))

    def initial_state(self) -> Any:
        """Return a state before the first sample."""
        return single_state(self.parameters.controller, self.controller.initial_state())

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return float(self.controller.dt)

    @property
    def derivatives(self) -> int:
        """Number of derivatives of the reference that are fed forward."""
        return int(getattr(self.controller, "derivatives", 0))

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the features whose coefficients the channel ``theta`` has."""
        return tuple(self.controller.features)

    @property
    def channels(self) -> Channels:
        """Name and width of each recorded channel, in order."""
        channels: Channels = self.controller.channels
        return channels

    @property
    def status(self) -> Status:
        """Status flags of the last step."""
        return Status(status_flags(self.parameters, self._state))

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
        self._update_parameters()
        self._pack_again()

    def step(self, r: float, y: float, *derivatives: float) -> float:
        """Take one sample: return the control signal [u-unit], see ``ADRC.step``."""
        if derivatives or self.derivatives:
            values = np.array(derivatives, dtype=np.float64)
            set_reference_derivatives(self.parameters, self._state, values)
        return super().step(r, y)

    @property
    def _runner(self) -> Any:
        """The ADRC, or the prefilter before it, that acts on this state with these parameters."""
        if not isinstance(self.controller, ADRC | Prefiltered):
            kind = type(self.controller).__name__
            raise ValueError(
                f"controller = {kind}: must be an ADRC to start under load, hand over or retune"
            )
        return _acting_on(self.controller, self.parameters.controller, self._state)

    @property
    def _adrc(self) -> ADRC:
        """The ADRC behind all prefilters, acting on this state."""
        runner = self._runner
        adrc: ADRC = runner if isinstance(runner, ADRC) else runner._adrc
        return adrc

    def start(self, y: float, u: float = 0.0, r: float | None = None) -> None:
        """Start at a plant that rests at ``y`` under ``u``, see ``ADRC.start``."""
        self._runner.start(y, u, r)

    def start_at(self, x: Any, f: float = 0.0, *, u: float = 0.0, r: float | None = None) -> None:
        """Start with given estimates, see ``ADRC.start_at``."""
        self._runner.start_at(x, f, u=u, r=r)

    def track(self, r: float, y: float, u: float, *derivatives: float) -> float:
        """Take one sample in manual operation, see ``ADRC.track``."""
        state = self._adrc._state
        with manual_operation(state, checks.signal("u", u)):
            self.step(r, y, *derivatives)
        return float(state.loop[0].u_limited)

    def hand_over(self) -> None:
        """End manual operation, see ``ADRC.hand_over``."""
        self._runner.hand_over()

    def retune(self, *, omega_c: float | None = None, observer: ESO | None = None) -> None:
        """Change bandwidths while running, see ``ADRC.retune``."""
        before = self._adrc
        self.controller.retune(omega_c=omega_c, observer=observer)
        self._update_parameters()
        change_design(before.parameters, self._adrc.parameters, before._state)
        self._pack_again()

    @property
    def estimate(self) -> Any:
        """Estimates and status after the last step, see ``ADRC.estimate``."""
        return self.read(self._state)

    def read(self, state: Any) -> Any:
        """Return the estimates and the status in ``state``."""
        return self._runner.read(state)


def _acting_on(controller: Any, design: Any, state: Any) -> Any:
    """Return a copy of a controller that acts on ``state`` with the parameters ``design``."""
    acting = copy.copy(controller)
    if isinstance(controller, Prefiltered):
        acting.controller = _acting_on(controller.controller, design.controller, state.controller)
    acting.parameters, acting._state, acting._packed = design, state, None
    return acting
