"""Linear models: reading, poles as users give them, exact sampling, norms.

Linear models as users give them, converted to state space or a transfer function.

``canonical`` and ``LinearPlant.of`` read models with ``read_model``; whatever takes a linear plant
uses one of the two.

Exact sampling of linear models: held inputs, and integrals of quadratic forms.

Norms of sampled systems: the peak-to-peak gain, and the sum of the squared impulse response.

**Peak-to-peak gain**, the largest output for inputs of at most one. It is the ℓ1 norm of the
impulse response, ``Γ = |D| + Σ |h_k|`` with ``h_k = C A^k B`` (Dahleh & Pearson, *IEEE Trans.
Automatic Control* 32, 1987): the input ``sign(h_{K−k})`` attains it in the limit. The first m terms
are added. The others are bounded: with ``M = A^m`` and ``‖M‖ = μ < 1``, and m split into ``m = J
b``, h is made of the rows ``R_j = C A^(jb)`` and the columns ``X_i = A^i B``, so that::

    Σ_{k ≥ m} |h_k| = Σ_{l ≥ 1} Σ_{j, i} |R_j M^l X_i| ≤ μ/(1 − μ) · Σ_j ‖R_j‖ · Σ_i ‖X_i‖

m is doubled until this is a small share of the sum. What is returned is the sum *and* this bound,
so it is never less than Γ, except for rounding errors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.parallel import one_blas_thread
from quell.types import Matrix, Vector

# ---- Linear models as users give them, converted to state space or a transfer function ----

# Leading coefficients of a numerator below this share of the largest one, at the rate of the
# fastest pole, are rounding errors of a conversion. Chosen by hand; not tuned further.
_ROUNDING = 1e-10
# Markov parameters below this share of the bound on their rounding count as zero. Chosen by hand
# above the unit roundoff of 1e-16; not tuned further.
ZERO_TOLERANCE = 1e-9


class StateSpace(NamedTuple):
    """``x' = A x + B u + E w``, ``y = C x``."""

    A: Matrix  # (n, n)
    B: Vector  # (n,)
    C: Vector  # (n,)
    E: Vector | None  # (n,), the input of the disturbance; None if it enters where u does


class TransferFunction(NamedTuple):
    """``y^(n) + a_{n−1} y^(n−1) + … + a_0 y = c_{n−1} u^(n−1) + … + c_0 u``.

    For a sampled model, shifts replace derivatives.
    """

    a: Vector  # (n,)
    c: Vector  # (n,)


def read_model(plant: Any, E: Any = None, dt: float | None = None) -> StateSpace | TransferFunction:
    """Return ``plant`` as a checked model; ``LinearPlant.of`` lists the accepted kinds.

    ``E`` is the input of the disturbance, see ``canonical``. With a sample time ``dt`` [s], a
    discrete-time model that has the same is accepted too.
    """
    if isinstance(plant, list):
        plant = tuple(plant)
    if isinstance(plant, tuple) and len(plant) in (3, 4):
        return _from_matrices(plant, E)
    if all(hasattr(plant, name) for name in "ABC"):
        _check_time(plant, dt)
        D = np.asarray(getattr(plant, "D", 0.0))
        if np.any(D != 0.0):
            raise ValueError(
                f"D = {D.tolist()}: must be zero, the output may not follow the input at once"
            )
        return _state_space(plant.A, plant.B, plant.C, _column(E, getattr(plant, "E", None)))
    if E is not None:
        raise ValueError(
            "E: only a plant with states has an input for the disturbance; leave E out"
        )
    if isinstance(plant, tuple) and len(plant) == 2:
        if not (np.isscalar(plant[1]) or getattr(plant[1], "ndim", 1) == 0):
            return _transfer_function(*plant)
        a = checks.vector("a", plant[0])
        b = checks.nonzero("b", plant[1], "or the input does not reach the plant")
        return TransferFunction(a, np.append(b, np.zeros(a.size - 1)))
    if all(hasattr(plant, name) for name in ("zeros", "poles", "gain", "to_tf")):
        plant = plant.to_tf()  # scipy.signal.ZerosPolesGain
    if hasattr(plant, "num") and hasattr(plant, "den"):
        _check_time(plant, dt)
        if np.ndim(plant.num) == 1:  # scipy.signal
            return _transfer_function(plant.num, plant.den)
        size = len(plant.num), len(plant.num[0])
        if size != (1, 1):
            raise ValueError(f"plant has {size} outputs and inputs: must have one of each")
        return _transfer_function(plant.num[0][0], plant.den[0][0])
    named = repr(getattr(plant, "name", None) or plant)
    if getattr(plant, "inputs", 1) > 1 or getattr(plant, "outputs", 1) > 1:
        raise ValueError(
            f"plant = {named} has {plant.inputs} control signals and {plant.outputs} outputs, here "
            "there is one of each; several: quell.Axes and quell.analysis.analyse"
        )
    raise ValueError(
        f"plant = {named}: must be a linear plant or control.StateSpace (with A, B, C), matrices "
        "(A, B, C) or (A, B, E, C), a control.TransferFunction, (numerator, denominator) or "
        "(a, b); linearise a nonlinear plant first, quell.plants.linearised(plant, x, u); one "
        "without equation, as an FMU, is tuned for from an experiment, quell tune --device "
        "twin:FILE.fmu, or from a record, quell run SETUP --save run.nc and quell tune run.nc"
    )


def to_state_space(model: TransferFunction) -> StateSpace:
    """Return ``model`` in observable companion form, with its coefficients unchanged.

    Without zeros the states are y and its derivatives: ``x_i' = x_{i+1}``, ``x_n' = −a·x + c_0 u``.
    With zeros, where derivatives would jump with u, ``x_1 = y`` and
    ``x_i' = x_{i+1} − a_{n−i} x_1 + c_{n−i} u``. The z of ``canonical`` would add rounding errors:
    its Markov parameters contain the slow zeros of a plant with a pole at 10000 rad/s as
    differences of numbers 1e8 times as large.
    """
    a, c = model
    n = a.size
    A = np.diag(np.ones(n - 1), 1)
    if not np.any(c[1:]):
        A[-1] = -a
        B = np.append(np.zeros(n - 1), c[0])
    else:
        A[:, 0] -= a[::-1]
        B = c[::-1].copy()
    return StateSpace(A, B, np.eye(n)[0], None)


def is_linear_model(value: Any) -> bool:
    """Return whether ``value`` looks like a model for ``read_model``: by attributes or numbers."""
    if isinstance(value, tuple | list):
        first = value[0] if value else None
        return isinstance(first, int | float | np.number | np.ndarray | tuple | list)
    kinds = (("A", "B", "C"), ("num", "den"), ("zeros", "poles", "gain"))
    return not isinstance(value, type) and any(
        all(hasattr(value, name) for name in names) for names in kinds
    )


def leading_gain(A: Matrix, column: Matrix, C: Matrix) -> tuple[float, int] | None:
    """Return the first nonzero Markov parameter, ``b = C A^(ν−1) column``, and its ν from 1 to n.

    ``column`` (n, 1) is the input: B, or a column of E. b is in y-unit / input-unit / s^ν. None if
    the input does not reach y. Values below 1e-9 of ``|C| |A|^(ν−1) |column|`` are rounding errors.
    """
    row, bound = C[0], np.abs(C[0])
    for degree in range(1, A.shape[0] + 1):
        gain = float(row @ column[:, 0])
        if abs(gain) > ZERO_TOLERANCE * float(bound @ np.abs(column[:, 0])):
            return gain, degree
        row, bound = row @ A, bound @ np.abs(A)
    return None


def check_matrices(A: Any, B: Any, C: Any, several: bool = False) -> tuple[Matrix, Matrix, Matrix]:
    """Return A (n, n), B (n, m) and C (p, n), checked; B and C may be given as vectors.

    m and p are 1, unless ``several`` are allowed.
    """
    A = checks.matrix("A", A)
    n = A.shape[0]
    if A.shape != (n, n):
        checks.matrix("A", A, n, n)
    B, C = checks.numbers("B", B), checks.numbers("C", C)
    inputs = np.shape(B)[1] if np.ndim(B) == 2 else 1
    outputs = np.shape(C)[0] if np.ndim(C) == 2 else 1
    if max(inputs, outputs) > 1 and not several:
        raise ValueError(
            f"B has shape {np.shape(B)}, C {np.shape(C)}: {inputs} inputs and {outputs} outputs, "
            "here there is one of each; several are controlled by quell.Axes and judged by "
            "quell.analysis.analyse"
        )
    B = np.reshape(B, (-1, 1)) if np.ndim(B) == 1 else checks.matrix("B", B)
    C = np.reshape(C, (1, -1)) if np.ndim(C) == 1 else checks.matrix("C", C)
    for name, value, shape, rule in (
        ("B", B, (n, inputs), "a row for each state, a column for each control signal"),
        ("C", C, (outputs, n), "a row for each output, a column for each state"),
    ):
        if value.shape != shape:
            raise ValueError(
                f"{name} has shape {value.shape}, A {A.shape}: must be a matrix of shape {shape}, "
                f"{rule}"
            )
    return A, B, C


def several_matrices(model: Any, E: Any = None) -> tuple[Any, Any, Any, Any] | None:
    """Return A, B, C and E of a model with several inputs or outputs; None for another one.

    A model is ``(A, B, C)``, ``(A, B, E, C)``, or has A, B and C, and D of zero. ``E`` is the
    input of the disturbances in place of the model's own.

    Raises
    ------
    ValueError
        for a model of discrete time, and one in which y follows u at once.
    """
    of_model, own, D = None, None, 0.0
    if isinstance(model, tuple | list) and len(model) in (3, 4):
        of_model, own = (model[0], model[1], model[-1]), model[2] if len(model) == 4 else None
    elif all(hasattr(model, part) for part in "ABC"):
        of_model, own = (model.A, model.B, model.C), getattr(model, "E", None)
        D = getattr(model, "D", 0.0)
    if of_model is None:
        return None
    B, C = checks.numbers("B", of_model[1]), checks.numbers("C", of_model[2])
    if not ((np.ndim(B) == 2 and np.shape(B)[1] > 1) or (np.ndim(C) == 2 and np.shape(C)[0] > 1)):
        return None
    _check_time(model, None)
    if np.any(np.asarray(D)):
        raise ValueError("model has D other than zero: y must not follow u at once")
    return *of_model, own if E is None else _column(E, own)


def _from_matrices(plant: tuple[Any, ...], E: Any) -> StateSpace:
    """Read ``(A, B, C)`` or ``(A, B, E, C)``."""
    A, B, C = plant[0], plant[1], plant[-1]
    if len(plant) == 4:
        if E is not None:
            raise ValueError(
                "E is given twice: in plant = (A, B, E, C) and as an argument; leave one out"
            )
        # scipy and python-control have (A, B, C, D); then C has another shape or is a zero D.
        fits = np.size(C) == checks.matrix("A", A).shape[0]
        if not fits or not np.any(C):
            what = "is zero" if fits else f"has shape {np.shape(C)}"
            raise ValueError(
                f"C, the last of four, {what}: four entries are (A, B, E, C), not (A, B, C, D); "
                "D must be zero, leave it out"
            )
        E = plant[2]
    return _state_space(A, B, C, _column(E, None))


def _state_space(A: Any, B: Any, C: Any, E: Any) -> StateSpace:
    A, B, C = check_matrices(A, B, C)
    if E is not None:
        E = checks.matrix("E", E, A.shape[0], 1)[:, 0]
        if not np.any(E):
            raise ValueError("E is zero: the disturbance must enter somewhere")
    return StateSpace(A, B[:, 0], C[0], E)


def _column(E: Any, columns: Any) -> Any:
    """Return ``E`` as a column; an index selects one of the plant's disturbance ``columns``."""
    if isinstance(E, int | np.integer) and not isinstance(E, bool):
        if columns is None:
            raise ValueError(
                f"E = {E!r}: this plant has no disturbance inputs of its own; give a column (n,)"
            )
        return np.asarray(columns)[:, [checks.whole("E", E, 0, np.shape(columns)[1] - 1)]]
    return np.reshape(E, (-1, 1)) if np.ndim(E) == 1 else E


def _transfer_function(numerator: Any, denominator: Any) -> TransferFunction:
    """Read coefficients in descending powers of s."""
    num = np.trim_zeros(checks.vector("numerator", numerator), "f")
    den = np.trim_zeros(checks.vector("denominator", denominator), "f")
    if num.size == 0:
        raise ValueError("numerator is zero: the input must reach the output")
    if den.size < 2:
        raise ValueError(
            f"denominator has degree {max(den.size - 1, 0)}: must be at least 1, for a state"
        )
    num = _without_rounding(num, den)
    if num.size > den.size:
        raise ValueError(
            f"transfer function is improper: its numerator has degree {num.size - 1}, its "
            f"denominator {den.size - 1}; no plant differentiates its input"
        )
    if num.size == den.size:
        raise ValueError(
            f"transfer function is biproper: numerator and denominator have degree {den.size - 1}, "
            "so y follows u at once; model the lag of the actuator or the sensor too"
        )
    c = np.zeros(den.size - 1)
    c[: num.size] = num[::-1] / den[0]
    return TransferFunction(den[:0:-1] / den[0], c)


def _without_rounding(num: Vector, den: Vector) -> Vector:
    """Return ``num`` without leading coefficients left over by a conversion from state space."""
    rate = np.max(np.abs(np.roots(den)))
    if rate == 0.0:
        return num
    size = np.abs(num) * rate ** np.arange(num.size - 1.0, -1.0, -1.0)
    return num[int(np.argmax(size > _ROUNDING * np.max(size))) :]


def _check_time(plant: Any, dt: float | None) -> None:
    own = getattr(plant, "dt", None)
    if not own:
        return
    if dt is None:
        raise ValueError(
            f"plant has a sample time, dt = {own!r}: must be in continuous time; quell samples it"
        )
    if own is True or not math.isclose(own, dt, rel_tol=1e-9):
        raise ValueError(
            f"plant has a sample time of {own!r}: must be in continuous time, or sampled at the "
            f"controller's dt = {dt!r} s"
        )


# ---- Poles of a design in units of its bandwidth, as users give them ----

# Relative difference up to which two complex numbers count as conjugates. Chosen by hand, above the
# rounding of numbers that a file stores with ten digits.
_CONJUGATE = 1e-9


def pole_pattern(name: str, value: Any, count: int) -> NDArray[np.complex128]:
    """Return ``count`` poles in the left half plane, checked, in units of a bandwidth.

    Parameters
    ----------
    name
        name of the argument, for errors.
    value
        entries that are negative numbers; pairs (real, imaginary), which stand for two conjugate
        poles each; or complex numbers, which come with their conjugates.
    count
        number of poles that the design has.

    Raises
    ------
    ValueError
        for another number of poles, a pole that is not in the left half plane, or a complex number
        without its conjugate.

    Examples
    --------
    >>> pole_pattern("poles", [-1.0, (-0.6, 0.8)], 3).tolist()
    [(-1+0j), (-0.6+0.8j), (-0.6-0.8j)]
    """
    if not checks.is_sequence(value) and not isinstance(value, np.ndarray):
        raise ValueError(f"{name} = {value!r}: must be a list of poles, for example [-1, [-2, 1]]")
    found: list[complex] = []
    for i, entry in enumerate(value):
        where = f"{name}[{i}]"
        if checks.is_sequence(entry) or (isinstance(entry, np.ndarray) and entry.ndim):
            real, imag = checks.vector(where, entry, 2).tolist()
            found += [complex(real, abs(imag)), complex(real, -abs(imag))]
        elif isinstance(entry, complex | np.complexfloating):
            found.append(complex(entry))
        else:
            found.append(complex(checks.finite(where, entry)))
    poles = np.array(found, dtype=np.complex128)
    if poles.size != count:
        raise ValueError(
            f"{name} = {value!r}: has {poles.size} poles, must have {count}; a pair [real, "
            "imaginary] counts as two"
        )
    if not np.all(np.isfinite(poles)) or not np.all(poles.real < 0.0):
        raise ValueError(f"{name} = {value!r}: the real part of each pole must be below zero")
    upper, lower = (np.sort_complex(poles[sign * poles.imag > 0.0]) for sign in (1.0, -1.0))
    conjugate = np.sort_complex(np.conj(lower))
    if upper.size != lower.size or not np.allclose(upper, conjugate, rtol=_CONJUGATE, atol=0.0):
        raise ValueError(
            f"{name} = {value!r}: complex poles must come in conjugate pairs; [real, imaginary] "
            "stands for both"
        )
    return poles


# ---- Sampled systems of one input and one output ----


class System(NamedTuple):
    """A sampled system of one input and one output: ``x⁺ − x = N x + B u``, ``y = C x + D u``."""

    N: Matrix
    B: Vector
    C: Vector
    D: float

    @classmethod
    def balanced(cls, N: Matrix, B: Vector, C: Vector, D: float) -> System:
        """Return the system with states scaled to similar size by powers of two, which is exact."""
        from scipy.linalg import matrix_balance

        if N.shape[0] == 0:
            return cls(N, B, C, D)
        scaled, (scale, _) = matrix_balance(N, permute=False, separate=True)
        return cls(scaled, B / scale, C * scale, D)

    @property
    def largest_pole(self) -> float:
        """Largest size of all poles in the z-plane; 0 without states."""
        poles = 1.0 + np.linalg.eigvals(System.balanced(*self).N)
        return float(np.max(np.abs(poles), initial=0.0))

    def then(self, following: System) -> System:
        """Return this system followed by another one: its output is the input of ``following``."""
        n, m = self.N.shape[0], following.N.shape[0]
        N = np.block([[self.N, np.zeros((n, m))], [np.outer(following.B, self.C), following.N]])
        B = np.concatenate([self.B, following.B * self.D])
        return System(N, B, np.append(following.D * self.C, following.C), following.D * self.D)


class MatrixSystem(NamedTuple):
    """A sampled system of m inputs and p outputs: ``x⁺ − x = N x + B u``, ``y = C x + D u``."""

    N: Matrix  # A − I (n, n)
    B: Matrix  # (n, m)
    C: Matrix  # (p, n)
    D: Matrix  # (p, m)

    def entry(self, output: int, input: int) -> System:  # noqa: A002
        """Return the system from one input to one output."""
        return System(self.N, self.B[:, input], self.C[output], float(self.D[output, input]))


# ---- Exact sampling of linear models ----

Stack = NDArray[np.float64]  # matrices (models, …, …)


def zero_order_hold(A: Matrix, inputs: Sequence[Matrix], dt: float) -> tuple[Matrix, list[Matrix]]:
    """Sample ``x' = A x + Σ B_i u_i`` exactly, with every ``u_i`` held over a sample of ``dt`` [s].

    Return Φ (n, n) and the list of Γ_i (n, m_i). One matrix exponential gives all (Van Loan, *IEEE
    Trans. Automatic Control* 23, 1978)::

        exp([[A, B], [0, 0]] dt) = [[Φ, Γ], [0, I]]

    A (…, n, n) and B_i (…, n, m_i) may be stacks of models; each is sampled as if it were alone.
    """
    n = A.shape[-1]
    edges = list(accumulate((B.shape[-1] for B in inputs), initial=n))
    parts = [slice(*edge) for edge in pairwise(edges)]
    block = np.zeros((*A.shape[:-2], edges[-1], edges[-1]))
    block[..., :n, :n] = A
    for part, B in zip(parts, inputs, strict=True):
        block[..., :n, part] = B
    sampled = _exponential(block * dt)
    return sampled[..., :n, :n].copy(), [sampled[..., :n, part].copy() for part in parts]


def _exponential(block: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return exp of a matrix, or of each of a stack."""
    from scipy.linalg import expm

    if block.ndim == 2:
        return _kept_exponential(block.shape[0], block.tobytes())
    with one_blas_thread():
        found: NDArray[np.float64] = expm(block)
    return found


@lru_cache(maxsize=64)
def _kept_exponential(size: int, block: bytes) -> Matrix:
    """Return exp of a matrix; kept, because a plant is sampled again for each of its runs."""
    found = _exponential(np.frombuffer(block).reshape(1, size, size))[0]
    found.flags.writeable = False
    return found


def gramian(A: Matrix, Q: Matrix, dt: float) -> Matrix:
    """Return ``∫ exp(A s) Q exp(Aᵀ s) ds`` over a sample, in the unit of Q times s (Van Loan 1978).

    ::

        exp([[−A, Q], [0, Aᵀ]] dt) = [[·, G], [0, Φᵀ]],      ∫ = Φ G

    Q (n, n) is symmetric. For white noise of density Q on x' the result is the covariance added in
    a sample. With Aᵀ for A it is the weight of x(0) in the cost ``∫ xᵀ Q x dt`` of a sample.
    """
    n = A.shape[0]
    block = np.block([[-A, Q], [np.zeros((n, n)), A.T]]) * dt
    sampled = _exponential(block)
    found: Matrix = sampled[n:, n:].T @ sampled[:n, n:]
    return 0.5 * (found + found.T)


# ---- Norms of sampled systems ----

# Share of the sum at which the bound on the rest is small enough; chosen by hand.
_SMALL = 1e-6
# Columns that are kept, and rows that are multiplied at a time: some MB. Chosen by hand.
_COLUMNS, _ROWS = 4096, 256
# A stable loop that needs more samples than 2 to this power is too slow for its sample time: with
# 1 kHz 4.7 h. Chosen by hand.
_MOST_DOUBLINGS = 24
# Growth that no stable system reaches in balanced coordinates. Chosen by hand.
_DIVERGED = 1e30


def peak_gain(system: System) -> float:
    """Return the peak-to-peak gain of a stable system, or a little more, by a share of 1e-6.

    Raises ``ValueError`` if the impulse response does not decay within 2²⁴ samples.
    """
    N, B, C, D = System.balanced(*system)  # N is A^m − I for the growing m
    columns, rows = B[:, None], C[None, :]
    identity = np.eye(N.shape[0])
    for _ in range(_MOST_DOUBLINGS + 1):
        contraction = float(np.max(np.sum(np.abs(N + identity), axis=1), initial=0.0))
        if contraction > _DIVERGED:
            break
        if contraction < 1.0:
            parts = range(0, rows.shape[0], _ROWS)
            total = float(sum(np.sum(np.abs(rows[i : i + _ROWS] @ columns)) for i in parts))
            # The maximum norm of vectors X, the sum norm of rows R, and the norm of M they induce.
            sizes = float(np.sum(np.abs(rows)) * np.sum(np.max(np.abs(columns), axis=0)))
            rest = contraction / (1.0 - contraction) * sizes
            if rest <= _SMALL * total:
                return abs(D) + total + rest
        if columns.shape[1] < _COLUMNS:
            columns = np.hstack([columns, columns + N @ columns])
        else:
            rows = np.vstack([rows, rows + rows @ N])
        N = 2.0 * N + N @ N
    raise ValueError(
        f"the impulse response does not decay within {2**_MOST_DOUBLINGS} samples: the largest "
        f"pole is at |z| = {system.largest_pole:.9g}; take a longer sample time if it is below 1"
    )


def h2_squared(system: System) -> float:
    """Return the sum of the squared impulse response of a stable system.

    By doubling, ``X ← X + M X Mᵀ``, ``M ← M²`` (Smith 1968): only positive terms are added, so
    nothing cancels; after k rounds 2ᵏ samples are summed.
    """
    system = System.balanced(*system)
    M, X = system.N + np.eye(system.N.shape[0]), np.outer(system.B, system.B)
    for _ in range(64):  # 2⁶⁴ samples: no stable loop in double precision is slower
        more = M @ X @ M.T
        X = X + more
        if np.max(np.abs(more)) <= 1e-16 * np.max(np.abs(X)):  # below the unit roundoff
            break
        M = M @ M
    return float(system.C @ X @ system.C) + system.D**2
