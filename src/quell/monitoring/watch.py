"""``Watch``: what changes in a machine over months, with false alarms that are bounded for ever.

Each window of operation gives a row of numbers (``windows``). As long as the machine is what it
was, the windows of one feature are exchangeable: any order of them is as likely as any other. Then
the rank of the newest value among all so far, with ties broken at random, gives p-values ::

    p_t = (number below x_t + U_t (number equal, itself included)) / t

that are independent and uniform on (0, 1), whatever the distribution of the values (Vovk, Gammerman
& Shafer, *Algorithmic Learning in a Random World*, 2nd ed. 2022: conformal test martingales). On
such numbers no betting pays: with ``z = Φ⁻¹(p)`` a bet on a shift by δ deviations from window s on
multiplies its stake in each window by ::

    L = exp(δ z − δ²/2),        E[L] = 1

and a mixture of the bets over shifts δ and begins s, with weights of the begins that add up to
one, ::

    E_t = Σ_δ π_δ Σ_{s ≤ t} w_s Π_{i=s}^{t} L_i + W_{t+1}
    w_s = W_s − W_{s+1},     W_s = 1/(1 + ln s)

is a nonnegative martingale that begins at one. So by Ville's inequality the probability that it
ever reaches 1/α is α at most (Ramdas, Grünwald, Vovk & Shafer, *Statistical Science* 38, 2023).
With F features each alarms at F/α: the probability of any false alarm, over all time and however
often one looks, is α at most. The sums over s are one number for each δ::

    S_t = (S_{t−1} + w_t) L_t

What it costs: a begin at window s must make up for ``w_s ≈ 1/(s ln² s)``, some 13 nats after half a
year of hours, beside 7 for α and F; a shift by δ gives δ²/2 in each window.

Ranks find any difference, however small: in a simulated machine without noise one of 1e-7. But no
sensor or converter holds its own gain better over months than 0.01 %: 10 ppm/K, of a good
reference, and 10 K. So values are ranked on a fixed grid of steps of 0.01 %, on which they stay
exchangeable, and what is less apart is a tie; and a change of less than 0.01 % that crosses a line
of the grid is no alarm, which can only lower the probability of a false one.

Exchangeable is an assumption. It fails where windows differ for other reasons (another product,
another program of moves, day and night), or where neighbouring windows are alike because of a slow
temperature: then changes of these are found, as alarms. The correlation of neighbours is looked at,
and a line with NOT says so.
"""

from __future__ import annotations

import json
import math
import os
import random
from bisect import bisect_left, bisect_right, insort
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.files import MAX_SIZE, bytes_of, check_size, write_json
from quell.monitoring.windows import (
    MOST_MISSING,
    Signals,
    check_window,
    features_of,
    windows_of,
    without_gaps,
)
from quell.quantities import AxesSignals, Conversion, Quantity, in_one_unit
from quell.records.record import columns_of
from quell.types import Vector

# Shifts that are bet on, in deviations of the windows, in both directions with equal weights.
# Chosen by hand: half to three deviations; larger ones show within the ranks' own limit.
_SHIFTS = np.array([0.5, 1.0, 2.0, 3.0])
_BETS = np.concatenate([_SHIFTS, -_SHIFTS])
_VERSION = 1
# Windows of a state: eleven years of hours. Chosen by hand, a state then has some 20 MB.
_MOST_WINDOWS = 100_000
# Share of windows in which a feature must be seen to be watched; windows from which on that and the
# correlation of neighbours is judged; least correlation that is told. Chosen by hand.
_SEEN, _JUDGED, _CORRELATED = 0.5, 30, 0.15
# Least change that alarms, as a share of the value: what converters drift by, see above.
_MATTERS = 1e-4
# Number of steps of the grid that makes those of all numbers above zero: ln of the least is -745.
_PLACES = 10_000_000
# Windows after which a change that does not alarm never will: the ranks are full of it.
_NEVER = 300

_HINTS = {
    ("b0", -1): "less torque for u (a magnet, a phase, the supply), or more inertia",
    ("b0", 1): "less inertia, as after a coupling that slips or a lost load",
    ("coulomb", 1): "more friction: bearings, seals, lubrication",
    ("viscous", 1): "more friction: bearings, seals, lubrication",
    ("viscous", -1): "less damping, or with b0 less torque constant",
    ("resonance", -1): "a coupling, belt or foot that is softer, or more inertia",
    ("resonance", 1): "a coupling that is stiffer, or less inertia",
    ("peak", 1): "less damping of a resonance",
    ("stiffness", -1): "a spring that is softer",
    ("noise", 1): "the sensor or its cable",
    ("error", 1): "the loop follows worse: see the other numbers",
    ("load", 1): "another load or an offset",
    ("load", -1): "another load or an offset",
}


# What shows numbers that no window has shown, by the first of each group.
_SHOWN_BY = {
    "b0": "b0 and friction need windows in which u moves y, with speeds and accelerations that "
    "differ: longer ones, or another --band or --order, in a new state",
    "resonance": "a resonance needs a peak in the spectrum of y, and a machine may have none",
}


class Alarm(NamedTuple):
    """A feature that has changed."""

    feature: str  #: of one of several axes with its name before it, ``elbow: b0``
    window: int  #: number of the window at which the alarm came, from 1 on
    at: str  #: its label
    since: int  #: number of the window with which the change probably began
    since_at: str  #: its label
    before: float  #: median before
    after: float  #: median from then on
    spread: float  #: deviation of single windows before

    @property
    def matters(self) -> bool:
        """Whether the change is above the drift of converters, 0.01 % of the value."""
        size = max(abs(self.before), abs(self.after))
        return not abs(self.after - self.before) <= _MATTERS * size  # unknown without a before

    @property
    def share(self) -> str:
        """The change as a share of the value before, as text; empty if that is zero."""
        change = self.after - self.before
        return f" ({100.0 * change / abs(self.before):+.3g} %)" if self.before else ""

    def describe(self) -> str:
        """Return the change in a line."""
        change = self.after - self.before
        texts = [
            (f"{self.before:.{digits}g}", f"{self.after:.{digits}g}") for digits in range(4, 10)
        ]
        before, after = next((pair for pair in texts if pair[0] != pair[1]), texts[-1])
        hint = _HINTS.get((self.feature.rpartition(": ")[2], 1 if change > 0.0 else -1))
        return (
            f"ALARM: {self.feature} {'rose' if change > 0.0 else 'fell'} from "
            f"{before} ± {self.spread:.2g} to {after}{self.share} since window {self.since} "
            f"({self.since_at}), seen at window {self.window} ({self.at})"
            f"{f': {hint}' if hint else ''}"
        )


def _step(value: float) -> int:
    """Return the step of a value on the grid of 0.01 %, in the order of values."""
    if value == 0.0:
        return 0
    place = _PLACES + round(math.log(abs(value)) / _MATTERS)
    return place if value > 0.0 else -place


class _Track:
    """The evidence about one feature."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.values: list[float] = []
        self.windows: list[int] = []  # in which they were, from 1 on
        self.ranked: list[int] = []  # steps of the values
        self.evidence = np.full(_BETS.size, -math.inf)  # ln S
        self.runs = np.zeros(_BETS.size)  # ln of the best product so far, from ``begins`` on
        self.begins = np.ones(_BETS.size, dtype=np.int64)
        self.alarm: Alarm | None = None

    @property
    def count(self) -> int:
        """Number of windows in which the feature was seen."""
        return len(self.values)

    def log_evidence(self) -> float:
        """Return ln E."""
        terms = np.append(
            self.evidence - math.log(_BETS.size), -math.log1p(math.log(self.count + 1))
        )
        return float(np.logaddexp.reduce(terms))

    def take(self, value: float, window: int, draw: float) -> None:
        """Take the value of a window."""
        step = _step(value)
        below, upto = bisect_left(self.ranked, step), bisect_right(self.ranked, step)
        count = self.count + 1
        insort(self.ranked, step)
        self.values.append(value)
        self.windows.append(window)
        self.bet((below + draw * (upto - below + 1)) / count)

    def bet(self, p: float) -> None:
        """Multiply the stakes for a p-value."""
        from scipy.special import ndtri

        gain = _BETS * float(ndtri(p)) - 0.5 * _BETS**2
        t = self.count
        weight = 1.0 / (1.0 + math.log(t)) - 1.0 / (1.0 + math.log(t + 1))
        self.evidence = np.logaddexp(self.evidence, math.log(weight)) + gain
        new = self.runs <= 0.0
        self.begins[new] = t
        self.runs = np.where(new, 0.0, self.runs) + gain

    def alarmed(self, at: list[str]) -> Alarm:
        """Return the alarm of now."""
        best = int(np.argmax(self.runs))
        begin = int(self.begins[best]) - 1
        before, after = np.array(self.values[:begin]), np.array(self.values[begin:])
        known = before.size > 0
        if not known and np.ptp(after) <= _MATTERS * np.max(np.abs(after)):
            before = after[:1]  # no window differs from the others by what matters
        middle = float(np.median(before)) if before.size else math.nan
        spread = 1.4826 * float(np.median(np.abs(before - middle))) if known else math.nan
        since, now = self.windows[begin], self.windows[-1]
        labels = at[now - 1], since, at[since - 1]
        return Alarm(self.name, now, *labels, middle, float(np.median(after)), spread)


class Watch:
    """Alarms about the numbers of a machine that change, with few false ones over all time.

    Feed it the rows of windows in the order of time. The probability that it ever raises an alarm
    while the windows of each feature are exchangeable is ``alpha`` at most.

    Parameters
    ----------
    features
        names of the numbers that are watched; those of the first row by default.
    alpha
        probability of a false alarm, over all features and all time.
    seed
        of the draws that break ties; any number that was not chosen with a look at the data.

    Raises
    ------
    ValueError
        for an alpha that is not between 0 and 1, or names that repeat.

    Examples
    --------
    >>> import numpy as np
    >>> rng, watch = np.random.default_rng(1), Watch()
    >>> for day in range(200):
    ...     row = {"b0": (500.0 if day < 150 else 450.0) + 10.0 * rng.normal()}
    ...     for alarm in watch.update(row, f"day {day}"):
    ...         print(alarm.feature, "since", alarm.since_at, "seen at", alarm.at)
    b0 since day 149 seen at day 154
    """

    alarms: list[Alarm]  #: those raised so far, one for a feature at most

    def __init__(
        self, features: tuple[str, ...] | None = None, *, alpha: float = 0.01, seed: int = 0
    ) -> None:
        self.alpha = checks.positive("alpha", alpha)
        if self.alpha >= 1.0:
            raise ValueError(f"alpha = {alpha!r}: must be below 1, such as 0.01")
        self.seed = checks.whole("seed", seed, 0)
        self.labels: list[str] = []
        self.alarms = []
        self.left_out: set[str] = set()
        self._tracks: dict[str, _Track] = {}
        if features is not None:
            self._begin(tuple(features))

    def _begin(self, names: tuple[str, ...]) -> None:
        if not names or len(set(names)) < len(names):
            raise ValueError(f"features = {names!r}: must be different names, one at least")
        self._tracks = {name: _Track(name) for name in names}

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the numbers that are watched."""
        return tuple(self._tracks)

    @property
    def threshold(self) -> float:
        """Logarithm of the evidence at which a feature alarms, ln(F/alpha)."""
        return math.log(max(len(self._tracks), 1) / self.alpha)

    def evidence(self, feature: str) -> float:
        """Return the logarithm of the evidence against a feature being as before."""
        return self._track(feature).log_evidence()

    def values(self, feature: str) -> Vector:
        """Return the values of a feature so far, without the windows that did not show it."""
        return np.array(self._track(feature).values)

    def _track(self, feature: str) -> _Track:
        return self._tracks[checks.one_of("feature", feature, self.features)]

    def update(self, row: Mapping[str, float], label: str = "") -> list[Alarm]:
        """Take the numbers of the next window; return the alarms that it raises.

        Parameters
        ----------
        row
            numbers by name. One that is NaN or missing says nothing; names that are not watched
            are left out, and the report says so.
        label
            of the window, such as its date.

        Raises
        ------
        ValueError
            for a row without numbers at the begin, or more windows than a state can have.
        """
        if not self._tracks:
            self._begin(tuple(row))
        if len(self.labels) >= _MOST_WINDOWS:
            rule = "is the most of a state: begin a new one, with longer windows"
            raise ValueError(f"{_MOST_WINDOWS} windows: {rule}")
        self.left_out |= row.keys() - self._tracks.keys()
        self.labels.append(label)
        number, new = len(self.labels), []
        for name, track in self._tracks.items():
            value = float(row.get(name, math.nan))
            if not math.isfinite(value):
                continue
            draw = random.Random(f"{self.seed}/{name}/{number}").random()
            track.take(value, number, draw)
            if track.alarm is None and track.log_evidence() >= self.threshold:
                alarm = track.alarmed(self.labels)
                if alarm.matters:
                    track.alarm = alarm
                    new.append(alarm)
        self.alarms += new
        return new

    def windows_to_alarm(self, feature: str) -> int | None:
        """Return after how many windows a change far beyond the spread alarms from now on.

        That is the usual number; the draws make it more or less. None if it usually never does:
        there are too few windows to compare with.
        """
        track = self._track(feature)
        if track.alarm is not None:
            return 0
        trial = _Track(feature)
        trial.values = [0.0] * track.count
        trial.evidence = track.evidence.copy()
        before = track.count
        for k in range(1, _NEVER + 1):
            trial.values.append(0.0)
            # Above all values before, and in the middle of those since.
            trial.bet((before + 0.5 * k) / (before + k))
            if trial.log_evidence() >= self.threshold:
                return k
        return None

    def describe(self) -> str:
        """Return alarms, and in lines with NOT what can not be said."""
        lines = [alarm.describe() for alarm in self.alarms]
        count = len(self.labels)
        if not lines:
            lines.append(
                f"no alarm in {count} windows; false alarms have a probability of "
                f"{self.alpha:g} at most, over all time"
            )
        unseen, unable, correlated, never, small = [], [], [], [], []
        for name, track in self._tracks.items():
            if track.count and track.alarm is None and track.log_evidence() >= self.threshold:
                small.append(f"{name}{track.alarmed(self.labels).share}")
            if track.count == 0 and count:
                never.append(name)
            elif count >= _JUDGED and track.count < _SEEN * count:
                unseen.append(f"{name} (in {track.count} of {count} windows)")
            elif track.alarm is None and self.windows_to_alarm(name) is None:
                unable.append(name)
            if track.alarm is None and (rho := self._neighbours(track)) is not None:
                correlated.append(f"{name} ({rho:.2f})")
        if small:
            lines.append(
                f"too small for an alarm, below {_MATTERS:.2%} of the value, which converters "
                f"drift by: {', '.join(small)}"
            )
        if never:
            kinds = {name.rpartition(": ")[2] for name in never}
            how = [text for kind, text in _SHOWN_BY.items() if kind in kinds]
            lines.append(
                f"NOT watched: {', '.join(never)}: none of {count} windows shows them, and more "
                f"windows like these do not either{''.join(f'; {text}' for text in how)}"
            )
        if unseen:
            lines.append(
                f"NOT watched well: {', '.join(unseen)}: the other windows do not show them: take "
                "longer ones, in a new state"
            )
        if unable:
            every = len(unable) == len(self._tracks)
            names = "all numbers" if every else ", ".join(unable)
            lines.append(
                f"NOT enough windows yet: {names}: a change now may never alarm; "
                f"{self._needed()} are needed before it"
            )
        if correlated:
            lines.append(
                f"NOT exchangeable: neighbouring windows are correlated: {', '.join(correlated)}; "
                "the bound on false alarms does not hold for these: take longer windows"
            )
        if self.left_out:
            lines.append(
                f"NOT watched: {', '.join(sorted(self.left_out))}: not among the features of the "
                "first window; begin a new state to watch them"
            )
        return "\n".join(lines)

    def _needed(self) -> int:
        """Return how many windows before a change are enough for an alarm."""
        trial = Watch(self.features, alpha=self.alpha)
        track = trial._tracks[self.features[0]]
        for count in range(1, 10_000):
            track.values.append(0.0)
            track.bet(0.5)
            if count % 5 == 0 and trial.windows_to_alarm(self.features[0]) is not None:
                return count
        return 10_000

    def _neighbours(self, track: _Track) -> float | None:
        """Return the correlation of neighbouring windows, if it is more than by chance."""
        from scipy.special import ndtri
        from scipy.stats import rankdata

        follow = np.flatnonzero(np.diff(track.windows) == 1)
        if follow.size < _JUDGED:
            return None
        steps = [_step(value) for value in track.values]
        scores = ndtri((rankdata(steps) - 0.5) / track.count)
        first, second = scores[follow], scores[follow + 1]
        size = float(np.std(first) * np.std(second))
        if size == 0.0:
            return None
        rho = float(np.mean((first - np.mean(first)) * (second - np.mean(second)))) / size
        most = float(ndtri(1.0 - 1e-3 / len(self._tracks))) / math.sqrt(follow.size)
        return rho if rho > max(most, _CORRELATED) else None

    def to_json(self) -> dict[str, Any]:
        """Return the state for JSON, from which ``from_json`` goes on."""
        tracks = {}
        for name, track in self._tracks.items():
            tracks[name] = {
                "values": track.values,
                "windows": track.windows,
                "evidence": [None if v == -math.inf else v for v in track.evidence.tolist()],
                "runs": track.runs.tolist(),
                "begins": track.begins.tolist(),
                "alarm": None if track.alarm is None else _finite(track.alarm._asdict()),
            }
        kept = {"alpha": self.alpha, "seed": self.seed, "labels": self.labels}
        return {
            "quell_watch": _VERSION,
            **kept,
            "left_out": sorted(self.left_out),
            "features": tracks,
        }

    @classmethod
    def from_json(cls, value: Any) -> Watch:
        """Return the watch of a state; raise ``ValueError`` if it is none."""
        try:
            if value["quell_watch"] != _VERSION:
                raise ValueError(f"version {value['quell_watch']!r}: must be {_VERSION}")
            made = cls(tuple(value["features"]) or None, alpha=value["alpha"], seed=value["seed"])
            made.labels = [str(label) for label in value["labels"]]
            made.left_out = set(map(str, value["left_out"]))
            for name, kept in value["features"].items():
                made._tracks[name] = _track_of(name, kept, len(made.labels))
        except (TypeError, KeyError, AttributeError, OverflowError) as error:
            raise ValueError(f"no state of quell watch: {error!r}") from None
        found = (track.alarm for track in made._tracks.values())
        alarms = [alarm for alarm in found if alarm is not None]
        made.alarms = sorted(alarms, key=lambda alarm: alarm.window)
        return made


def _finite(value: dict[str, Any]) -> dict[str, Any]:
    return {
        k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in value.items()
    }


def _track_of(name: str, kept: Any, windows: int) -> _Track:
    """Return the track of a state, checked."""
    track = _Track(name)
    track.values = checks.vector(f"{name}.values", kept["values"]).tolist()
    track.windows = [checks.whole(f"{name}.windows", k, 1, windows) for k in kept["windows"]]
    if len(track.windows) != len(track.values):
        raise ValueError(f"{name}: {len(track.values)} values of {len(track.windows)} windows")
    track.ranked = sorted(map(_step, track.values))
    evidence = [-math.inf if v is None else checks.finite(name, v) for v in kept["evidence"]]
    track.evidence = np.array(evidence)
    track.runs = checks.vector(f"{name}.runs", kept["runs"], _BETS.size)
    most = max(track.count, 1)
    track.begins = np.array([checks.whole(f"{name}.begins", k, 1, most) for k in kept["begins"]])
    if track.evidence.size != _BETS.size or track.begins.size != _BETS.size:
        raise ValueError(f"{name}: must have {_BETS.size} bets")
    if kept["alarm"] is not None:
        numbers: dict[str, Any] = {
            k: math.nan if v is None else v for k, v in kept["alarm"].items()
        }
        track.alarm = Alarm(**numbers)
    return track


# ---- A machine that is watched: its records, their windows, the state on disk ----

# Alarms of axes whose changes began within so many windows may have one cause: begins are known to
# some three windows. Chosen by hand.
_TOGETHER = 5


class Machine:
    """The watch of one machine, with how its windows are made; kept in a file.

    Of several axes each has its numbers, ``elbow: b0``, and alpha is shared by all of them.

    Parameters
    ----------
    window
        length of a window [s]: long against what makes neighbouring windows alike.
    order
        1 or 2: u acts on this derivative of y. Of several axes one for all, or one for each.
    band
        band of the regression [rad/s], see ``windows.features_of``.
    alpha
        probability of a false alarm, over all features and all time.

    Raises
    ------
    ValueError
        for arguments out of range.
    """

    def __init__(
        self,
        *,
        window: float = 60.0,
        order: int | Sequence[int] = 2,
        band: float | None = None,
        alpha: float = 0.01,
    ) -> None:
        self.window = checks.positive("window", window, "s")
        given: Any = order
        self.order: int | list[int]
        if checks.is_sequence(given):
            self.order = [checks.whole("order", each, 1, 2) for each in given]
        else:
            self.order = checks.whole("order", given, 1, 2)
        self.band = checks.optional(checks.positive, "band", band, "rad/s")
        self.watch = Watch(alpha=alpha)
        self.records: list[str] = []
        self.axes: tuple[str, ...] | None = None  #: names of the axes; None before the first window
        self.units: dict[str, tuple[str, str]] = {}  #: those of y and u of each axis, if known
        self.notes: list[str] = []  #: what was converted, since it was made or loaded
        self.left_out = 0  #: windows with too many missing samples, since it was made or loaded

    @property
    def settings(self) -> dict[str, Any]:
        """Window, order, band and alpha."""
        names = {"window": self.window, "order": self.order, "band": self.band}
        return {**names, "alpha": self.watch.alpha}

    def take(self, signals: Signals | Mapping[str, Signals], label: str) -> list[Alarm]:
        """Take all windows of a record, in order; return the alarms that they raise.

        Parameters
        ----------
        signals
            the record; of several axes by their names.
        label
            its name, in the labels of windows.

        Raises
        ------
        ValueError
            for a record that is shorter than a window, other axes than those before, units that
            do not convert to those of the windows before, and as ``features_of``.
        """
        axes = {"": signals} if isinstance(signals, Signals) else signals
        self.check_axes(tuple(axes))
        new: list[Alarm] = []
        count = 0
        every = zip(*(windows_of(each, self.window) for each in axes.values()), strict=True)
        for count, parts in enumerate(every, start=1):
            at = f"{label}, {(count - 1) * self.window:g} s"
            new += self.take_window(dict(zip(axes, parts, strict=True)), at)
        if count == 0:
            first = next(iter(axes.values()))
            duration = first.y.size * first.dt
            raise ValueError(
                f"{label}: {duration:g} s: must have a window of {self.window:g} s at least; "
                "record longer, or take shorter windows in a new state"
            )
        return new

    def check_axes(self, axes: tuple[str, ...]) -> None:
        """Raise a ``ValueError`` unless axes are those of the windows so far."""
        before = self.axes
        if before is not None and before != axes:
            theirs, ours = (", ".join(filter(None, each)) or "one y" for each in (axes, before))
            raise ValueError(
                f"record: has {theirs}, the state {ours}: must be the same axes in the same order; "
                "begin a new state"
            )
        if isinstance(self.order, list) and len(self.order) != len(axes):
            raise ValueError(
                f"order = {self.order!r}: must be one number, or {len(axes)}, one for each axis"
            )

    def take_window(self, parts: Mapping[str, Signals], label: str) -> list[Alarm]:
        """Take a window of each axis; leave it out if too much is missing in one of them."""
        self.axes = tuple(parts)
        row: dict[str, float] = {}
        parts = {name: self._in_its_units(name, part, label) for name, part in parts.items()}
        for i, (name, part) in enumerate(parts.items()):
            whole = without_gaps(part)
            if whole is None:
                self.left_out += 1
                return []
            order = self.order[i] if isinstance(self.order, list) else self.order
            own = features_of(whole, order, self.band)
            row |= {f"{name}: {key}" if name else key: value for key, value in own.items()}
        return self.watch.update(row, label)

    def _in_its_units(self, axis: str, part: Signals, label: str) -> Signals:
        """Return a window of an axis in the units of the windows before it."""
        record = label.rpartition(", ")[0] or label
        units, into = self.units.get(axis, ("", "")), []
        found = []
        for name, before, own in zip("yu", units, (part.y_unit, part.u_unit), strict=True):
            given = {"the state": Quantity("", before), record: Quantity("", own)}
            which = f"{name} of axis {axis}," if axis else name
            each, wanted, notes = in_one_unit(given, which)
            into.append(each[record])
            found.append(wanted.unit or own)
            if axis in self.units:
                self.notes += [note for note in notes if note not in self.notes]
        self.units[axis] = (found[0], found[1])
        if axis:  # its u is v
            into[1] = Conversion(into[0].factor)
        return part.converted(into[0], into[1])

    def _coupled(self) -> list[str]:
        """Return lines on axes without alarm, and on alarms of several that may have one cause."""
        found = [(each.feature.rpartition(": ")[0], each) for each in self.watch.alarms]
        quiet = [name for name in self.axes or () if name not in dict(found)]
        lines = []
        if found and quiet:
            lines.append(f"no alarm in {len(self.watch.labels)} windows: {', '.join(quiet)}")
        near = {
            axis
            for axis, one in found
            for other, two in found
            if other != axis and abs(one.since - two.since) <= _TOGETHER
        }
        if near:
            names = ", ".join(name for name in self.axes or () if name in near)
            lines.append(
                f"NOT decided which of the axes it is: {names} changed within {_TOGETHER} windows: "
                "axes that share actuators, a structure or a load show one cause in each; look "
                "first at what they have in common, then at the axis whose numbers changed most"
            )
        return lines

    def describe(self) -> str:
        """Return alarms, and in lines with NOT what can not be said."""
        lines = [self.watch.describe()] if self.watch.labels else []
        lines += self._coupled()
        lines += self.notes
        if self.left_out:
            lines.append(
                f"NOT watched: {self.left_out} windows in which more than {MOST_MISSING:.1%} of "
                "the samples were skipped or missing"
            )
        return "\n".join(lines)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the state to a JSON file, whole or not at all; replace the one before."""
        value = {"settings": self.settings, "records": self.records, **self.watch.to_json()}
        value["axes"] = None if self.axes is None else list(self.axes)
        value["units"] = {axis: list(units) for axis, units in self.units.items()}
        write_json(path, value, overwrite=True)

    @classmethod
    def load(cls, path: str | os.PathLike[str], max_size: float = MAX_SIZE) -> Machine:
        """Return the machine that ``save`` wrote; raise ``ValueError`` for another file."""
        name = os.fspath(path)
        check_size(Path(path).stat().st_size, bytes_of(max_size), name)
        try:
            value = json.loads(Path(path).read_text(encoding="utf-8"))
            made = cls(**value["settings"])
            made.records = [str(each) for each in value["records"]]
            made.watch = Watch.from_json(value)
            axes = value.get("axes", [""] if made.watch.labels else None)
            made.axes = None if axes is None else tuple(map(str, axes))
            units = dict(value.get("units", {}))
            made.units = {str(axis): (str(y), str(u)) for axis, (y, u) in units.items()}
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise ValueError(f"path = {name!r}: no state of quell watch ({error})") from None
        return made


def _quantities_of(known: Any, axis: int) -> tuple[str, str]:
    """Return the units of y and u of an axis; none for u of several, which is v."""
    if isinstance(known, AxesSignals):
        return known.y[axis].unit, ""
    return known.y.unit, known.u.unit


class WatchSink:
    """A sink of a real-time loop's telemetry that watches the machine while it runs.

    It works on the telemetry's own thread: the loop does not wait for it. Windows with many skipped
    deadlines or missing measurements are left out. The state is written after each window.

    Parameters
    ----------
    path
        file of the state; if it exists, it is continued with its settings.
    machine
        settings of a new state.
    on_alarm
        called with each alarm, on the telemetry's thread.
    """

    name = "watch"

    def __init__(
        self,
        path: str | os.PathLike[str],
        machine: Machine | None = None,
        on_alarm: Callable[[Alarm], None] | None = None,
    ) -> None:
        self.path = Path(path)
        exists = self.path.exists()
        self.machine = Machine.load(path) if exists else (machine or Machine())
        self.windows = 0
        self._on_alarm = on_alarm or (lambda alarm: None)
        self._rows: list[Any] = []
        self._header: Any = None
        self._count, self._label, self._dt = 0, "", math.nan

    def open(self, header: Any) -> None:
        """Begin a record."""
        from datetime import UTC, datetime

        self._header = header
        self.machine.check_axes(header.axis_names or ("",))
        self._dt, self._rows, self._count = header.dt, [], 0
        check_window(round(self.machine.window / self._dt))
        self._label = datetime.fromtimestamp(1e-9 * header.started, UTC).isoformat("T", "seconds")

    def write(self, rows: Any) -> None:
        """Take rows; at the end of a window, its numbers."""
        from quell.realtime.recordings import MODE
        from quell.realtime.supervisor import Mode

        running = rows[rows[:, MODE] == Mode.RUN]
        if running.size == 0:
            return
        self._rows.append(running.copy())
        self._count += running.shape[0]
        samples = max(round(self.machine.window / self._dt), 1)
        while self._count >= samples:
            every = np.concatenate(self._rows)
            self._rows, self._count = [every[samples:]], self._count - samples
            self._take(every[:samples])

    def _take(self, rows: Any) -> None:
        """Take the rows of a window."""
        from quell.realtime.recordings import K

        k = rows[:, K]
        skipped = np.sum(np.diff(k) - 1.0)
        if skipped > MOST_MISSING * k.size:
            self.machine.left_out += 1
            return
        label, left_out = f"{self._label} + {k[0] * self._dt:g} s", self.machine.left_out
        for alarm in self.machine.take_window(self._signals(rows), label):
            self._on_alarm(alarm)
        if self.machine.left_out > left_out:
            return
        self.windows += 1
        self.machine.save(self.path)

    def _signals(self, rows: Any) -> dict[str, Signals]:
        """Return the signals of each axis in rows."""
        header = self._header
        names = header.axis_names or ("",)
        features = header.axis_features if header.axis_names else (header.features,)
        found = {}
        for i, (name, of) in enumerate(zip(names, features, strict=True)):
            prefix, u = (f"{name}.", "v") if name else ("", "u")
            own = {
                each: rows[:, columns_of(header.channels, f"{prefix}{each}")]
                for each in ("f_residual", "f_learned", "theta")
                if (f"{prefix}{each}") in dict(header.channels)
            }
            f = None
            if "f_residual" in own:
                f = (own["f_residual"] + own["f_learned"])[:, 0]
            theta = own.get("theta", np.zeros((len(rows), 0)))
            learned = {key: theta[:, j] for j, key in enumerate(of) if j < theta.shape[1]}
            y, r, acts = (
                rows[:, columns_of(header.channels, each).start + i].copy()
                for each in ("y_measured", "r", u)
            )
            known = _quantities_of(header.signals, i)
            found[name] = Signals(acts, y, r, f, learned, self._dt, *known)
        return found

    def describe(self) -> str:
        """Return what the watch says, and which windows this record had."""
        lines = [f"watched: {self.windows} windows of {self.machine.window:g} s, in {self.path}"]
        if self.windows + self.machine.left_out == 0:
            lines.append(f"NOT watched: no whole window of {self.machine.window:g} s; run longer")
        return "\n".join([*lines, self.machine.describe()])

    def flush(self) -> None:
        """Do nothing: the state is written after each window."""

    def close(self) -> None:
        """Do nothing; a window that is not full is left out."""
