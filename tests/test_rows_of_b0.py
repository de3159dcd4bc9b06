"""A row of B0 from its models, and records of axes that do not fit."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

import quell as ql
from quell.identification import gain_matrix

from .cases import cases
from .test_short_records import DT, binary


def test_a_row_of_b0_is_the_mean_of_its_models_with_what_the_best_has_besides() -> None:
    """Scatter of the models counts; deviations grow where the error is not white or follows u."""
    u = np.column_stack([binary(64), binary(64, 3)])
    n, dt, scale_u, scale_y = 2, 0.1, np.array([2.0, 4.0]), 3.0
    form = SimpleNamespace(order=n, lag_of=lambda phi: 0.5, delay_of=lambda phi: 1.5)
    best: Any = SimpleNamespace(form=form, error=np.arange(1.0, 61.0), phi=None, converged=True)
    b = [np.array([1.0, 2.0]), np.array([1.2, 1.6])]
    C = [np.diag([0.01, 0.04]), np.diag([0.02, 0.02])]
    w = [0.75, 0.25]
    asked: list[Any] = []

    def residuals(error: Any, column: Any, lags: int) -> Any:
        asked.append((error.tolist(), column.tolist(), lags))
        first = len(asked) == 1
        return SimpleNamespace(white=first, independent=first, whiteness=8.0 if first else 5.0,
                               whiteness_limit=4.0, lags=2, cross_limit=0.5,
                               cross_correlation=np.array([9.0, 9.0, 0.1, -0.4, 0.75]))  # fmt: skip

    with patch.multiple(
        gain_matrix,
        weighted=lambda found: (best, [0, 1], w),
        gains=lambda one: (b[one], C[one]),
        total_delay=lambda one: one,
        mixture=lambda values, weights: (2.0, 0.25),
        physical=lambda one, unit, dt: (None, np.diag([0.0, 0.0, 0.0, 0.04, 0.09, 1.0])),
        residuals=residuals,
        _of_u=lambda one: "of u",
        _excitation=lambda C, names: (7.0, ("u1", "u2")),
        visible_up_to=lambda one, u, dt: 12.0,
    ):
        row = gain_matrix._row([best], u, dt, scale_u, scale_y, ("u1", "u2"))
    unit = 3.0 / scale_u / 0.01
    mean = 0.75 * b[0] + 0.25 * b[1]
    covariance = sum(
        wi * (Ci + np.outer(bi - mean, bi - mean)) for wi, bi, Ci in zip(w, b, C, strict=True)
    )
    enlarged = math.sqrt(max(8.0 / 4.0, (0.75 / 0.5) ** 2))
    assert row["enlarged"] == pytest.approx(enlarged)
    np.testing.assert_allclose(row["B0"], unit * mean)
    np.testing.assert_allclose(row["std"], enlarged * unit * np.sqrt(np.diag(covariance)))
    np.testing.assert_allclose(row["covariance"], enlarged**2 * covariance * np.outer(unit, unit))
    assert (row["condition"], row["together"], row["omega_max"]) == (7.0, ("u1", "u2"), 12.0)
    assert (row["total_delay"], row["total_delay_std"]) == pytest.approx((0.2, 0.025))
    assert (row["lag"], row["delay"]) == pytest.approx((0.05, 0.15))
    assert (row["lag_std"], row["delay_std"]) == pytest.approx((0.2, 0.3))
    assert row["noise"] == pytest.approx(3.0 * math.sqrt(np.mean(best.error**2)))
    assert (row["white"], row["independent"], row["converged"]) == (True, False, True)
    for (error, column, lags), own in zip(asked, u.T, strict=True):
        assert error == best.error[1:].tolist()
        assert column == own[4:-1].tolist()
        assert lags == min(gain_matrix._LAGS, 15)


@cases(
    ("change", "message"),
    [
        (
            {"y": np.ones((79, 2))},
            "u has 80 samples, y 79: must have as many, a row for each sample",
        ),
        ({"order": [1, 2, 1]}, "order has 3 numbers: must have one, or 2, one for each y"),
        ({"order": 5}, "order = 5: must be a whole number from 1 to 4"),
        ({"order": 4}, "samples: must have at least"),
        ({"dt": 0.0}, "dt = 0"),
    ],
)
def test_records_of_axes_that_do_not_fit_are_refused(change: Any, message: str) -> None:
    """Lengths, orders, samples for so many parameters."""
    u = np.column_stack([binary(80), binary(80, 3)])
    how: dict[str, Any] = {"u": u, "y": np.cumsum(u, axis=0), "dt": DT, "order": 1, **change}
    with pytest.raises(ValueError, match=message):
        ql.identification.identify_b0_matrix(**how)
