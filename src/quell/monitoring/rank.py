"""``rank``: which of several tunings was best, from logs of the running machine.

A log is one stretch of samples r, y, u under one tuning. The criterion is the mean of a loss, the
squared error for the RMS error. Two means of logs differ by chance, too, and neighbouring samples
are not independent. So the samples are put into batches, and the batches' means are taken for
independent (batch means; Ibragimov & Müller, *J. Business & Economic Statistics* 28, 2010, show
that Student's t holds for few and uneven batches). A batch is ten correlation times of the loss or
longer, ``τ = 1 + 2 Σ ρ_k`` over the initial positive sequence (Geyer, *Statistical Science* 7,
1992); where the reference repeats, it is a whole number of its periods. With the means m of the
losses and the variances s² of q batches, the ratio of two criteria is ::

    d = ln m_A − ln m_B,    var d = s_A²/(q_A m_A²) + s_B²/(q_B m_B²)

with min(q_A, q_B) − 1 degrees of freedom, which is safe for any variances (Ibragimov & Müller,
*Review of Economics and Statistics* 98, 2016). Where both logs have the same reference at the same
times, batches are compared in pairs, so that what the reference makes of the loss cancels:
``var d`` is that of the mean of ``B_A,i/m_A − B_B,i/m_B``. The level is shared by all pairs of
tunings (Bonferroni), so that in 95 % of all cases no tuning is called better that is not.

That the machine had the same task is a condition, and it is looked at: the reference by its level,
its size and its rate, the load by the slow part of u. What a loop rejects is in u below its
bandwidth, whatever its tuning; so a slow u that is another in mean or size means another load.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.files import as_json
from quell.identification import Measured
from quell.identification.record_file import in_common_units
from quell.records.metrics import overshoot, runs_away, worsened
from quell.types import Vector

CRITERIA = {"rms": "RMS error", "iae": "mean |error|", "effort": "mean |du/dt|"}
"""Criteria by name; the error is r − y."""

# Length of a batch in correlation times, least and most batches of a tuning. At ten correlation
# times neighbouring means are correlated by a twentieth. By trial (benchmarks/ranking.py).
_LENGTH, _LEAST, _MOST = 10.0, 10, 32
# Level of the tests of reference and load, and the differences that matter: of the level of r, and
# of the size and rate of r, as shares; of the mean of the slow u in its own deviations, and as a
# share; of the size of the slow u as a factor, which two good tunings do not reach. Batches that
# the tests of the load need, and their length in correlation times. Chosen by hand.
_LEVEL, _SAME_LEVEL, _SAME_SIZE = 1e-3, 0.01, 0.1
_SAME_LOAD, _SAME_MEAN, _SAME_SWING, _LEAST_OF_LOAD, _LENGTH_OF_LOAD = 1.0, 0.05, 1.4, 4, 5.0
# Two references are the same, or a reference repeats, if the RMS difference is below this share of
# its deviation: steps may be a sample late. Chosen by hand.
_REPEATS = 0.02
# Power with which the time asked for decides a difference as large as the one seen: 80 %.
_POWER = 0.8416
# A difference so many times smaller than its interval is not worth to wait for. Chosen by hand.
_HOPELESS = 6.0
# A step is a change of r by this share of its range, with so many samples of rest behind it.
_STEP, _REST = 0.2, 20


class Scores(NamedTuple):
    """Means of one tuning over its logs."""

    rms: float  #: RMS error [y-unit]
    iae: float  #: mean of |r − y| [y-unit]
    effort: float  #: mean of |du/dt| [u-unit/s]
    #: mean over the steps of r, as a share of the step; NaN without steps, or where y does not rest
    overshoot: float
    duration: float  #: of all logs together [s]
    batches: int  #: that the decision is based on


class Comparison(NamedTuple):
    """Two tunings, by the ratio of their criteria."""

    better: str  #: the one with the lower criterion, whether that is decided or not
    worse: str
    lower: float  #: by how much the criterion is lower, as a share of that of ``worse``
    least: float  #: lower end of the interval of ``lower``; negative if it may be higher
    most: float  #: upper end
    decided: bool  #: whether the interval is above zero and the logs can be compared
    needed: (
        float  #: further time of log for each, to decide a difference like this [s]; NaN if none
    )
    reasons: tuple[str, ...]  #: why the logs can not be compared

    def describe(self, criterion: str = "rms") -> str:
        """Return the verdict in a line, which begins with NOT where there is none."""
        what, names = CRITERIA[criterion], f"{self.better} and {self.worse}"
        if self.reasons:
            return f"NOT comparable: {names}: {'; '.join(self.reasons)}"
        share = f"{100.0 * self.lower:.3g} %"
        ends = f"{100.0 * self.least:.3g} to {100.0 * self.most:.3g} %"
        if self.decided:
            return f"{self.better} is better than {self.worse}: {what} lower by {share} ({ends})"
        text = f"NOT decided: {names} differ by {share} ({ends}) in {what}"
        if math.isnan(self.lower):
            return f"NOT decided: {names}: log at least {self.needed:.3g} s of each"
        if math.isnan(self.needed):
            return f"{text}: alike, as far as logs like these show; choose by another criterion"
        return f"{text}: log at least {self.needed:.3g} s more of each"


class Ranking(NamedTuple):
    """Tunings in the order of a criterion, and what is decided."""

    criterion: str
    confidence: float
    scores: dict[str, Scores]  #: by tuning, the lowest criterion first
    comparisons: tuple[Comparison, ...]  #: of all pairs
    notes: tuple[str, ...]  #: what the logs leave open for all
    lost: tuple[str, ...] = ()  #: tunings with which y ran away from r, which have no rank

    @property
    def best(self) -> str | None:
        """The tuning that is better than each other one that has a rank; None if not decided."""
        first = next(iter(self.scores))
        beaten = {each.worse for each in self.comparisons if each.better == first and each.decided}
        ranked = len(self.scores) - len(self.lost)
        return first if ranked and len(beaten) == ranked - 1 else None

    def describe(self) -> str:
        """Return the verdicts as text, those of the best with each other one first."""
        first = next(iter(self.scores))
        if not len(self.lost) < len(self.scores):
            return "\n".join(self.notes)
        mine = [each for each in self.comparisons if first in (each.better, each.worse)]
        others = [each for each in self.comparisons if each not in mine]
        lines = [each.describe(self.criterion) for each in mine + others]
        level = f"at {100.0 * self.confidence:g} % for all together"
        if self.best is not None:
            lines.insert(0, f"best: {self.best}, {level}")
        else:
            lines.insert(0, f"NOT decided which is best, {level}; lowest so far: {first}")
        return "\n".join([*lines, *self.worse, *self.notes])

    @property
    def worse(self) -> list[str]:
        """Lines on what of the best is worse than of another tuning, by more than 10 %."""
        if self.best is None:
            return []
        own, lines = self.scores[self.best]._asdict(), []
        for name, scores in self.scores.items():
            if name not in (self.best, *self.lost):
                found = worsened(scores._asdict(), own)
                texts = "; ".join(each.text for each in found if each.name != self.criterion)
                lines += [f"{self.best} is worse than {name} in {texts}"] if texts else []
        return lines

    def to_json(self) -> dict[str, Any]:
        """Return all numbers for JSON."""
        names = ("criterion", "confidence", "best", "lost", "scores", "comparisons", "worse")
        return as_json(self, *names, "notes")


def rank(
    logs: Mapping[str, Measured | Sequence[Measured]],
    *,
    criterion: str = "rms",
    confidence: float = 0.95,
) -> Ranking:
    """Decide which of several tunings was best, from logs of the running machine.

    Alternate the tunings (A, B, A, B) rather than log each once: what drifts from hour to hour then
    is in both.

    Parameters
    ----------
    logs
        for each tuning its log or logs, with a reference: r, y and u in samples (N,), all with one
        sample time and u in one unit: v = B0 u of an axis is so for one B0 only, see
        ``quell.records.gains.one_gain``. Leave out the first seconds after a change of the tuning.
        Logs in other units (``Measured.signals``) are converted to those of the first one, as from
        °F to K, and ``notes`` say so.
    criterion
        ``"rms"``, ``"iae"`` or ``"effort"``, see ``CRITERIA``; lower is better.
    confidence
        probability with which all verdicts hold, of tunings that are alike none.

    Returns
    -------
    Ranking
        with verdicts that begin with NOT where the logs do not decide, or can not be compared.

    Raises
    ------
    ValueError
        for fewer than two tunings, a log without reference, with another sample time, too short or
        with values that are not finite, units that do not convert, and arguments out of range.

    Examples
    --------
    >>> import numpy as np
    >>> noise = np.random.default_rng(1).normal(size=(2, 4000))
    >>> logs = {
    ...     name: Measured(np.cumsum(y), size * y, 0.1, np.zeros(4000))
    ...     for name, size, y in zip("AB", (1.0, 0.8), noise)
    ... }
    >>> rank(logs).best
    'B'
    """
    checks.one_of("criterion", criterion, tuple(CRITERIA))
    confidence = checks.positive("confidence", confidence)
    if confidence >= 1.0:
        raise ValueError(f"confidence = {confidence!r}: must be below 1, such as 0.95")
    tunings = {name: _checked(name, given) for name, given in logs.items()}
    if len(tunings) < 2:
        raise ValueError(f"logs: {len(tunings)} tuning; give logs of two or more to compare")
    tunings, notes = _in_common_units(tunings)
    dt = _common_sample_time(tunings)
    shared = _Batches(tunings, criterion)
    found = {name: _scores(tuning, shared.means[name].size) for name, tuning in tunings.items()}
    away = {name: sum(map(_ran_away, logs)) for name, logs in tunings.items()}
    lost = tuple(name for name in found if away[name])
    order = sorted(found, key=lambda name: (name in lost, float(getattr(found[name], criterion))))
    pairs = list(combinations([name for name in order if name not in lost], 2))
    level = (1.0 - confidence) / max(len(pairs), 1)
    notes += [
        f"NOT ranked: {name}: y ran away from r in {away[name]} of {len(tunings[name])} logs; look "
        "at these, and take a tuning that is stable"
        for name in lost
    ]
    comparisons = tuple(_compared(*pair, shared, tunings, criterion, level, dt) for pair in pairs)
    if all(len(tuning) == 1 for tuning in tunings.values()):
        notes.append(
            "NOT protected against drift: each tuning has one log; alternate them (A, B, A, B), "
            "as logs of the same name"
        )
    return Ranking(
        criterion,
        confidence,
        {name: found[name] for name in order},
        comparisons,
        tuple(notes),
        lost,
    )


# ---- Logs and their scores ----


def _checked(name: str, given: Any) -> list[Measured]:
    """Return the logs of a tuning."""
    several = [given] if isinstance(given, Measured) else list(given)
    if not several:
        raise ValueError(f"logs[{name!r}]: no log; give one at least")
    for i, log in enumerate(several):
        where = f"logs[{name!r}]" if len(several) == 1 else f"logs[{name!r}][{i}]"
        if not isinstance(log, Measured):
            raise ValueError(f"{where}: must be a quell.identification.Measured, is {log!r:.40}")
        if log.reference is None:
            raise ValueError(
                f"{where}: has no reference r; the error is r − y: record it, or add a column of "
                "its constant value"
            )
        size = np.size(log.y)
        for of, value in (("y", log.y), ("u", log.u), ("reference", log.reference)):
            checks.vector(f"{where}.{of}", value, size)
        if size < 2 * _LEAST:
            raise ValueError(f"{where}: {size} samples; must have {2 * _LEAST} at least")
    return several


def _in_common_units(
    tunings: Mapping[str, list[Measured]],
) -> tuple[dict[str, list[Measured]], list[str]]:
    """Return all logs in the units of the first, and what was converted."""
    every = {
        (name if len(logs) == 1 else f"{name}, log {i + 1}"): log
        for name, logs in tunings.items()
        for i, log in enumerate(logs)
    }
    alike, notes = in_common_units(every, error=True)
    left = iter(alike.values())
    return {name: [next(left) for _ in logs] for name, logs in tunings.items()}, notes


def _common_sample_time(tunings: Mapping[str, list[Measured]]) -> float:
    every = [log.dt for logs in tunings.values() for log in logs]
    if max(every) > (1.0 + 1e-3) * min(every):
        raise ValueError(
            f"logs: sample times from {min(every):g} to {max(every):g} s: must be one; the errors "
            "between samples are not seen by the slower one"
        )
    return float(np.mean(every))


def _loss(log: Measured, criterion: str) -> Vector:
    """Return the loss in each sample (N,)."""
    if criterion == "effort":
        return np.abs(np.diff(log.u, prepend=log.u[0])) / log.dt
    error = _error(log)
    return error**2 if criterion == "rms" else np.abs(error)


def _error(log: Measured) -> Vector:
    """Return r − y in each sample (N,)."""
    return np.asarray(log.reference, dtype=np.float64) - log.y


def _scores(logs: list[Measured], batches: int) -> Scores:
    """Return the means over the logs of a tuning."""
    mean = {
        name: float(np.mean(np.concatenate([_loss(log, name) for log in logs])))
        for name in CRITERIA
    }
    beyond = [each for log in logs for each in _overshoots(log)]
    return Scores(
        rms=math.sqrt(mean["rms"]),
        iae=mean["iae"],
        effort=mean["effort"],
        overshoot=float(np.mean(beyond)) if beyond else math.nan,
        duration=sum(log.y.size * log.dt for log in logs),
        batches=batches,
    )


def _ran_away(log: Measured) -> bool:
    """Return whether y ran away from r in a log."""
    r = np.asarray(log.reference, dtype=np.float64)
    return bool(runs_away(r[None], log.y[None], log.u[None, :, None])[0])


def _overshoots(log: Measured) -> list[float]:
    """Return the overshoot of each step of r before a rest of r, NaN where y does not rest."""
    r = np.asarray(log.reference)
    changes = np.flatnonzero(np.diff(r)) + 1
    if changes.size == 0 or changes.size > r.size // _REST:
        return []
    ends = np.append(changes[1:], r.size)
    least = _STEP * float(np.ptp(r))
    return [
        overshoot(log.y[k:end], float(r[k]), float(r[k - 1]))
        for k, end in zip(changes, ends, strict=True)
        if end - k >= _REST and abs(r[k] - r[k - 1]) >= least
    ]


# ---- Batches ----


class _Batches:
    """The batches of all tunings, of one length."""

    def __init__(self, tunings: Mapping[str, list[Measured]], criterion: str) -> None:
        losses = {name: [_loss(log, criterion) for log in logs] for name, logs in tunings.items()}
        self.period = _common_period(tunings)
        # The time scale of the loss; its changes within a period are those of the reference.
        every = [part for parts in losses.values() for part in parts]
        if self.period:
            every = [_without_cycle(part, self.period) for part in every]
        else:
            every = _without_reference(tunings, losses) or every
        correlated = max(correlation_time(part) for part in every)
        least = _LENGTH * correlated
        shortest = min(sum(part.size for part in parts) for parts in losses.values())
        length = max(math.ceil(least), shortest // _MOST, 1)
        if self.period:
            length = self.period * math.ceil(length / self.period)
        self.length = length
        self.share = min(correlated / length, 1.0)
        self.means = {
            name: np.concatenate([batch_means(part, length) for part in parts])
            for name, parts in losses.items()
        }


def batch_means(values: Vector, length: int) -> Vector:
    """Return the means of batches of ``length`` samples; what is left at the end is left out."""
    count = values.size // length
    return values[: count * length].reshape(count, length).mean(axis=1)


def correlation_time(values: Vector) -> float:
    """Return the integrated correlation time ``1 + 2 Σ ρ_k`` [samples], 1 for white noise.

    The sum ends where the sum of two neighbours is negative (Geyer 1992); the sums are made to
    fall, as they do for a reversible process.
    """
    size = values.size
    centred = values - np.mean(values)
    power = float(centred @ centred)
    if power <= 1e-30 * max(float(values @ values), 1e-300):
        return 1.0
    length = 2 ** math.ceil(math.log2(2 * size))
    spectrum = np.abs(np.fft.rfft(centred, length)) ** 2
    rho = np.fft.irfft(spectrum, length)[: size // 2] / power
    pairs = rho[: 2 * (rho.size // 2)].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0.0)
    pairs = np.minimum.accumulate(pairs[: negative[0]] if negative.size else pairs)
    return max(float(2.0 * np.sum(pairs) - 1.0), 1.0)


def _common_period(tunings: Mapping[str, list[Measured]]) -> int:
    """Return the period of the references [samples], 0 if they do not share one."""
    periods = [period_of(np.asarray(log.reference)) for logs in tunings.values() for log in logs]
    if min(periods) == 0 or max(periods) - min(periods) > 1:
        return 0
    return round(float(np.mean(periods)))


def period_of(r: Vector) -> int:
    """Return after how many samples a reference repeats, 0 if it does not, or is constant."""
    centred = r - np.mean(r)
    variance = float(np.mean(centred**2))
    if variance == 0.0 or r.size < 4:
        return 0
    length = 2 ** math.ceil(math.log2(2 * r.size))
    spectrum = np.abs(np.fft.rfft(centred, length)) ** 2
    products = np.fft.irfft(spectrum, length)[: r.size // 2]
    squares = np.cumsum(centred**2)
    lags = np.arange(products.size)
    # Mean of (r_{k+lag} − r_k)²/2 over the part that overlaps.
    before = np.append(0.0, squares)[r.size - lags]
    after = squares[-1] - np.append(0.0, squares)[lags]
    apart = (0.5 * (before + after) - products) / (r.size - lags) / variance
    risen = np.flatnonzero(apart > 0.1)
    if risen.size == 0:
        return 0
    same = np.flatnonzero(apart[risen[0] :] < _REPEATS**2 + 1e-9)
    if same.size == 0:
        return 0
    first = int(risen[0] + same[0])
    near = apart[first : first + max(first // 20, 3)]
    return first + int(np.argmin(near))


def _without_reference(
    tunings: Mapping[str, list[Measured]], losses: Mapping[str, list[Vector]]
) -> list[Vector]:
    """Return what the losses differ by, where all logs have the same references; else nothing."""
    first, *others = tunings
    if not all(_same_times(tunings[first], tunings[other]) for other in others):
        return []
    sizes = {name: float(np.mean(np.concatenate(parts))) or 1.0 for name, parts in losses.items()}
    return [
        part / sizes[other] - own / sizes[first]
        for other in others
        for part, own in zip(losses[other], losses[first], strict=True)
    ]


def _without_cycle(values: Vector, period: int) -> Vector:
    """Return values less their mean over all periods, whole periods only."""
    count = values.size // period
    if count < 2:
        return values
    cycles = values[: count * period].reshape(count, period)
    return (cycles - np.mean(cycles, axis=0)).ravel()


# ---- Two tunings ----


def _compared(
    first: str,
    other: str,
    shared: _Batches,
    tunings: Mapping[str, list[Measured]],
    criterion: str,
    level: float,
    dt: float,
) -> Comparison:
    """Compare two tunings, ``first`` the one with the lower criterion."""
    a, b = shared.means[first], shared.means[other]
    power = 0.5 if criterion == "rms" else 1.0
    if min(a.size, b.size) < _LEAST:
        whole = _LEAST * shared.length * dt
        nothing = math.nan, math.nan, math.nan
        return Comparison(first, other, *nothing, False, whole, ())
    reasons = _different_task(tunings[first], tunings[other], shared)
    mean_a, mean_b = float(np.mean(a)), float(np.mean(b))
    if mean_a <= 0.0:  # no error at all in one of them
        share = 0.0 if mean_b <= 0.0 else 1.0
        decided = share > 0.0 and not reasons
        return Comparison(first, other, share, share, share, decided, math.nan, reasons)
    d = math.log(mean_b / mean_a)
    if _same_times(tunings[first], tunings[other]) and a.size == b.size:
        rest = a / mean_a - b / mean_b
        spread, freedom = float(np.std(rest, ddof=1)) / math.sqrt(a.size), a.size - 1.0
    else:
        parts = [np.var(each, ddof=1) / (np.mean(each) ** 2 * each.size) for each in (a, b)]
        spread = math.sqrt(float(sum(parts)))
        freedom = min(a.size, b.size) - 1.0
    # Of neighbours: the variance of batch means lacks half a correlation time, and the correlation
    # time of a short record is found too short by more.
    spread *= math.sqrt(1.0 + 2.0 * shared.share)
    found = decide(d, spread, freedom, level)
    # ln of the ratio of criteria, as a share by which the better one is lower.
    lower, least, most = (-math.expm1(-power * each) for each in found.ends)
    decided = found.decided and not reasons
    duration = max(sum(log.y.size for log in tunings[name]) for name in (first, other)) * dt
    needed = math.nan
    if not decided and not math.isnan(found.enough):
        needed = max(duration * (found.enough - 1.0), 0.1 * duration)
    return Comparison(first, other, lower, least, most, decided, needed, reasons)


class Decision(NamedTuple):
    """The distribution that samples give the logarithm d of a ratio."""

    ends: tuple[float, float, float]  #: d, and the ends of its interval
    decided: bool  #: whether the interval is above zero
    enough: float  #: times as many samples would decide a difference like this; NaN: far too many


def decide(d: float, spread: float, freedom: float, level: float) -> Decision:
    """Decide whether the logarithm ``d`` of a ratio, of standard error ``spread``, is above zero.

    The interval is that of Student's t with ``freedom`` degrees of freedom; it misses the true
    value with the probability ``level``.
    """
    half = _quantile(1.0 - 0.5 * level, freedom) * spread
    enough = ((half + _POWER * spread) / d) ** 2 if d * _HOPELESS > half else math.nan
    return Decision((d, d - half, d + half), d > half, enough)


def _quantile(share: float, freedom: float) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(freedom, share))


def _same_times(a: list[Measured], b: list[Measured]) -> bool:
    """Return whether the logs have the same moving references at the same times, one by one."""
    if len(a) != len(b):
        return False
    return all(_same_reference(one, two) for one, two in zip(a, b, strict=True))


def _same_reference(a: Measured, b: Measured) -> bool:
    r, other = np.asarray(a.reference), np.asarray(b.reference)
    spread = float(np.std(r))
    if r.size != other.size or spread == 0.0:
        return False
    return float(np.sqrt(np.mean((r - other) ** 2))) <= _REPEATS * spread


def _different_task(a: list[Measured], b: list[Measured], shared: _Batches) -> tuple[str, ...]:
    """Return in what the task of the machine was another."""
    if not _same_times(a, b):
        r, other = (np.concatenate([np.asarray(log.reference) for log in each]) for each in (a, b))
        reasons = _different_reference(r, other, shared)
    else:
        reasons = []
    return (*reasons, *_different_load(a, b, shared))


def _different_load(a: list[Measured], b: list[Measured], shared: _Batches) -> list[str]:
    """Return in what the slow part of u differs, if the logs are long enough to tell.

    A load that is slower than a twentieth of the logs is by chance another one in each of them;
    that is in the intervals, as far as it moves the error.
    """
    period = shared.period

    def less_moves(values: Vector) -> Vector:
        return _without_cycle(values, period) if period else values

    window = round(max(correlation_time(less_moves(_error(log))) for log in (*a, *b)))
    window = min(window, max(shared.length // 4, 1))
    slow_a, slow_b = ([_moving_mean(log.u, window) for log in logs] for logs in (a, b))
    reasons: list[str] = []
    means = _own_batches(slow_a, slow_b, shared.length)
    if means is not None:
        middle_a, middle_b = (float(np.mean(each)) for each in means)
        unit = math.sqrt(0.5 * float(np.var(means[0]) + np.var(means[1])))
        most = max(_SAME_LOAD * unit, _SAME_MEAN * max(abs(middle_a), abs(middle_b)))
        if abs(middle_a - middle_b) > most and _differ(*means):
            reasons.append(f"the mean of u is {middle_a:.4g} and {middle_b:.4g}: another load")
    # What a reference that repeats makes of u is no load.
    rest = ([less_moves(each) for each in slow] for slow in (slow_a, slow_b))
    squares_a, squares_b = ([(each - np.mean(each)) ** 2 for each in part] for part in rest)
    swings = _own_batches(squares_a, squares_b, shared.length)
    if swings is not None and min(float(np.mean(each)) for each in swings) > 0.0:
        relative = [each / np.mean(each) for each in swings]
        ratio = 0.5 * math.log(float(np.mean(swings[1]) / np.mean(swings[0])))
        shifted = relative[0], relative[1] + 2.0 * ratio  # to first order, the logarithms
        if abs(ratio) > math.log(_SAME_SWING) and _differ(*shifted):
            reasons.append(
                f"the slow part of u swings {math.exp(abs(ratio)):.2g} times as much in one: "
                "another load"
            )
    return reasons


def _moving_mean(values: Vector, window: int) -> Vector:
    middle = float(np.mean(values))
    total = np.cumsum(np.append(0.0, values - middle))
    return middle + (total[window:] - total[:-window]) / window


def _own_batches(a: list[Vector], b: list[Vector], least: int) -> tuple[Vector, Vector] | None:
    """Return the batch means of two groups of values; None if they are too few."""
    length = math.ceil(_LENGTH_OF_LOAD * max(correlation_time(each) for each in (*a, *b)))
    length = max(length, least)
    of_a, of_b = (np.concatenate([batch_means(each, length) for each in group]) for group in (a, b))
    return (of_a, of_b) if min(of_a.size, of_b.size) >= _LEAST_OF_LOAD else None


def _different_reference(r: Vector, other: Vector, shared: _Batches) -> list[str]:
    """Return in what the references differ: level, size or rate."""
    reasons = []
    level, level_2 = float(np.mean(r)), float(np.mean(other))
    size, size_2 = float(np.std(r)), float(np.std(other))
    largest = max(abs(level), abs(level_2), size, size_2)
    if max(size, size_2) <= _SAME_LEVEL * largest:
        if abs(level - level_2) > _SAME_LEVEL * largest:
            reasons.append(f"the reference is {level:.4g} and {level_2:.4g}")
        return reasons
    for what, change in (("size", 0), ("rate", 1)):
        parts = [
            np.diff(each) ** 2 if change else (each - np.mean(each)) ** 2 for each in (r, other)
        ]
        sizes = [math.sqrt(float(np.mean(part))) for part in parts]
        if min(sizes) == 0.0 and max(sizes) == 0.0:
            continue
        far = max(sizes) > (1.0 + _SAME_SIZE) * min(sizes)
        means = [batch_means(part, shared.length) for part in parts]
        if far and (shared.period or min(sizes) == 0.0 or _differ(*means)):
            reasons.append(f"the {what} of the reference is {sizes[0]:.3g} and {sizes[1]:.3g}")
    return reasons


def _differ(a: Vector, b: Vector) -> bool:
    """Return whether the means of two samples differ, by Welch's test."""
    if min(a.size, b.size) < 2:
        return False
    parts = [float(np.var(each, ddof=1)) / each.size for each in (a, b)]
    spread = math.sqrt(sum(parts))
    apart = abs(float(np.mean(a) - np.mean(b)))
    if spread == 0.0:
        return apart > 0.0
    squares = sum(part**2 / (each.size - 1) for part, each in zip(parts, (a, b), strict=True))
    freedom = sum(parts) ** 2 / squares
    return apart > _quantile(1.0 - 0.5 * _LEVEL, freedom) * spread
