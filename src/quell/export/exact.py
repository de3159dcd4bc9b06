"""The linear law of a controller with the numbers that stand in its C code.

Without limits a linear controller is, in each sample, a linear map of its state ξ and
of r and y::

    ξ⁺ = A ξ + B_r r + B_y y,      u = C ξ + D_r r + D_y y                                       (1)

(ADRC without learner, PID, LQG, compensator, state feedback, several axes of these). Here (1) is
not designed again: the kernel that C is a translation of runs with rational numbers, one unit
vector after the other, and each coefficient in it is the number of the file, 53 or 24 binary digits
as it stands there. So the matrices are exact, whatever the form of the observer is.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers import axes_learning
from quell.controllers.allocation import ActuatorLimits
from quell.controllers.base import NO_LIMITS, Limits, check_controller
from quell.controllers.held import NoHeldPlant
from quell.controllers.law import AdrcDesign, AdrcState
from quell.controllers.prefilters import without_prefilters
from quell.controllers.safe_set import NoSafeSet
from quell.controllers.schedule import is_scheduled
from quell.controllers.several import control_all, inputs_of, outputs_of, references_of
from quell.controllers.single import in_single_precision
from quell.export.controller_source import is_in_single, parameters_of
from quell.guard import UnguardedDesign, UnguardedMemory
from quell.kernels.sized import remade
from quell.learners.base import NoLearnerDesign, NoLearnerMemory

PRECISIONS = {"double": 2.0**-53, "single": 2.0**-24}
"""Largest relative change of a number by rounding."""

_NOT_LINEAR = (
    "controller: its law is not linear (a nonlinear feedback, a nonlinear observer, a safe set or "
    "the detection of a held plant); leave that out"
)

# ---- Numbers that run through the kernels ----


class _Number:
    """A number in the place of a float; a subclass says what an operation returns."""

    __array_ufunc__ = None  # NumPy's scalars leave operations to this class
    __slots__ = ("size",)

    def __init__(self, size: Any) -> None:
        self.size = size

    def _with(self, other: Any, sign: Callable[[Any, Any], Any], swapped: bool) -> Any:
        raise NotImplementedError

    def __add__(self, other: Any) -> Any:
        return self._with(other, operator.add, False)

    def __radd__(self, other: Any) -> Any:
        return self._with(other, operator.add, True)

    def __sub__(self, other: Any) -> Any:
        return self._with(other, operator.sub, False)

    def __rsub__(self, other: Any) -> Any:
        return self._with(other, operator.sub, True)

    def __mul__(self, other: Any) -> Any:
        return self._with(other, operator.mul, False)

    def __rmul__(self, other: Any) -> Any:
        return self._with(other, operator.mul, True)

    def __truediv__(self, other: Any) -> Any:
        return self._with(other, operator.truediv, False)

    def __rtruediv__(self, other: Any) -> Any:
        return self._with(other, operator.truediv, True)

    def __eq__(self, other: object) -> bool:
        return bool(self.size == _size(other))

    def __lt__(self, other: Any) -> bool:
        return bool(self.size < _size(other))

    def __le__(self, other: Any) -> bool:
        return bool(self.size <= _size(other))

    def __gt__(self, other: Any) -> bool:
        return bool(self.size > _size(other))

    def __ge__(self, other: Any) -> bool:
        return bool(self.size >= _size(other))

    __hash__ = None  # type: ignore[assignment]

    def __int__(self) -> int:
        return int(self.size)


def _size(value: Any) -> Any:
    return value.size if isinstance(value, _Number) else value


class Exact(_Number):
    """A rational number."""

    def _with(self, other: Any, sign: Callable[[Any, Any], Any], swapped: bool) -> Any:
        if isinstance(other, Bounded):
            return other._with(self, sign, not swapped)
        number = as_rational(other)
        if not isinstance(number, Fraction):  # a limit that is infinite
            return sign(number, float(self.size)) if swapped else sign(float(self.size), number)
        return Exact(sign(number, self.size) if swapped else sign(self.size, number))

    def __abs__(self) -> Exact:
        return Exact(abs(self.size))

    def __neg__(self) -> Exact:
        return Exact(-self.size)


def as_rational(value: Any) -> Any:
    """Return a number exactly; one that is infinite as it is."""
    if isinstance(value, Exact):
        return value.size
    return Fraction(float(value)) if math.isfinite(value) else float(value)


class Bounded(_Number):
    """A bound of a magnitude, and of what rounding has added to it in this sample."""

    __slots__ = ("error", "unit")

    def __init__(self, size: float, error: float, unit: float) -> None:
        self.size, self.error, self.unit = size, error, unit

    def _with(self, other: Any, sign: Callable[[Any, Any], Any], swapped: bool) -> Any:
        size, error = float(abs(_size(other))), getattr(other, "error", 0.0)
        if not math.isfinite(size):
            return other
        if sign in (operator.add, operator.sub):
            if size == 0.0 or self.size == 0.0:  # exact
                return Bounded(self.size + size, self.error + error, self.unit)
            found, missed = self.size + size, self.error + error
        elif sign is operator.mul:
            found = self.size * size
            missed = self.size * error + size * self.error + error * self.error
        elif swapped or error:
            raise ValueError("a law that divides by a signal is not linear")
        else:
            found, missed = self.size / size, self.error / size
        return Bounded(found, missed + self.unit * (found + missed), self.unit)

    def __abs__(self) -> Bounded:
        return self

    def __neg__(self) -> Bounded:
        return self


# ---- The exact law ----


class ExactLaw(NamedTuple):
    """The law (1): matrices of ``Fraction``, with the entries of the state that are in it."""

    A: Any  # (k, k)
    B: Any  # from the references, then the measurements (k, n_r + p)
    C: Any  # (m, k)
    D: Any  # (m, n_r + p)
    names: tuple[str, ...]  # of the entries (k,)


class Sample:
    """One sample of the kernel with other numbers than floats."""

    def __init__(self, design: Any, state: Any, signals: tuple[int, int, int]) -> None:
        self.places: list[tuple[Any, Any, str]] = []  # owner, index or field, dotted name
        self.design = _with_numbers(design)
        self._state = self._copied(state, "")
        self.references, self.outputs, self.inputs = signals
        self.run([0] * self.references, [0] * self.outputs)  # the first sample is a start
        self.origin = [self.read(i) for i in range(len(self.places))]
        self.free = [i for i, value in enumerate(self.origin) if value == 0]

    def _copied(self, part: Any, name: str) -> Any:
        if isinstance(part, tuple):
            fields = getattr(part, "_fields", range(len(part)))
            parts = [
                self._copied(each, f"{name}.{field}" if name else str(field))
                for field, each in zip(fields, part, strict=True)
            ]
            return remade(part, parts)
        if part.dtype.names is not None:
            record = SimpleNamespace(**{each: Exact(as_rational(part[0][each].item()))
                                        for each in part.dtype.names})  # fmt: skip
            self.places += [(record, each, f"{name}.{each}") for each in part.dtype.names]
            return [record]
        if part.dtype.kind != "f":
            return part.copy()
        array = _as_exact(part)
        self.places += [(array, at, f"{name}{list(at)}") for at in np.ndindex(*array.shape)]
        return array

    def read(self, i: int) -> Any:
        """Return entry i of the state."""
        owner, at, _ = self.places[i]
        value = getattr(owner, at) if isinstance(at, str) else owner[at]
        return value if isinstance(value, Bounded) else as_rational(value)

    def write(self, i: int, value: Any) -> None:
        """Set entry i of the state."""
        owner, at, _ = self.places[i]
        if isinstance(at, str):
            setattr(owner, at, value)
        else:
            owner[at] = value

    def run(self, r: Iterable[Any], y: Iterable[Any]) -> list[Any]:
        """Take a sample; return u."""
        u = np.full(self.inputs, Exact(Fraction(0)), dtype=object)
        try:
            control_all(self.design, self._state, _as_objects(r), _as_objects(y), u)
        except (AttributeError, TypeError):  # a power, a function of math, a reset of a part
            raise ValueError(_NOT_LINEAR) from None
        return [*u]

    def moved(self, x: dict[int, Any], given: dict[int, Any]) -> tuple[list[Any], list[Any]]:
        """Return the next free entries and u from a state and signals, with zeros elsewhere."""
        for i, value in enumerate(self.origin):
            self.write(i, Exact(value))
        for i, value in x.items():
            self.write(i, value)
        signals = [given.get(k, Exact(Fraction(0))) for k in range(self.references + self.outputs)]
        u = self.run(signals[: self.references], signals[self.references :])
        return [self.read(i) for i in self.free], u


def _as_objects(values: Iterable[Any]) -> Any:
    given = [each if isinstance(each, _Number) else Exact(Fraction(each)) for each in values]
    found = np.empty(len(given), dtype=object)
    found[:] = given
    return found


def _as_exact(array: Any) -> Any:
    found = np.empty(array.shape, dtype=object)
    for at in np.ndindex(*array.shape):
        found[at] = Exact(as_rational(array[at])) if math.isfinite(array[at]) else float(array[at])
    return found


def _with_numbers(part: Any) -> Any:
    """Return parameters with rational numbers, without limits."""
    if isinstance(part, Limits):
        return NO_LIMITS
    if isinstance(part, ActuatorLimits):
        ends = (-math.inf, math.inf, math.inf, -math.inf)
        return ActuatorLimits(*(np.full(part.low.shape, end) for end in ends))
    if isinstance(part, tuple):
        return remade(part, map(_with_numbers, part))
    if isinstance(part, np.ndarray):
        return _as_exact(part) if part.dtype.kind == "f" else part
    if isinstance(part, float | np.floating) and math.isfinite(part):
        return Exact(as_rational(part))
    return part


def sample_of(controller: Any, precision: str) -> Sample:
    """Return a sample of a controller in a precision, without prefilters and learners."""
    check_controller(controller, several=True)
    checks.one_of("precision", precision, tuple(PRECISIONS))
    if is_in_single(controller):
        if precision != "single":
            raise ValueError(
                f"precision = {precision!r}: this controller calculates in single; give 'single'"
            )
        controller = controller.controller  # in double, of which the parameters are made again
    plain = without_prefilters(controller)
    if is_scheduled(plain):
        raise ValueError(
            f"controller = {controller!r:.60}: its gains follow a schedule, so it is not one "
            "linear law; take it at fixed signals, controller.at(…)"
        )
    given = in_single_precision(plain) if precision == "single" else plain
    signals = references_of(plain), outputs_of(plain), inputs_of(plain)
    design, state = map(_without_learning, (parameters_of(given), given.initial_state()))
    if any(not isinstance(each.held, NoHeldPlant) or not isinstance(each.safe_set, NoSafeSet)
           for each in _adrc_designs(design)):  # fmt: skip
        raise ValueError(_NOT_LINEAR)  # a sample would not show it
    return Sample(design, state, signals)


def learns(controller: Any) -> bool:
    """Return whether a controller, or a part of it, has a learner."""
    return any(each.learns for each in _adrc_designs(without_prefilters(controller).parameters))


def _adrc_designs(part: Any) -> Iterator[AdrcDesign]:
    if isinstance(part, AdrcDesign):
        yield part
    elif isinstance(part, tuple):
        for each in part:
            yield from _adrc_designs(each)


def _without_learning(part: Any) -> Any:
    """Return parameters or a state without learners and guards."""
    nothing = np.zeros(0)
    if isinstance(part, AdrcDesign):
        return part._replace(learner=NoLearnerDesign(), guard=UnguardedDesign(), learns=False)
    if isinstance(part, AdrcState):
        return part._replace(learner=NoLearnerMemory(nothing), guard=UnguardedMemory(nothing))
    if isinstance(part, axes_learning.LearningDesign):
        return axes_learning.NoLearning()
    if isinstance(part, axes_learning.LearningMemory):
        return axes_learning.NoLearningMemory(nothing)
    if isinstance(part, tuple):
        return remade(part, map(_without_learning, part))
    return part


def exact_law(controller: Any, precision: str = "double") -> ExactLaw:
    """Return the law (1) of a linear controller, with the numbers of its exported code.

    Parameters
    ----------
    controller
        linear but for limits, prefilters and learners, which are left out; without a schedule.
    precision
        of the exported code, ``"double"`` or ``"single"``.

    Raises
    ------
    ValueError
        for another controller, and for one whose law is not linear.

    Examples
    --------
    >>> import quell as ql
    >>> law = exact_law(ql.baselines.PID(kp=3.0, ki=0.0, dt=0.01))
    >>> law.D.tolist()
    [[Fraction(3, 1), Fraction(-3, 1)]]
    """
    return law_of(sample_of(controller, precision))


def law_of(sample: Sample) -> ExactLaw:
    """Return the law of the entries that y or r reaches, and that reach u."""
    count = sample.references + sample.outputs
    still, rest = sample.moved({}, {})
    one = Exact(Fraction(1, 2**60))

    def column(found: tuple[list[Any], list[Any]]) -> tuple[list[Fraction], list[Fraction]]:
        moved, u = found
        return (
            [(each - before) / one.size for each, before in zip(moved, still, strict=True)],
            [(as_rational(each) - as_rational(before)) / one.size
             for each, before in zip(u, rest, strict=True)],
        )  # fmt: skip

    inputs = [column(sample.moved({}, {k: one})) for k in range(count)]
    columns: dict[int, tuple[list[Fraction], list[Fraction]]] = {}
    new = {i for i in range(len(sample.free)) if any(moved[i] for moved, _ in inputs)}
    while new:
        columns |= {i: column(sample.moved({sample.free[i]: one}, {})) for i in new}
        reached = {i for moved, _ in columns.values() for i, each in enumerate(moved) if each}
        new = reached - set(columns)
    kept = {i for i, (_, u) in columns.items() if any(u)}
    while True:
        more = {i for i, (moved, _) in columns.items() if any(moved[j] for j in kept)} | kept
        if more == kept:
            break
        kept = more
    at = sorted(kept)
    law = ExactLaw(
        A=_matrix([[columns[j][0][i] for j in at] for i in at], len(at)),
        B=_matrix([[moved[i] for moved, _ in inputs] for i in at], count),
        C=_matrix([[columns[j][1][k] for j in at] for k in range(sample.inputs)], len(at)),
        D=_matrix([[u[k] for _, u in inputs] for k in range(sample.inputs)], count),
        names=tuple(sample.places[sample.free[i]][2] for i in at),
    )
    _check_linear(sample, law, at, (still, rest))
    return law


def _matrix(rows: list[list[Fraction]], columns: int) -> Any:
    return np.array(rows, dtype=object).reshape(len(rows), columns)


def _check_linear(sample: Sample, law: ExactLaw, at: list[int], rest: tuple[Any, Any]) -> None:
    """Check that samples from small and from large numbers in all places go where the law says."""
    drawn = np.random.default_rng(0).integers(1, 1000, len(at) + law.D.shape[1])
    for unit in (Fraction(1, 2**70), Fraction(1)):
        values = np.array([int(each) * unit for each in drawn], dtype=object)
        x, given = values[: len(at)], values[len(at) :]
        expected = [*(law.A @ x + law.B @ given), *(law.C @ x + law.D @ given)]
        moved, u = sample.moved(
            {sample.free[i]: Exact(each) for i, each in zip(at, x, strict=True)},
            {k: Exact(each) for k, each in enumerate(given)},
        )
        found = [moved[i] - rest[0][i] for i in at]
        found += [as_rational(one) - as_rational(own) for one, own in zip(u, rest[1], strict=True)]
        if found != expected:
            raise ValueError(_NOT_LINEAR)
