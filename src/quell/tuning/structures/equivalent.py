"""The freed ADRC whose feedback is that of a given PI or PID controller with a filter.

In continuous time, with ``C = B(s)/(s A(s))``, A monic of degree n, and the nominal plant
``b0/s^n``, the poles of the law and of the observer are together the poles of the loop::

    s^(n+1) A(s) + b0 B(s) = p_law(s) p_observer(s)

This generalises the formulas of ``controllers/baselines/equivalent.py`` (Zhong, Huang & Guo,
*Science China Information Sciences* 63, 2020) to any poles. b0 is free: of its values, those are
taken for which all poles are damped. The sampled controllers agree to first order in dt.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from quell.tuning.structures.adrc import AdrcStructure
from quell.tuning.structures.pid import FilteredPID
from quell.types import Matrix, Vector

# Damping of the law's poles that is enough; it is the least one of the structure.
_LEAST = 0.6
# Damping of the poles of a start, above the least damping of an observer.
_LEAST_OF_ALL = 0.05
# Values of b0 that are tried, over this range around the one that makes the slowest terms equal.
_GAINS = np.logspace(-4.0, 4.0, 161)


def equivalents(pid: FilteredPID, values: Vector, adrc: AdrcStructure, most: int = 3) -> Matrix:
    """Return values (k, p) of a freed ADRC of order 1 or 2 with the same feedback, k ≤ ``most``.

    Of a PID controller that stabilises no nominal plant ``b0/s^n``, the poles that are unstable or
    hardly damped are replaced by damped ones of the same size: that is near it only. There are none
    for a structure with another order or form.
    """
    rows: list[tuple[float, Vector]] = []
    order = 2 if pid.derivative else 1
    form = adrc.form
    usable = form.freed and not form.based and not form.reduced and form.extended == 1
    if not usable or adrc.order != order or not pid.filtered:
        return np.zeros((0, len(adrc.parameters)))
    kp, ki, kd, f1, f2 = (float(part[0]) for part in pid.parts(values[None, :]))
    filters, numerator = ([f2, f1, 1.0], [kd, kp, ki]) if order == 2 else ([f1, 1.0], [kp, ki])
    A, B = np.array(filters) / filters[0], np.array(numerator) / filters[0]
    unit = adrc.parameters[0]
    center = np.sqrt(unit.low * unit.high)
    for b0 in center * _GAINS:
        whole = np.concatenate([A, np.zeros(order + 1)])
        whole[-order - 1 :] += b0 * B
        poles = np.roots(whole)
        damping = _damping(poles)
        split = _split(poles if damping > 0.0 else _damped(poles), order)
        row = None if split is None else adrc.rows_of(b0, *split)
        if split is not None and row is not None:
            rows.append((min(damping, _damping(split[0]) / 6.0), row))
    rows.sort(key=lambda entry: -entry[0])
    exact = [entry for entry in rows if entry[0] > 0.0] or rows[:most]
    kept = exact[:: max(len(exact) // most, 1)][:most]
    return np.array([row for _, row in kept]).reshape(-1, len(adrc.parameters))


def _damped(poles: Any) -> Any:
    """Return the poles with a damping of at least that of an observer."""
    size, least = np.abs(poles), _LEAST_OF_ALL
    few = -poles.real < least * size
    angle = np.sqrt(1.0 - least**2)
    moved = size * (-least + 1j * angle * np.sign(poles.imag))
    moved = np.where(poles.imag == 0.0, -size, moved)
    return np.where(few, moved, poles)


def _split(poles: Any, order: int) -> tuple[Any, Any] | None:
    """Return ``order`` poles for the law, conjugates together, and the others.

    The feedback does not depend on the choice. The response to the reference does: the law gets the
    slowest poles that are well damped, else the best damped ones.
    """
    found = []
    by_size = sorted(range(poles.size), key=lambda i: float(abs(poles[i])))
    for chosen in itertools.combinations(by_size, order):
        law = poles[list(chosen)]
        if abs(np.sum(law.imag)) < 1e-9 * np.max(np.abs(law)):
            found.append((law, np.delete(poles, list(chosen))))
    for law, observer in found:
        if _damping(law) >= _LEAST:
            return law, observer
    return max(found, key=lambda split: _damping(split[0]), default=None)


def _damping(poles: Any) -> float:
    return float(np.min(-poles.real / np.abs(poles)))
