"""Loops of several inputs and outputs: sensitivities, singular values, margins.

In discrete time, at the controller's samples, with a load d at the plant's inputs and the noise n
of the measurements::

    u = C_r r − C_y (y + n),  y = P (u + d),  S_i = (I + C_y P)⁻¹,  S_o = (I + P C_y)⁻¹,  T = I − S

S_i belongs to the plant's inputs (actuators), S_o to its outputs (sensors). Broken in all channels
at once, inputs and outputs, the loop has the sensitivity::

    [u + d; y + n] = S_b [d; n],        S_b = [S_i, −S_i C_y; P S_i, S_o]

from which everything here is taken. It is the response of the closed loop itself, so that nothing
is infinite where the plant has a pole.

* ``M_s = max σ̄(S)``, the largest singular value over all frequencies, and ``1/M_s``, the *modulus
  margin* for a change of L that mixes channels. It depends on the units of the channels: give
  signals of different kinds a size (``u_size``, ``y_size``).
* *Margins of a channel*, with all other loops closed: S_kk of channel k is ``1/(1 + L_k)`` for the
  loop broken there alone, so its ``Margins`` are those of L_k. A coupled loop can have good ones in
  every channel and none at all for changes in two channels at once (Skogestad & Postlethwaite,
  *Multivariable Feedback Control*, 2nd ed. 2005, section 3.7).
* *Disk margins* for changes in all channels at once (``analysis/disk.py``), at inputs, at outputs,
  or at both.

Maxima are searched on a grid that is dense near the poles of plant, controller and closed loop, is
halved where S_b moves between two of its points, and then refined.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.analysis.disk import DiskMargin, factors_of, largest_scaled, singular, worst_change
from quell.analysis.linearise import within_noise
from quell.analysis.loop import about_learning, assumed_of, duration, not_in_margins
from quell.analysis.margins import (
    Complex,
    Margins,
    Response,
    eigenvalues,
    frequencies,
    in_s_plane,
    least,
    margins,
    without_idle_chains,
)
from quell.analysis.matrices import (
    estimates_at,
    gain_ratios,
    law_matrices,
    law_of_axes,
    plant_matrices,
    sampled_matrices,
)
from quell.controllers.axes import Axes
from quell.lti.models import MatrixSystem
from quell.types import Matrix, Vector

# ---- The loop ----

_PLACES = ("inputs", "outputs", "both")
_NAMES = ("S_i", "S_o", "T_i", "T_o", "PS", "CS", "S_b")
# A step of S between two points of the grid, relative to its size, that is divided, in so many
# rounds at most. Then the largest value is known to a part in a thousand before it is refined.
_STEP, _ROUNDS = 0.05, 10
# Lowest frequency at which S is looked at, as a share of the grid's lowest one.
_TOWARDS_ZERO = 1e-3
# Error of an eigenvalue in units of the rounding error over its condition; chosen by hand.
_EPSILON = float(np.finfo(float).eps)
_ROUNDING = 10.0 * _EPSILON
# Radius of the circle on which rounding puts a repeated pole, in units of ‖A‖ and the root of ε,
# and the distance of two poles that differ, in units of their errors; chosen by hand.
_CIRCLE, _APART = 2.0, 3.0
# Error of the mean of a repeated pole, as a share of the distance of its members; chosen by hand.
_MEAN = 1e-3


class Peak(NamedTuple):
    """The largest value over all frequencies."""

    value: float
    omega: float  #: [rad/s]; NaN for an unstable loop


class Pole(NamedTuple):
    """A pole in the z-plane, which may be repeated."""

    z: complex
    multiplicity: int
    error: float
    """Distance from the unit circle within which rounding decides on which side z is."""


class MultivariableLoop:
    """The loop of a sampled plant with m inputs and p outputs, and a linear controller.

    Raises ``ValueError`` for matrices that do not fit, and a plant with direct feedthrough.

    Parameters
    ----------
    plant
        sampled plant ``x⁺ = A x + B u``, ``y = C x``, with its delays as states: (A, B, C), or an
        object that has these matrices, such as a ``control.StateSpace``.
    law
        a ``MatrixLaw``, (A, B_y, B_r, C, D_y, D_r) or (A, B_y, C, D_y), for ``x⁺ = A x + B_y y +
        B_r r``, ``u = C x + D_y y + D_r r``: the sign of the feedback is in it.
    dt
        sample time [s].
    u_size, y_size
        size of each control signal (m,) and of each output (p,), by which they are divided before
        singular values are taken; 1 by default.
    inputs, outputs
        names of the channels; ``u1``, … and ``y1``, … by default.

    Examples
    --------
    Two masses on a spring, a force and an encoder at each, and a PD controller at each.

    >>> import numpy as np
    >>> from quell.lti.models import zero_order_hold
    >>> A = np.array([[0, 1, 0, 0], [-1, 0, 1, 0], [0, 0, 0, 1], [1, 0, -1, 0.0]])
    >>> B, C = np.eye(4)[:, [1, 3]], np.eye(4)[[0, 2]]
    >>> A, (B,) = zero_order_hold(A, [B], 0.01)
    >>> D_y = -np.diag([104.0, 104.0])  # 4 y + 1 y' by a difference over a sample
    >>> law = (np.zeros((2, 2)), np.eye(2), 100.0 * np.eye(2), D_y)
    >>> loop = MultivariableLoop((A, B, C), law, dt=0.01)
    >>> loop.stable, round(loop.m_s("outputs").value, 2)
    (True, 2.12)
    >>> round(loop.disk_margin("both").alpha, 3)
    0.234
    """

    def __init__(
        self,
        plant: Any,
        law: Any,
        dt: float,
        *,
        u_size: Any = None,
        y_size: Any = None,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
    ) -> None:
        self.dt = checks.positive("dt", dt, "s")
        A, B, C = plant_matrices(plant)
        m, p = B.shape[1], C.shape[0]
        self.plant = MatrixSystem(A - np.eye(A.shape[0]), B, C, np.zeros((p, m)))
        self.law = law_matrices(law, m, p)
        self.inputs = _channel_names("inputs", inputs, "u", m)
        self.outputs = _channel_names("outputs", outputs, "y", p)
        sizes = [
            np.ones(count) if size is None else checks.positive_vector(name, size)
            for name, size, count in (("u_size", u_size, m), ("y_size", y_size, p))
        ]
        for name, size, count in zip(("u_size", "y_size"), sizes, (m, p), strict=True):
            if size.size != count:
                raise ValueError(f"{name} has {size.size} entries: must have {count}")
        self._size = np.concatenate(sizes)
        self._response = Response(self._broken())
        self.remark = ""
        """Lines on what the loop stands for, at the end of the summary."""

    def __repr__(self) -> str:
        m, p = len(self.inputs), len(self.outputs)
        states = f"{self.plant.N.shape[0]} + {self.law.A.shape[0]} states"
        head = f"MultivariableLoop of {m} inputs, {p} outputs and {states} at dt = {self.dt:g} s"
        return f"{head}:\n{self.summary()}"

    # ---- state space

    def _closed(self, factors: Vector | None = None) -> Matrix:
        """Return ``A − I`` of the closed loop, with a factor in each channel (m + p,)."""
        N, B, C, _ = self.plant
        law, m = self.law, B.shape[1]
        if factors is not None:
            B, C = B * factors[:m], C * factors[m:, None]
        inner = law.A - np.eye(law.A.shape[0])
        return np.block([[N + B @ law.D_y @ C, B @ law.C], [law.B_y @ C, inner]])

    def _broken(self) -> MatrixSystem:
        """Return ``S_b − I``, from (d, n) to (u, y)."""
        _, B, C, _ = self.plant
        law, (m, p) = self.law, (B.shape[1], C.shape[0])
        k = law.A.shape[0]
        into = np.block([[B, B @ law.D_y], [np.zeros((k, m)), law.B_y]])
        out = np.block([[law.D_y @ C, law.C], [C, np.zeros((p, k))]])
        direct = np.zeros((m + p, m + p))
        direct[:m, m:] = law.D_y
        return MatrixSystem(self._closed(), into, out, direct)

    def closed_loop(self, source: str, target: str) -> MatrixSystem:
        """Return the closed loop from signals to signals, the plant's states first.

        Parameters
        ----------
        source
            ``"r"``, ``"d"`` (loads at the plant's inputs) or ``"n"`` (noise).
        target
            ``"y"``, ``"u"`` or ``"e"``, which is r − y.

        Raises
        ------
        ValueError
            for another source or target, and for e with other than p references.
        """
        checks.one_of("source", source, ("r", "d", "n"))
        checks.one_of("target", target, ("y", "u", "e"))
        _, B, C, _ = self.plant
        law, k = self.law, self.law.A.shape[0]
        p, count = C.shape[0], law.B_r.shape[1]
        if target == "e" and count != p:
            raise ValueError(
                f'target = "e": the law has {count} references for {p} outputs; take "y"'
            )
        into = {
            "r": np.vstack([B @ law.D_r, law.B_r]),
            "d": np.vstack([B, np.zeros((k, B.shape[1]))]),
            "n": np.vstack([B @ law.D_y, law.B_y]),
        }[source]
        if target == "u":
            zero = np.zeros((B.shape[1], B.shape[1]))
            direct = {"r": law.D_r, "n": law.D_y, "d": zero}[source]
            return MatrixSystem(self._closed(), into, np.hstack([law.D_y @ C, law.C]), direct)
        out = np.hstack([C, np.zeros((p, k))])
        if target == "y":
            return MatrixSystem(self._closed(), into, out, np.zeros((p, into.shape[1])))
        D = np.eye(p) if source == "r" else np.zeros((p, into.shape[1]))
        return MatrixSystem(self._closed(), into, -out, D)

    # ---- poles

    @cached_property
    def _grouped(self) -> list[Pole]:
        return grouped_poles(self._closed())

    @property
    def poles(self) -> list[Pole]:
        """Closed-loop poles in the z-plane with their multiplicities, the slowest first.

        Eigenvalues that rounding cannot tell apart are one pole, at their mean.
        """
        return list(self._grouped)

    @cached_property
    def stable(self) -> bool:
        """True if all poles lie inside of the unit circle, by more than rounding errors."""
        return all(abs(pole.z) < 1.0 - pole.error for pole in self._grouped)

    @cached_property
    def note(self) -> str:
        """A line that begins with NOT if rounding decides about stability; empty otherwise."""
        for pole in self._grouped:
            if abs(abs(pole.z) - 1.0) <= pole.error:
                return (
                    f"NOT certain to be stable: a pole at |z| = {abs(pole.z):.9g} is on the unit "
                    f"circle within the rounding errors of {pole.error:.1g}; take a longer dt, or "
                    "a loop with more margin"
                )
        return ""

    def _stable_with(self, factors: Vector) -> bool:
        shifted = eigenvalues(self._closed(factors))
        return bool(np.all(2.0 * shifted.real + np.abs(shifted) ** 2 < 0.0))  # |z|² − 1

    # ---- frequency responses

    @cached_property
    def _grid(self) -> tuple[Vector, Complex]:
        """Frequencies (k,) [rad/s] and S_b (k, m + p, m + p) in units of the channels' sizes."""
        matrices = (self._closed(), self.plant.N, self.law.A - np.eye(self.law.A.shape[0]))
        poles = [in_s_plane(eigenvalues(N), self.dt) for N in matrices]
        omega = frequencies(np.concatenate(poles), self.dt)
        omega = np.append(omega[0] * _TOWARDS_ZERO, omega)
        values = self._sensitivity(omega)
        m = len(self.inputs)
        todo = np.arange(omega.size - 1)  # intervals, by their left end
        for _ in range(_ROUNDS):
            step = np.zeros(todo.size)
            for part in (slice(0, m), slice(m, None)):
                S = values[:, part, part]
                size = np.minimum(singular(S[todo]), singular(S[todo + 1]))
                step = np.maximum(step, singular(S[todo + 1] - S[todo]) / (1.0 + size))
            todo = todo[step > _STEP]
            if todo.size == 0:
                break
            middle = np.sqrt(omega[todo] * omega[todo + 1])
            at = todo + 1 + np.arange(todo.size)
            omega = np.insert(omega, todo + 1, middle)
            values = np.insert(values, todo + 1, self._sensitivity(middle), axis=0)
            todo = np.sort(np.concatenate([at - 1, at]))
        return omega, values

    @property
    def omega(self) -> Vector:
        """Frequencies [rad/s] for plots, up to half the sampling rate; dense where S_b moves."""
        return self._grid[0]

    def _sensitivity(self, omega: Vector) -> Complex:
        G = self._response(omega, self.dt)
        return np.eye(G.shape[1]) + G * (self._size / self._size[:, None])

    def response(self, name: str, omega: Any) -> Complex:
        """Return a frequency response (k, rows, columns), in the user's units.

        Parameters
        ----------
        name
            ``"S_i"``, ``"S_o"``, ``"T_i"``, ``"T_o"``, ``"PS"`` (loads to y), ``"CS"`` (noise to
            −u), or ``"S_b"``.
        omega
            frequencies [rad/s] (k,).

        Raises
        ------
        ValueError
            for another name, and at the frequency of a pole.
        """
        checks.one_of("name", name, _NAMES)
        G = self._response(omega, self.dt)
        m = len(self.inputs)
        i, o = slice(0, m), slice(m, None)
        rows, columns = {
            **{"S_i": (i, i), "T_i": (i, i), "S_o": (o, o), "T_o": (o, o)},
            **{"PS": (o, i), "CS": (i, o), "S_b": (slice(None), slice(None))},
        }[name]
        part: Complex = G[:, rows, columns]
        if name[0] == "S":
            return np.eye(part.shape[1]) + part
        return part if name == "PS" else -part

    def singular_values(self, name: str, omega: Any) -> NDArray[np.float64]:
        """Return the singular values (k, number), descending, in units of the channels' sizes.

        Arguments and errors as for ``response``.
        """
        values = self.response(name, omega)
        m = len(self.inputs)
        u, y = self._size[:m], self._size[m:]
        sizes = {"S_i": (u, u), "T_i": (u, u), "S_o": (y, y), "T_o": (y, y)}
        sizes |= {"PS": (y, u), "CS": (u, y), "S_b": (self._size, self._size)}
        rows, columns = sizes[name]
        scaled = values * columns / rows[:, None]
        return np.asarray(np.linalg.svd(scaled, compute_uv=False), dtype=np.float64)

    def peak(self, name: str) -> Peak:
        """Return the largest singular value of a response over all frequencies.

        ``name`` as for ``response``, in units of the channels' sizes; infinite for an unstable
        loop. M_s is that of ``"S_i"`` or ``"S_o"``.
        """
        checks.one_of("name", name, _NAMES)
        if not self.stable:
            return Peak(math.inf, math.nan)

        def value(omega: Vector) -> Vector:
            return self.singular_values(name, omega)[:, 0]

        return self._largest(value)

    def _largest(self, value: Callable[[Vector], Vector]) -> Peak:
        """Return the maximum of a function of frequencies, refined between those of the grid."""
        omega = self.omega

        def inverse(w: Vector) -> Vector:
            return 1.0 / np.maximum(value(w), 1e-300)

        lowest, at = least(inverse, omega, inverse(omega))
        return Peak(1.0 / lowest, at)

    # ---- margins

    def m_s(self, at: str) -> Peak:
        """Return ``max σ̄(S)`` at the ``"inputs"`` or the ``"outputs"``; see ``peak``."""
        checks.one_of("at", at, ("inputs", "outputs"))
        return self.peak("S_i" if at == "inputs" else "S_o")

    def channel_margins(self, channel: str) -> Margins:
        """Return the margins of a channel, with the loops of all other channels closed.

        ``channel`` is the name of an input or an output; raises ``ValueError`` for another one.
        """
        names = [*self.inputs, *self.outputs]
        k = names.index(checks.one_of("channel", channel, names))
        nan = math.nan
        if not self.stable:
            return Margins((1.0, 1.0), (nan, nan), 0.0, nan, 0.0, nan, 0.0, nan, 0.0, nan)

        def loop(omega: Vector) -> Complex:
            G: Complex = self._response(omega, self.dt)[:, k, k]  # S − 1 = −T
            return -G / (1.0 + G)

        def stable_with(gain: float) -> bool:
            factors = np.ones(len(names))
            factors[k] = gain
            return gain == 1.0 or self._stable_with(factors)

        return margins(loop, self.omega[1:], self.dt, stable_with)

    def disk_margin(self, at: str = "inputs", skew: float = 0.0) -> DiskMargin:
        """Return the disk margin for changes in all channels at the same time.

        Parameters
        ----------
        at
            ``"inputs"``, ``"outputs"`` or ``"both"``: the channels that change.
        skew
            σ from −1 to 1: 0 for as much more as less gain, 1 for discs of ``1/(1 − δ)``, −1 for
            those of ``1 + δ``.

        Raises
        ------
        ValueError
            for another place, or a skew out of range.
        """
        checks.one_of("at", at, _PLACES)
        skew = checks.finite("skew", skew)
        if abs(skew) > 1.0:
            raise ValueError(f"skew = {skew!r}: must be from -1 to 1")
        m = len(self.inputs)
        part = {"inputs": slice(0, m), "outputs": slice(m, None), "both": slice(None)}[at]
        count = self._size[part].size
        if not self.stable:
            return DiskMargin(0.0, math.nan, 0.0, math.nan, 0.0, (1.0 + 0j,) * count, skew)
        shift = 0.5 * (skew - 1.0) * np.eye(count)

        def shifted(omega: Vector) -> Complex:
            return self._sensitivity(omega)[:, part, part] + shift

        omega, values = self._grid
        values = values[:, part, part] + shift
        mixing = self._largest(lambda w: singular(shifted(w)))
        largest, where = largest_scaled(shifted, omega, values)
        lost_at, delta = worst_change(shifted(np.array([where]))[0])
        return DiskMargin(
            *(1.0 / largest, where, 1.0 / mixing.value, mixing.omega),
            *(lost_at, factors_of(delta, skew), skew),
        )

    def summary(self) -> str:
        """Return margins of the channels one at a time, and of all at once, in a few lines."""
        if not self.stable:
            worst = max(self._grouped, key=lambda pole: abs(pole.z))
            repeated = f" ({worst.multiplicity} times)" if worst.multiplicity > 1 else ""
            return "\n".join(
                [
                    f"unstable: a pole at |z| = {abs(worst.z):.6g}{repeated}",
                    *filter(None, [self.note, self.remark]),
                ]
            )
        lines = [
            f"M_s {peak.value:.3f} at the {at}, at {peak.omega:.3g} rad/s: modulus margin "
            f"{1.0 / peak.value:.3f}"
            for at, peak in ((at, self.m_s(at)) for at in ("inputs", "outputs"))
        ]
        for name in (*self.inputs, *self.outputs):
            m = self.channel_margins(name)
            lines.append(
                f"{name} alone: gain {m.gain[0]:.3g} … {m.gain[1]:.3g}, phase {m.phase:.1f}°, "
                f"modulus margin {m.modulus:.3f}, delay {duration(m.delay)}"
            )
        for at in _PLACES:
            d = self.disk_margin(at)
            where = "inputs and outputs" if at == "both" else f"{at}"
            lines.append(
                f"all {where} at once: disk margin {d.alpha:.3f}, gains {d.gain[0]:.3g} … "
                f"{d.gain[1]:.3g} or phases ±{d.phase:.1f}°, at {d.omega:.3g} rad/s"
            )
        return "\n".join([*lines, *filter(None, [self.note, self.remark])])


def analyse_axes(plant: Any, axes: Axes, operating_point: Any = None) -> MultivariableLoop:
    """Return the loop of several axes; see ``analysis.analyse``."""
    matrices = sampled_matrices(plant, axes.dt, operating_point)
    m, p = matrices[1].shape[1], matrices[2].shape[0]
    if (p, m) != (axes.outputs, axes.inputs):
        raise ValueError(
            f"plant has {m} inputs and {p} outputs: the controller has {axes.outputs} axes and "
            f"{axes.inputs} actuators"
        )
    law = law_of_axes(axes, estimates_at(axes, plant, operating_point))
    loop = MultivariableLoop(matrices, law, axes.dt, outputs=axes.names)
    lines = []
    if axes.takes_u_0:
        lines.append(
            "NOT in these margins: the loop that u_0 closes; give its controllers to Axes as "
            "drives, or analyse them on the plant with these compensators"
        )
    lines += not_in_margins(dict(zip(axes.names, axes.axes, strict=True)))
    learners = [axis.learner for axis in axes.axes]
    lines += about_learning(learners, gain_ratios(plant, axes, operating_point))
    gated = [
        f"{type(axis.learner).__name__} of {name}"
        for name, axis in zip(axes.names, axes.axes, strict=True)
        if within_noise(axis) is not None
    ]
    if gated:
        alone = law_of_axes(axes, estimates_at(axes, plant, operating_point), noise_hides=True)
        hidden = MultivariableLoop(matrices, alone, axes.dt, outputs=axes.names)
        left = f"M_s is {hidden.m_s('inputs').value:.3f} at the inputs" if hidden.stable else ""
        lines.append(assumed_of(", ".join(gated), left or "the loop is unstable"))
    if callable(axes.B0) or callable(axes.M):
        lines.append(
            "NOT judged at other operating points than this one, where B0 is another: "
            "analyse_points takes several"
        )
    loop.remark = "\n".join(lines)
    return loop


def _channel_names(
    argument: str, names: Sequence[str] | None, letter: str, count: int
) -> tuple[str, ...]:
    if names is None:
        return tuple(f"{letter}{i + 1}" for i in range(count))
    found = tuple(str(name) for name in names)
    if len(found) != count or len(set(found)) != count:
        raise ValueError(f"{argument} = {names!r}: must be {count} different names")
    return found


def grouped_poles(N: Matrix) -> list[Pole]:
    """Return the poles of ``A = N + I`` with their multiplicities, the slowest first.

    Rounding moves an eigenvalue by up to ε ‖A‖ over its condition, the product of its left and its
    right eigenvector, and one that is repeated k times by about the k-th root of ε. Poles whose
    distance is within the errors of both are one.
    """
    from scipy.linalg import eig, matrix_balance

    whole, idle = without_idle_chains(N)
    found: list[Pole] = [Pole(0j, idle, 0.0)] if idle else []
    if whole.size == 0:
        return found
    scaled = matrix_balance(whole, permute=False)[0]
    values, left, right = eig(scaled, left=True, right=True)
    # A itself is rounded, not only what is left of it without I.
    size, norm = values.size, float(np.linalg.norm(scaled + np.eye(len(scaled)), 2))
    condition = np.abs(np.sum(left.conj() * right, axis=0))
    away = np.abs(values[:, None] - values)
    # The circle of a pole that is repeated k times, for the largest k that has as many poles in it.
    circles = _CIRCLE * norm * _EPSILON ** (1.0 / np.arange(1.0, size + 1.0))
    inside = np.sort(away, axis=1) <= circles
    circle = circles[size - 1 - np.argmax(inside[:, ::-1], axis=1)]
    error = np.minimum(_ROUNDING * norm / np.maximum(condition, _EPSILON**2), circle)
    error = np.maximum(error, _ROUNDING * norm)
    group = np.arange(size)
    for i in range(size):
        near = away[i] <= _APART * np.minimum(error, error[i])
        group[np.isin(group, group[near])] = group[i]
    for label in np.unique(group):
        members = values[group == label]
        mean = complex(np.mean(members))
        # The mean of a group is known far better than its members.
        doubt = float(np.max(error[group == label]))
        if members.size > 1:
            doubt = max(_ROUNDING * norm, _MEAN * float(np.max(np.abs(members - mean))))
        found.append(Pole(1.0 + mean, members.size, doubt))
    return sorted(found, key=lambda pole: (abs(pole.z - 1.0), pole.z.imag))
