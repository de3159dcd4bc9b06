"""Uncertain plants of the ACC benchmark: read from a file, or drawn.

A sample is a row ``(m1, m2, k_lin, k_nonlin, lambda, tau)``: masses [kg], stiffness [N/m] and its
cubic part [N/m³], effectiveness and lag [s] of the actuator. ``generated`` draws samples like those
that Rocchetta, Crespo & Kenny (DSCC 2019) published: each parameter has the quantiles of their 1000
samples of small uncertainty; spring, cubic part and effectiveness have the rank correlations of
theirs (a Gaussian copula). In the original, light and heavy m1 also tend to have soft springs;
without that the drawn samples are a little harsher.
"""

from __future__ import annotations

import os
from array import array

import numpy as np

from quell import checks
from quell.plants import CubicSpringPlant, LinearPlant, lagged_two_mass_spring
from quell.reading import MAX_SIZE, bytes_of, check_size, csv_rows, text_lines
from quell.types import Matrix, Vector

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
