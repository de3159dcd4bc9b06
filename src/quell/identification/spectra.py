"""Modes from a power spectrum: frequency and damping, without gain and phase.

The power spectrum of a signal that a broad force excites, as that of an accelerometer on a machine
that shakes itself, is near each mode ::

    S(ω) = S_0 (ω/ω̄)^c + Σ_i A_i / ((1 − ω²/ω_i²)² + (2 ζ_i ω/ω_i)²)

with a background S_0 that is straight on a double logarithmic scale. The logarithm of S has errors
of equal size at all frequencies, those of an averaged periodogram (Bendat & Piersol, *Random Data*,
4th ed. 2010, sec. 8.5), so the least squares of ``ln S`` are taken. Modes are added, the strongest
peak of what is left over first, as long as the likelihood ratio shows more than chance.

The window of an estimate of S makes peaks as wide as some lines of the table. Where a peak is not
wider, its damping is not known: the interval begins at zero.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.files import nonfinite_to_none
from quell.identification.model import WITHIN_95
from quell.records.plotting import draw_line, given_axes, grid_of_axes, new_figure
from quell.types import Matrix, Vector

# Most modes, and steps of the search.
_MOST_MODES, _STEPS = 5, 200
# Width of a peak in lines of the table up to which the window may have made it: by hand.
_WINDOW = 4.0
# Least height of a peak over the background, as a factor of the power: by hand.
_HIGH = 2.0
_START_DAMPING = 0.03


class SpectralMode(NamedTuple):
    """A mode in a power spectrum."""

    omega: float  #: undamped frequency ω [rad/s]
    omega_interval: tuple[float, float]  #: 95 % interval of it [rad/s]
    damping: float  #: damping ratio ζ
    damping_interval: tuple[float, float]  #: 95 % interval of it, from 0 if the window is as wide
    height: float  #: power at the peak over the background, as a factor

    def __str__(self) -> str:
        """Return it as a line."""
        hertz = 2.0 * math.pi
        low, high = (end / hertz for end in self.omega_interval)
        zeta = self.damping_interval
        known = f"damping {self.damping:.4g}, 95 %: {zeta[0]:.4g} to {zeta[1]:.4g}"
        if zeta[0] == 0.0:
            known = f"damping at most {zeta[1]:.4g}, as the lines of the table are not closer"
        return (
            f"mode at {self.omega / hertz:.5g} Hz ({self.omega:.5g} rad/s), 95 %: {low:.5g} to "
            f"{high:.5g} Hz; {known}; {self.height:.3g} times the background"
        )


class SpectralModes(NamedTuple):
    """The modes of a power spectrum, the highest peak first."""

    modes: tuple[SpectralMode, ...]
    omega: Vector  #: [rad/s] (N,)
    power: Vector  #: as given (N,)
    model: Vector  #: (N,)

    def __str__(self) -> str:
        """Return the report."""
        return "\n".join([*map(str, self.modes), "a power spectrum has no gain and no phase"])

    def plot(self, axes: Any = None, *, ax: Any = None) -> Any:
        """Draw the spectrum and the model; return the axes.

        ``axes`` are one matplotlib axes, a new figure's by default.
        """
        figure = partial(new_figure, 8.0, 4.0)
        axes = np.ravel(grid_of_axes(given_axes(axes, ax), figure, 1))
        hertz = self.omega / (2.0 * math.pi)
        draw_line(axes[0], hertz, self.power, color="0.6", linewidth=1.5, label="table")
        draw_line(axes[0], hertz, self.model, color="C0", linewidth=1.0, label="model")
        axes[0].set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel="power")
        axes[0].legend(fontsize="small")
        axes[0].grid(alpha=0.3)
        return axes

    def to_json(self) -> dict[str, Any]:
        """Return the modes for JSON."""
        value = {"modes": [mode._asdict() for mode in self.modes]}
        return dict(nonfinite_to_none(value))


def modes_of_spectrum(omega: Any, power: Any, modes: int | None = None) -> SpectralModes:
    """Return frequency and damping of the modes in a power spectrum.

    Parameters
    ----------
    omega
        frequencies (N,), rising [rad/s].
    power
        power at them (N,), in any unit; ``|G|²`` of a response without phase.
    modes
        number of modes, 1 to 5; by default as many as the spectrum tells apart.

    Raises
    ------
    ValueError
        for a spectrum without a peak, or with fewer than 20 frequencies.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.linspace(0.2, 3.0, 400)
    >>> found = modes_of_spectrum(300.0 * x, 0.01 + 1.0 / ((1.0 - x**2) ** 2 + (0.1 * x) ** 2))
    >>> round(found.modes[0].omega, 1), round(found.modes[0].damping, 4)
    (300.0, 0.05)
    """
    omega = checks.vector("omega", omega)
    power = checks.vector("power", power, omega.size)
    most = _MOST_MODES if modes is None else checks.whole("modes", modes, 1, _MOST_MODES)
    if omega.size < 20:
        raise ValueError(f"omega has {omega.size} frequencies: must have at least 20")
    if not (omega[0] > 0.0 and np.all(np.diff(omega) > 0.0)):
        raise ValueError("omega: must rise from above zero on")
    if np.any(power <= 0.0):
        raise ValueError("power: must be positive; leave the other frequencies out")
    log, x = np.log(power), np.log(omega / math.sqrt(float(omega[0] * omega[-1])))
    slope = np.column_stack([np.ones(x.size), x])
    theta = np.linalg.lstsq(slope, log, rcond=None)[0]
    best = theta, log - slope @ theta, slope
    found: tuple[Vector, Vector, Matrix] | None = None
    for _ in range(most):
        start = _with_peak(best[0], best[1], omega, x)
        if start is None:
            break
        new = _fitted(start, omega, x, log)
        ratio = omega.size * math.log(
            max(float(np.sum(best[1] ** 2)), 1e-30) / max(float(np.sum(new[1] ** 2)), 1e-30)
        )
        if modes is None and ratio < 5.0 * math.log(omega.size):
            break
        best = found = new
    result = None if found is None else _result(*found, omega, power, x)
    if result is None or not result.modes:
        raise ValueError(
            "power has no peak that stands out of its background: no mode is found; excite the "
            "machine near its resonance, and average longer"
        )
    return result


def _model(theta: Vector, omega: Vector, x: Vector) -> tuple[Vector, Matrix]:
    """Return ln S and its derivatives; θ are ln S_0, c, and ln A, ln ω_i, ln ζ of each mode."""
    parts = [np.exp(np.clip(theta[0] + theta[1] * x, -80.0, 80.0))]
    slopes = [parts[0], parts[0] * x]
    for k in range(2, theta.size, 3):
        A, w, z = np.exp(np.clip(theta[k : k + 3], -80.0, 80.0))
        r = (omega / w) ** 2
        D = (1.0 - r) ** 2 + 4.0 * z * z * r
        part = A / D
        parts.append(part)
        slopes += [
            part,
            -part / D * (4.0 * (1.0 - r) * r - 8.0 * z * z * r),
            -part / D * 8.0 * z * z * r,
        ]
    total = np.sum(parts, axis=0)
    return np.log(total), np.column_stack(slopes) / total[:, None]


def _with_peak(theta: Vector, left: Vector, omega: Vector, x: Vector) -> Vector | None:
    """Return θ with a mode at the highest peak of what is left over."""
    from scipy.ndimage import median_filter

    smooth = median_filter(left, size=3, mode="nearest")
    at = int(np.argmax(smooth[1:-1])) + 1
    if smooth[at] < math.log(_HIGH):
        return None
    level = _model(theta, omega, x)[0][at] + left[at]
    z = _START_DAMPING
    return np.append(theta, [level + math.log(4.0 * z * z), math.log(omega[at]), math.log(z)])


def _fitted(start: Vector, omega: Vector, x: Vector, log: Vector) -> tuple[Vector, Vector, Matrix]:
    from scipy.optimize import least_squares

    best: Any = None
    for factor in (0.2, 1.0, 4.0):
        first = start.copy()
        first[-1] += math.log(factor)
        first[-3] += 2.0 * math.log(factor)
        done = least_squares(
            lambda theta: _model(theta, omega, x)[0] - log,
            first,
            lambda theta: _model(theta, omega, x)[1],
            method="lm",
            x_scale="jac",
            max_nfev=_STEPS,
        )
        best = done if best is None or done.cost < best.cost else best
    return best.x, -best.fun, best.jac


def _result(
    theta: Vector, left: Vector, J: Matrix, omega: Vector, power: Vector, x: Vector
) -> SpectralModes:
    free = max(omega.size - theta.size, 1)
    e = left - np.mean(left)
    rho = float(e[1:] @ e[:-1]) / (float(e @ e) or 1.0)
    rho = min(max(rho, 0.0), 0.95)
    factor = float(left @ left) / free * (1.0 + rho) / (1.0 - rho)
    size = np.linalg.norm(J, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    inverse = np.linalg.pinv((J / size).T @ (J / size), hermitian=True) / np.outer(size, size)
    model = np.exp(_model(theta, omega, x)[0])
    modes = []
    for k in range(2, theta.size, 3):
        A, w, z = np.exp(theta[k : k + 3])
        half = WITHIN_95 * np.sqrt(np.maximum(factor * np.diag(inverse)[k + 1 : k + 3], 0.0))
        straight = float(theta[0] + theta[1] * np.interp(w, omega, x))
        # A background that the peaks hide is the least power of the table at most.
        background = max(math.exp(min(max(straight, -80.0), 80.0)), 1e-3 * float(np.min(power)))
        height = 1.0 + float(A / (4.0 * z * z)) / background
        at = min(max(int(np.searchsorted(omega, w)), 1), omega.size - 1)
        spacing = float(omega[at] - omega[at - 1])
        low = 0.0 if 2.0 * z * w < _WINDOW * spacing else float(z * math.exp(-half[1]))
        ends = float(w * math.exp(-half[0])), float(w * math.exp(half[0]))
        zeta = low, float(z * math.exp(half[1]))
        if omega[0] < w < omega[-1]:
            modes.append(SpectralMode(float(w), ends, float(z), zeta, height))
    modes.sort(key=lambda mode: -mode.height)
    return SpectralModes(tuple(modes), omega, power, model)
