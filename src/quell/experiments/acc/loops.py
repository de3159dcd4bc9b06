"""Loops of the ACC benchmark: controllers, design cases, uncertain plants, criteria.

The three design cases of Wie & Bernstein (*J. Guidance, Control, and Dynamics* 15, 1992).

Masses of 1 kg, no actuator lag, u on m1, y = x2:

1. a unit impulse on m2; stable for all 0.5 < k < 2, and settled by 15 s at k = 1;
2. the same, and stable for m1, m2 and k as far from 1 as possible, all at once;
3. a sinusoid of 0.5 rad/s and unknown phase on m2, rejected within 20 s for all 0.5 < k < 2.

The controllers in the first two cases are those of ``acc.controllers``. In the third u has no
limit, as a load of 1 N on m2 needs more than 0.5 N.

Controllers for the ACC benchmark: ours, each fixed for all plants, and the published ones.

Ours have one rule. The impulse gives m2 a momentum of 1 N s; u = ±0.5 N takes at least 2 s to
absorb it, and as long again to bring the masses back. That leaves a linear law about ten of the
fifteen seconds. Four poles at ``omega_c`` go from 1 to 0.1 in ``6.7/omega_c``, so ``omega_c = 1
rad/s`` takes seven of them and leaves room for a plant slower than nominal. The observer is ten
times as fast. ``b0`` is 1.5 times the nominal gain ``k/(m1 m2) = 1``: a loop with light masses or a
strong actuator, whose gain is above nominal, is lost sooner than one whose gain is below.
``docs/acc`` shows how little the failure rate changes around these values, and on which plants they
were chosen: drawn ones, up to three times as uncertain as the published.

``FREE_POLES`` is an MF-ESO whose law and observer have poles of their own, found by simulation for
a box of plants (``acc.box``).

The published controllers, which are in continuous time: their loops, computed exactly.

Plant and ``u = −C(s) y`` together are one linear system without inputs, ``x' = A x``, and ``x(t +
h) = exp(A h) x(t)`` has no error; the force of the cubic spring acts between the samples, as in
``plants.machines.cubic_spring``. None of this is shared with the simulation or a controller of
this package.

Uncertain plants of the ACC benchmark: read from a file, or drawn.

A sample is a row ``(m1, m2, k_lin, k_nonlin, lambda, tau)``: masses [kg], stiffness [N/m] and its
cubic part [N/m³], effectiveness and lag [s] of the actuator. ``generated`` draws samples like those
that Rocchetta, Crespo & Kenny (DSCC 2019) published: each parameter has the quantiles of their 1000
samples of small uncertainty; spring, cubic part and effectiveness have the rank correlations of
theirs (a Gaussian copula). In the original, light and heavy m1 also tend to have soft springs;
without that the drawn samples are a little harsher.
"""

from __future__ import annotations

import math
import os
from array import array
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.analysis import analyse
from quell.analysis.linearise import frozen, linear_law
from quell.analysis.loop import closed_loop_matrix
from quell.analysis.margins import Margins
from quell.controllers import ADRC, Controller
from quell.controllers.linear import LinearLaw
from quell.experiments.compare import controller
from quell.files import MAX_SIZE, bytes_of, check_size, csv_rows, nonfinite_to_none, text_lines
from quell.guard import Guard
from quell.learners import Harmonic, Kalman
from quell.observers import ESO
from quell.parallel import in_parallel, one_blas_thread
from quell.plants import CubicSpringPlant, LinearPlant, lagged_two_mass_spring, two_mass_spring
from quell.records.trajectory import Trajectory
from quell.signals import Sinusoid
from quell.simulation import Scenario, simulate
from quell.sweeping.sweep import share_interval as interval
from quell.types import Matrix, Vector

# ---- Controllers for the ACC benchmark ----

MF, MB, L = OURS = "MF-ESO", "MB-ESO", "L-ESO"
OMEGA_C, OMEGA_O, B0 = 1.0, 10.0, 1.5
FREE_POLES = "MF-ESO, own poles"
# Found by ``python benchmarks/acc_box.py --tune 900 --plants 400``, rounded to four digits.
_FREE_POLES_B0, _FREE_POLES_OMEGA_C, _FREE_POLES_OMEGA_O = 1.817, 1.010, 17.82
_FREE_POLES_LAW = ((-0.9649, 0.7789), (-0.7764, 0.2179))
_FREE_POLES_OBSERVER = (-1.210, -1.768, -0.2115, (-0.4683, 1.411))
MOST_U = 0.5  # limit of ``|u|`` [N], of Rocchetta, Crespo & Kenny (DSCC 2019)
DT = 0.01  # sample time [s]: chosen by hand, omega_o dt = 0.1

BASELINES = {
    "PID": "pid",
    "PI with notch": "pi-notch",
    "LQG": "lqg",
    "resonance ratio": "resonance-ratio",
}
"""Controllers of ``quell compare``, for the nominal plant; not tuned for this benchmark."""


class TransferFunction(NamedTuple):
    """``u = −num(s)/den(s) y``, highest power first."""

    num: tuple[float, ...]
    den: tuple[float, ...]


PUBLISHED = {
    "published nominal": TransferFunction(
        (-0.1324, 0.3533, 0.6005, 0.0728), (0.5503, 1.4175, 2.6531, 2.4802, 1.0)
    ),
    "published SP1(0.05)": TransferFunction(
        (-0.02764507, 0.61323392, 0.52830290, 0.07321506),
        (0.58586517, 1.35042413, 2.51075570, 2.17663966, 0.82701801),
    ),
    "published SP2": TransferFunction(
        (-0.08314553, 0.63578454, 0.77522224, 0.09814777),
        (0.76003349, 1.94907798, 3.04966829, 2.73439891, 1.05935063),
    ),
}
"""Rocchetta, Crespo & Kenny (DSCC 2019): the nominal design, two by scenario optimisation."""


def designs(
    dt: float = DT,
    omega_c: float = OMEGA_C,
    omega_o: float = OMEGA_O,
    b0: float = B0,
    *,
    most_u: float = MOST_U,
    load: float | None = None,
) -> dict[str, Controller]:
    """Return baselines and our controllers by name, with sample time ``dt`` and ``|u| <= most_u``.

    MF-ESO knows the plant's order and gain, MB-ESO the nominal masses and spring. L-ESO knows as
    much as MF-ESO and learns during control, with a guard. None knows the actuator's lag. The
    three numbers are not those of ``FREE_POLES``. With a sinusoidal ``load`` of known frequency
    [rad/s] L-ESO learns the load too, and has no guard: after a load that begins with a jolt, the
    guard would keep it from learning for more than a minute.
    """
    model_free = ESO.model_free(order=4, b0=b0, omega_o=omega_o, dt=dt)
    model_based = ESO.model_based(two_mass_spring(), omega_o=omega_o, dt=dt, b0=b0)
    learner = Kalman() if load is None else Harmonic(omegas=(load,), bias_bandwidth=2.0)
    guard = Guard() if load is None else None
    limits: dict[str, Any] = {"u_min": -most_u, "u_max": most_u}
    baselines = {name: controller(key, dt, most_u) for name, key in BASELINES.items()}
    return baselines | {
        MF: ADRC(model_free, omega_c, **limits),
        MB: ADRC(model_based, omega_c, **limits),
        L: ADRC(model_free, omega_c, learner=learner, guard=guard, **limits),
        FREE_POLES: free_poles(dt, most_u),
    }


def free_poles(dt: float = DT, most_u: float = MOST_U) -> ADRC:
    """Return the MF-ESO with poles of its own, tuned by simulation for the box of plants."""
    bandwidth = (_FREE_POLES_B0, _FREE_POLES_OMEGA_O)
    observer = ESO.model_free(4, *bandwidth, dt, poles=_FREE_POLES_OBSERVER)
    limits: dict[str, Any] = {"u_min": -most_u, "u_max": most_u}
    return ADRC(observer, _FREE_POLES_OMEGA_C, law_poles=_FREE_POLES_LAW, **limits)


# ---- The failure criterion of the ACC benchmark ----

SETTLED_AT, MOST_Y = 15.0, 0.1
"""Time from which on y must stay small [s], and its limit [m] (Rocchetta et al., DSCC 2019)."""
DURATION = 30.0
"""Duration of a run [s]: theirs is 25 s; chosen longer, so that slowly growing loops show."""
# Relative to 0.5 N: a control signal on its limit is not beyond it, whatever the rounding.
_ROUNDING = 1e-9


class Judged(NamedTuple):
    """Runs of one controller on a sample of plants; each array (count,)."""

    late_peak: Vector  #: largest ``|y|`` from 15 s on [m]; infinite for an unstable loop
    most_u: Vector  #: largest ``|u|`` [N]

    @property
    def fails(self) -> NDArray[np.bool_]:
        """True if a plant fails: unstable, ``|y| > 0.1`` from 15 s on, ``|u| > 0.5``, or NaN."""
        return ~((self.late_peak <= MOST_Y) & (self.most_u <= MOST_U + _ROUNDING))

    def to_json(self) -> dict[str, Any]:
        """Return the failure rate, its interval and the reasons, for ``json.dump``."""
        failures, count = int(np.sum(self.fails)), self.fails.size
        return {
            "failure_rate": failures / count,
            "ci95": list(interval(failures, count)),
            "late": int(np.sum(~(self.late_peak <= MOST_Y))),
            "beyond_u": int(np.sum(~(self.most_u <= MOST_U + _ROUNDING))),
        }


def judge(t: Vector, y: Matrix, u: Matrix, unstable: NDArray[np.bool_]) -> Judged:
    """Judge records ``y`` and ``u`` (count, samples) at the times ``t``, NaN after an early end.

    ``unstable`` (count,) marks loops with an unstable pole, which may be too slow to show in the
    records.
    """
    late = np.max(np.abs(y[:, t >= SETTLED_AT - 1e-9]), axis=1)
    most_u = np.max(np.abs(np.nan_to_num(u, nan=0.0)), axis=1)
    return Judged(np.where(np.isnan(late) | unstable, np.inf, late), most_u)


# ---- The published controllers, which are in continuous time ----

STEP = 0.01
"""Time between the samples that are judged [s]: the sample time of the other controllers."""


def judge_published(
    design: TransferFunction, samples: Matrix, cubic: bool, duration: float = DURATION
) -> Judged:
    """Judge a continuous-time controller on samples (count, 6)."""
    with one_blas_thread():
        return _judged(design, samples, cubic, duration)


def _judged(design: TransferFunction, samples: Matrix, cubic: bool, duration: float) -> Judged:
    from scipy.linalg import expm

    loops, output = _closed_loops(design, samples)
    transition = expm(loops * STEP)
    m1, m2, k_cubic = samples[:, 0], samples[:, 1], 0.5 * STEP * cubic * samples[:, 3]
    push1, push2 = -k_cubic / m1, k_cubic / m2
    x = np.zeros((*loops.shape[:2], 1))
    x[:, 3, 0] = 1.0 / m2
    late_peak, most_u = np.zeros(m1.size), np.zeros(m1.size)
    with np.errstate(over="ignore", invalid="ignore"):
        for i in range(round(duration / STEP) + 1):
            most_u = np.maximum(most_u, np.abs(x[:, 5:, 0] @ output))
            if i * STEP >= SETTLED_AT - 1e-9:
                late_peak = np.maximum(late_peak, np.abs(x[:, 1, 0]))
            if cubic:
                _push(x, push1, push2)
            x = transition @ x
            if cubic:
                _push(x, push1, push2)
    unstable = np.max(np.linalg.eigvals(loops).real, axis=1) >= 0.0
    late_peak = np.where(unstable | np.isnan(late_peak), np.inf, late_peak)
    return Judged(late_peak, np.nan_to_num(most_u, nan=np.inf))


def _push(x: Matrix, push1: Vector, push2: Vector) -> None:
    cube = (x[:, 0, 0] - x[:, 1, 0]) ** 3
    x[:, 2, 0] += push1 * cube
    x[:, 3, 0] += push2 * cube


def _closed_loops(design: TransferFunction, samples: Matrix) -> tuple[Matrix, Vector]:
    """Return A (count, 5 + n, 5 + n), the plant's states first, and the controller's C (n,)."""
    m1, m2, k, _, effectiveness, lag = samples.T
    den = np.array(design.den) / design.den[0]
    output = -np.array(design.num)[::-1] / design.den[0]
    n = den.size - 1
    A = np.zeros((m1.size, 5 + n, 5 + n))
    A[:, 0, 2] = A[:, 1, 3] = 1.0
    A[:, 2, 0], A[:, 2, 1], A[:, 2, 4] = -k / m1, k / m1, effectiveness / m1
    A[:, 3, 0], A[:, 3, 1] = k / m2, -k / m2
    A[:, 4, 4] = -1.0 / lag
    A[:, 4, 5:] = output / lag[:, None]
    A[:, 5:-1, 6:] = np.eye(n - 1)
    A[:, -1, 5:] = -den[:0:-1]
    A[:, -1, 1] = 1.0
    return A, output


# ---- Uncertain plants of the ACC benchmark ----

COLUMNS = ("m1", "m2", "k_lin", "k_nonlin", "lambda", "tau")
NOMINAL = np.array([1.0, 1.0, 1.0, 0.0, 1.0, 0.0065])
"""The nominal plant; the lag is about the least published one, as uncertainty only adds to it."""

BOX = ((0.6, 1.4), (0.6, 1.4), (0.5, 2.0))
"""Ranges of m1, m2 [kg] and k [N/m] in ``boxed``."""

# Largest value (and the inverse of the smallest), and least lag [s]: far beyond real plants; chosen
# by hand, as the poles of such loops are lost in rounding.
_MOST, _LEAST_LAG = 1e6, 1e-9
_UNITS = {"m1": "kg", "m2": "kg", "k_lin": "N/m", "tau": "s"}
# Quantiles of the published samples, one row for each parameter.
_LEVELS = (0.0, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 1.0)
_QUANTILES = (
    (0.748, 0.781, 0.868, 0.951, 1.017, 1.056, 1.071, 1.084, 1.093),
    (0.701, 0.803, 0.858, 0.937, 1.008, 1.072, 1.119, 1.142, 1.166),
    (0.675, 0.815, 0.910, 0.978, 1.012, 1.029, 1.049, 1.064, 1.083),
    (-0.278, -0.217, -0.171, -0.064, 0.019, 0.081, 0.130, 0.173, 0.234),
    (0.736, 0.798, 0.871, 0.945, 0.999, 1.050, 1.102, 1.150, 1.215),
    (0.0062, 0.0063, 0.0065, 0.0069, 0.0079, 0.0108, 0.0183, 0.0315, 0.0803),
)
# Rank correlations of k_lin, k_nonlin and lambda in the published samples.
_CORRELATIONS = ((1.0, 0.94, 0.76), (0.94, 1.0, 0.71), (0.76, 0.71, 1.0))
# Chosen by hand: beyond it, the quantiles are far outside of the published ones.
_MOST_SPREAD = 5.0
# Least lag of a drawn plant [s]: chosen by hand, below the nominal lag.
_LEAST_DRAWN_LAG = 1e-3


def generated(count: int, spread: float = 1.0, seed: int = 0) -> Matrix:
    """Draw samples (count, 6); the same ``seed`` gives the same samples.

    ``spread`` is the distance from nominal, 1 for the published small uncertainty; see ``widened``.
    """
    checks.whole("count", count, 1)
    if checks.positive("spread", spread) > _MOST_SPREAD:
        raise ValueError(
            f"spread = {spread!r}: must be at most {_MOST_SPREAD:g}, "
            "the published samples do not cover more"
        )
    from scipy.stats import norm

    random = np.random.default_rng(checks.whole("seed", seed, 0))
    scores = random.standard_normal((count, 6))
    scores[:, 2:5] = scores[:, 2:5] @ np.linalg.cholesky(_CORRELATIONS).T
    ranks = norm.cdf(scores)
    small = [np.interp(ranks[:, j], _LEVELS, row) for j, row in enumerate(_QUANTILES)]
    return widened(np.column_stack(small), spread)


def boxed(count: int, seed: int = 0) -> Matrix:
    """Draw samples (count, 6) whose masses and stiffness fill a box, independent of each other.

    m1 and m2 are uniform in [0.6, 1.4], k in [0.5, 2]; cubic part, effectiveness and lag are those
    of ``generated`` with a spread of 3.
    """
    found = generated(count, 3.0, seed)
    # A stream of its own: that of ``generated`` with this seed has drawn the other columns.
    random = np.random.default_rng([seed, len(BOX)])
    for j, (low, high) in enumerate(BOX):
        found[:, j] = random.uniform(low, high, count)
    return found


def widened(samples: Matrix, spread: float) -> Matrix:
    """Return samples ``spread`` times as far from nominal: as a factor, ``value^spread``.

    The cubic part, which may be negative, and the lag are widened linearly.
    """
    wide, factors, linear = np.empty_like(samples), [0, 1, 2, 4], [3, 5]
    wide[:, factors] = samples[:, factors] ** spread
    wide[:, linear] = NOMINAL[linear] + spread * (samples[:, linear] - NOMINAL[linear])
    wide[:, 5] = np.maximum(wide[:, 5], _LEAST_DRAWN_LAG)
    return wide


def read(path: str | os.PathLike[str], max_size: float = MAX_SIZE) -> Matrix:
    """Read samples from a CSV file, (count, 6).

    The first line names the columns, in any order: ``m1, m2, k_lin, k_nonlin, lambda, tau``, or
    ``theta_1`` to ``theta_6`` as published. Other columns are ignored. A ``ValueError`` names line
    and column of a fault. The file may have ``max_size`` [MB].
    """
    where, most = f"samples = {os.fspath(path)!r}", bytes_of(max_size)
    rows = csv_rows(text_lines(path, where, most), where)
    _, names = next(rows, (0, []))
    header = [cell.lstrip("\\") for cell in names]
    columns = [(j, _column(where, header, j)) for j in range(6)] if header else []
    values = array("d")
    for number, row in rows:
        values.extend(_value(where, number, row, place, j) for j, place in columns)
        check_size(8 * len(values), most, where)
    if not values:
        raise ValueError(f"{where}: must have a line of column names and at least one sample")
    return np.array(values).reshape(-1, 6)


def _column(where: str, header: list[str], j: int) -> int:
    names = (COLUMNS[j], f"theta_{j + 1}")
    found = [i for i, name in enumerate(header) if name in names]
    if len(found) != 1:
        fault = "is missing" if not found else "is there more than once"
        raise ValueError(
            f"{where}: column {names[0]} (or {names[1]}) {fault}; "
            f"the first line has {', '.join(header)}"
        )
    return found[0]


def _value(where: str, number: int, row: list[str], place: int, j: int) -> float:
    name = COLUMNS[j]
    text = row[place].strip() if place < len(row) else ""
    try:
        value = float(text.replace("_", "?"))  # Python accepts 1_000
    except ValueError:
        raise ValueError(f"{where}, line {number}: {name} = {text!r}: must be a number") from None
    try:
        checks.finite(name, value)
        if name != "k_nonlin":
            checks.positive(name, value, _UNITS.get(name, ""))
    except ValueError as error:
        raise ValueError(f"{where}, line {number}: {error}") from None
    least = 0.0 if name == "k_nonlin" else _LEAST_LAG if name == "tau" else 1.0 / _MOST
    if not least <= abs(value) <= _MOST:
        raise ValueError(
            f"{where}, line {number}: {name} = {value!r}: "
            f"must be between {least:g} and {_MOST:g}, is the unit right?"
        )
    return value


def plant(sample: Vector, cubic: bool) -> LinearPlant | CubicSpringPlant:
    """Return the plant of a sample; with ``cubic`` its spring has a cubic part, perhaps zero."""
    m1, m2, k, k_cubic, effectiveness, lag = map(float, sample)
    return lagged_two_mass_spring(m1, m2, k, k_cubic if cubic else None, effectiveness, lag)


# ---- Stability of the benchmark's loops without limits, for many plants at once ----


def unstable(
    plants: Sequence[LinearPlant | CubicSpringPlant], controller: Controller
) -> NDArray[np.bool_]:
    """Return for each plant whether its loop is unstable at rest, before anything is learned."""
    return unstable_under(plants, law_before_learning(controller), controller.dt)


def law_before_learning(controller: Controller) -> LinearLaw:
    """Return the law of a controller whose learner knows nothing and does not learn."""
    at = frozen(controller) if isinstance(controller, ADRC) else None
    return linear_law(controller, at)


def unstable_under(
    plants: Sequence[LinearPlant | CubicSpringPlant], law: LinearLaw, dt: float
) -> NDArray[np.bool_]:
    """Return for each plant whether its loop with a linear law at a sample time is unstable."""
    inner = law.A + np.outer(law.B_u, law.C)
    linear = [p.linear if isinstance(p, CubicSpringPlant) else p for p in plants]
    with one_blas_thread():
        sampled = [plant.sampled(dt) for plant in linear]
        loops = np.array(
            [closed_loop_matrix(s.transition, s.input, s.output, law, inner) for s in sampled]
        )
        return np.asarray(np.max(np.abs(np.linalg.eigvals(loops)), axis=1) >= 1.0)


# ---- The three design cases of Wie & Bernstein (*J ----

STIFFNESSES = np.linspace(0.5, 2.0, 13)
"""Stiffnesses of cases 1 and 3 [N/m]: the problem's range, in steps chosen by hand."""
LOAD = 0.5  # frequency of the load in case 3 [rad/s]
# Phases of the load [rad]: a start with no force, and with the full one.
_PHASES = (0.0, 0.5 * np.pi)
# Duration of the runs [s]: four times those that the problem gives for the impulse and the load.
_IMPULSE_TIME, _LOAD_TIME = 60.0, 80.0


@dataclass(frozen=True)
class CaseResult:
    """Results of a controller in the three cases."""

    margins: Margins  #: margins of the nominal loop
    settled_at: float  #: time after which ``|y| < 0.1`` m, at k = 1 [s]; infinite beyond 60 s
    settled_at_worst: float  #: that time at the worst k [s]
    stable_from: float  #: least k of the interval around k = 1 in which the loop is stable [N/m]
    stable_to: float  #: largest k of that interval
    parameter_bound: float  #: largest p with a stable loop for all m1, m2, k in [1 − p, 1 + p]
    load_peak: float  #: largest ``|y|`` from 20 s on, worst k and phase [m]; infinite if unstable
    load_remains: float  #: largest ``|y|`` over the last period of 80 s [m]

    def to_json(self) -> dict[str, Any]:
        """Return numbers for ``json.dump``; None for infinite ones."""
        plain = asdict(self) | {"margins": self.margins._asdict()}
        return dict(nonfinite_to_none(plain))


def study_cases() -> dict[str, CaseResult]:
    """Return the results of each of our controllers."""
    loaded = designs(DT, most_u=np.inf, load=LOAD)
    return {
        name: _study(controller, loaded[name])
        for name, controller in designs(DT).items()
        if name in OURS
    }


def _study(controller: Controller, loaded: Controller) -> CaseResult:
    impulses = in_parallel([partial(_impulse, controller, k) for k in (1.0, *STIFFNESSES)])
    settled = [_settled_at(run) for run in impulses]
    cases = product(STIFFNESSES, _PHASES)
    loads = in_parallel([partial(_load, loaded, k, phase) for k, phase in cases])
    lost = any(unstable([two_mass_spring(k=k) for k in STIFFNESSES], loaded))
    period = 2.0 * np.pi / LOAD
    return CaseResult(
        margins=analyse(two_mass_spring(), controller).margins,
        settled_at=settled[0],
        settled_at_worst=max(settled[1:]),
        stable_from=_edge(controller, 1.0 / 1.01),
        stable_to=_edge(controller, 1.01),
        parameter_bound=_parameter_bound(controller),
        load_peak=math.inf if lost else max(_peak(run, 20.0) for run in loads),
        load_remains=math.inf if lost else max(_peak(run, _LOAD_TIME - period) for run in loads),
    )


def _impulse(controller: Controller, k: float) -> Trajectory:
    scenario = Scenario(duration=_IMPULSE_TIME, x0=[0.0, 0.0, 0.0, 1.0])
    return simulate(two_mass_spring(k=k), controller, scenario)


def _load(controller: Controller, k: float, phase: float) -> Trajectory:
    scenario = Scenario(duration=_LOAD_TIME, disturbances=(0.0, Sinusoid(1.0, LOAD, phase)))
    return simulate(two_mass_spring(k=k), controller, scenario)


def _settled_at(run: Trajectory) -> float:
    outside = np.flatnonzero(np.abs(run["y"]) > MOST_Y)
    if run.diverged or outside[-1] == len(run) - 1:
        return np.inf
    return float(run.t[outside[-1] + 1])


def _peak(run: Trajectory, start: float) -> float:
    return np.inf if run.diverged else float(np.max(np.abs(run["y"][run.t >= start])))


def _edge(controller: Controller, factor: float) -> float:
    """Return the last stable k on the way from 1 in steps of ``factor``, up to 0.01 or 100 N/m."""
    stiffnesses = factor ** np.arange(math.ceil(math.log(100.0) / abs(math.log(factor))))
    lost = unstable([two_mass_spring(k=k) for k in stiffnesses], controller)
    return float(stiffnesses[max(int(np.argmax(lost)) - 1, 0) if np.any(lost) else -1])


def _parameter_bound(controller: Controller) -> float:
    """Return p, to 0.005, from the corners and middles of the box of m1, m2 and k."""
    law = law_before_learning(controller)
    for step in range(1, 199):
        p = 0.005 * step
        box = (1.0 - p, 1.0, 1.0 + p)
        plants = [two_mass_spring(*corner) for corner in product(box, repeat=3)]
        if any(unstable_under(plants, law, controller.dt)):
            return 0.005 * (step - 1)
    return 0.99
