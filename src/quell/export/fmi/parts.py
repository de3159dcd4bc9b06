"""The parts of an FMU: controller and plant in C, variables, bandwidths that can be changed.

Bandwidths as parameters that can be changed while an FMU runs: closed forms for C.

*omega_c*: ``k_i = w_i omega_c^(m−i+1)`` with the binomial coefficients, or those of a pattern of
poles, as w (``controllers/law.py``), and the factor ``exp(−omega_c dt)`` of the offset after a
bumpless transfer. A guard takes the m gains for poles at ``ω_g = k_1^(1/m)``, and has the parameter
``respond = 1 − exp(−ω_g dt)`` (``guard/guard.py``).

*omega_o*: Ackermann's formula (``observers/design.py``) with N equal poles ``1 − ω``,
``ω = 1 − exp(−omega_o dt)``, is a polynomial, because its last factor does not depend on ω::

    L = (Φ − I + ω I)^N v = Σ_k C(N, k) ω^k (Φ − I)^(N−k) v,        v = O⁻¹ e_N

A bandwidth is offered only where its closed form gives all that it changes in the parameters, which
is checked; elsewhere it is fixed: omega_o with a learner, whose lag depends on it, with other poles
and in forms that are not linear; omega_c with a nonlinear law, or a guard with a certified bound.

The parts of a model: a controller and a plant in C, and their variables.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell.controllers.adrc import ADRC
from quell.controllers.law import law_gains
from quell.controllers.prefilters import Prefiltered
from quell.export.c_files import CSource
from quell.export.controller_source import at_path, limits_path, parameters_of
from quell.guard.kernels import GuardDesign
from quell.learners import NoLearner
from quell.observers.eso import ESO
from quell.observers.forms import EsoModel
from quell.types import Matrix, Vector

# ---- Bandwidths as parameters that can be changed while an FMU runs ----

# Relative error of the closed form of L where a bandwidth is still offered: it is 1e-11 at most for
# the observers of the tests, and an observer to which the form does not apply is far off.
_LARGEST_ERROR = 1e-9
_OTHER = 1.25  # times omega_c: another value, for which the closed form is checked


class Bandwidths(NamedTuple):
    """Data that C needs for the bandwidths of an ADRC; None for a bandwidth that is fixed."""

    path: str  # of the parameters of the ADRC within those of the controller, with a dot, or empty
    dt: float
    omega_c: float
    weights: Vector | None  # w (m,)
    guard: int | None  # m of its ω_g
    omega_o: float
    coefficients: Matrix | None  # of ω^k in L (N, N + 1)


def bandwidths(controller: Any) -> Bandwidths | None:
    """Return the bandwidths of a controller; None if it is no ADRC."""
    path = ""
    while isinstance(controller, Prefiltered):
        path, controller = f"{path}controller.", controller.controller
    if type(controller) is not ADRC:
        return None
    observer, guard = controller.observer, _guard_order(controller)
    return Bandwidths(
        path,
        observer.dt,
        controller.omega_c,
        _weights(controller, guard),
        guard,
        observer.omega_o,
        None if _learns(controller) else gain_coefficients(observer),
    )


def _learns(controller: ADRC) -> bool:
    return not isinstance(controller.learner, NoLearner)


def _guard_order(controller: ADRC) -> int | None:
    has_guard = isinstance(controller.parameters.guard, GuardDesign)
    return controller.observer.degree if has_guard else None


def _weights(controller: ADRC, guard: int | None) -> Vector | None:
    """Return the gains for omega_c = 1, if the closed forms give all that omega_c changes."""
    observer, dt = controller.observer, controller.dt
    weights = law_gains(observer.degree, 1.0, controller.law_poles)
    weights *= 0.5 if controller.half_gain else 1.0
    for omega_c in (controller.omega_c, _OTHER * controller.omega_c):
        gains = weights * omega_c ** (observer.degree - np.arange(observer.degree))
        closed = controller.parameters._replace(
            law=np.append(gains, np.zeros(observer.order - observer.degree)),
            fade=math.exp(-omega_c * dt),
        )
        if guard is not None:
            omega = float(gains[0]) ** (1.0 / guard)
            respond = -math.expm1(-omega * dt)
            closed = closed._replace(guard=closed.guard._replace(respond=respond))
        design = controller._design(observer, omega_c)
        if not all(_equal(*pair) for pair in zip(_leaves(design), _leaves(closed), strict=True)):
            return None
    return weights


def gain_coefficients(observer: ESO) -> Matrix | None:
    """Return the coefficients of ω^k in L (N, N + 1), if all poles are equal; else None."""
    model, n = observer.model, observer.plant.a.size
    if type(model) is not EsoModel or not observer.has_one_pole:
        return None
    size, m = observer.estimates, observer.disturbance_order
    # In the coordinates x_i dt^(i−1) and f^(j) dt^(q+j) of the design all entries are O(1).
    scale = observer.dt ** np.append(np.arange(n), observer.plant.f_degree + np.arange(m))
    difference = model.transition * scale[:, None] / scale[None, :] - np.eye(size)
    rows = np.empty((size, size))
    rows[0] = difference[0]
    rows[0, 0] += 1.0
    for i in range(1, size):
        rows[i] = rows[i - 1] @ difference
    vector = np.linalg.solve(rows, np.eye(size)[-1])
    columns = []
    for k in range(size, -1, -1):
        columns.append(math.comb(size, k) * vector / scale)
        vector = difference @ vector
    coefficients = np.array(columns[::-1]).T
    omega = -math.expm1(-observer.omega_o * observer.dt)
    gain = coefficients @ omega ** np.arange(size + 1)
    return coefficients if np.allclose(gain, model.gain, rtol=_LARGEST_ERROR, atol=0.0) else None


def _leaves(value: Any) -> Iterator[Any]:
    """Return an iterator over the numbers and arrays in nested NamedTuples."""
    if isinstance(value, tuple):
        for part in value:
            yield from _leaves(part)
    else:
        yield value


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, float | np.ndarray):
        return np.shape(one) == np.shape(other) and np.allclose(
            one, other, rtol=_LARGEST_ERROR, atol=0.0, equal_nan=True
        )
    return bool(one == other)


# ---- The variables of an exported FMU, with their value references ----

INPUT, OUTPUT, LOCAL, FIXED, TUNABLE = "input", "output", "local", "fixed", "tunable"


def constant_of(name: str) -> str:
    """Return the C constant for the place of a variable: ``AT_X_HAT_1`` for ``x_hat[1]``."""
    return "AT_" + re.sub(r"\W+", "_", name).strip("_").upper()


class Variable(NamedTuple):
    """A variable; its value reference is its place in the list of all."""

    name: str
    role: str
    description: str
    start: float = 0.0  # of inputs and parameters
    unit: str = ""
    held: bool = False  # whether it is constant between samples
    whole: bool = False  # whether it is an integer
    flag: bool = False  # whether it is true or false

    @property
    def constant(self) -> str:
        """Name of the C constant for its place."""
        return constant_of(self.name)


TIME = Variable("time", "independent", "time", unit="s")


def ordered(variables: Iterable[Variable]) -> tuple[Variable, ...]:
    """Return the time and the variables: numbers, integers, and those that are true or false."""
    given = (TIME, *variables)
    return tuple(sorted(given, key=lambda variable: (variable.flag, variable.whole)))


def several(
    name: str,
    count: int,
    role: str,
    description: str,
    starts: Sequence[float] = (),
    held: bool = False,
) -> list[Variable]:
    """Return ``count`` variables ``name[1]``, ``name[2]`` …; "{i}" in the description counts."""
    return [
        Variable(
            f"{name}[{i + 1}]",
            role,
            description.format(i=i + 1),
            starts[i] if starts else 0.0,
            held=held,
        )
        for i in range(count)
    ]


def number(value: float) -> str:
    """Return a number for XML: INF and NaN are those of XML Schema."""
    if math.isfinite(value):
        return repr(float(value))
    return "NaN" if math.isnan(value) else "INF" if value > 0 else "-INF"


# ---- The parts of a model ----

_DESCRIPTIONS = {
    "v": "input of an axis, B0 u as it was applied",
    "d_hat": "estimate of a disturbance, or of its derivatives",
    "x_hat": "estimate of y and its derivatives",
    "f_hat": "estimate of the total disturbance: f_residual + f_learned",
    "f_residual": "the observer's share of it",
    "f_learned": "the learner's share of it",
    "f_derivatives": "derivative of the observer's share of it",
    "u_feedforward": "feedforward of the model, a part of u",
    "status": "flags of the last sample, see the enumeration in the header of the controller",
    "authority": "share of its output that the guard allows the learner",
    "error_plain": "RMS error in f of an observer without learner",
    "error_learned": "the same for the learner with full authority",
    "reason": "reason for the authority, see the enumeration in the header of the controller",
    "theta": "coefficient of the learner",
    "r_shaped": "reference behind the prefilter",
    "u_unlimited": "control signal before limits",
}
WHOLE = ("status", "reason")


@dataclass(frozen=True)
class ControllerPart:
    """A controller in C."""

    source: CSource
    limits: tuple[Any, Any]  # of u, or of each u
    limits_path: str  # of ``Limits`` in its parameters
    bandwidths: Bandwidths | None
    features: tuple[str, ...]
    derivatives: tuple[int, ...]  # of each reference, that are fed forward

    @classmethod
    def of(cls, controller: Any, source: CSource) -> ControllerPart:
        """Return the part for a controller and its C source."""
        parameters, path = parameters_of(controller), limits_path(controller)
        if not path:
            kind = type(parameters).__name__
            raise ValueError(f"controller has {kind}: it has no limits of u")
        limits = at_path(parameters, path)
        return cls(
            source,
            (limits.low, limits.high),
            path,
            bandwidths(controller),
            tuple(controller.features),
            controller.derivatives if source.sizes else (source.derivatives,),
        )

    @property
    def channels(self) -> tuple[tuple[str, int], ...]:
        """Name and width of what its estimate has."""
        found: list[tuple[str, int]] = []
        known = dict(self.source.channels)
        for prefix in ("", *(f"{member}." for member in self.source.axes)):
            own = [each for each in known if each.rpartition(".")[0] == prefix[:-1]]
            if {f"{prefix}f_residual", f"{prefix}f_learned"} <= known.keys():
                found.append((f"{prefix}f_hat", 1))
            found += [(each, known[each]) for each in own]
        return (*found, *(() if "status" in known else (("status", 1),)))

    def _names(self, signal: str, place: int) -> list[str]:
        """Return the names of signals: of each axis, or counted."""
        if self.source.sizes is None:
            return [signal]
        if self.source.axes and signal not in ("u", "u_0"):
            return [f"{signal}.{member}" for member in self.source.axes]
        return [f"{signal}[{i + 1}]" for i in range(self.source.sizes[place])]

    @property
    def references(self) -> list[str]:
        """Names of the references; of several compensators alone those of u_0."""
        return self._names("r" if self.source.sizes is None else self.source.given, 0)

    @property
    def measurements(self) -> list[str]:
        """Names of the measurements."""
        return self._names("y", 1)

    @property
    def controls(self) -> list[str]:
        """Names of the control signals."""
        return self._names("u", 2)

    @property
    def held(self) -> list[str]:
        """Names of the inputs that say whether the plant, or an axis, is held."""
        return self._names("held", 1) if self.can_be_held else []

    def derivatives_of(self, place: int) -> list[str]:
        """Return the names of the derivatives of a reference; u_0 has none."""
        if self.derivatives[place] == 0:
            return []
        member = f".{self.source.axes[place]}" if self.source.axes else ""
        return [f"r_derivative{member}[{i + 1}]" for i in range(self.derivatives[place])]

    @property
    def inputs(self) -> list[Variable]:
        """Reference or u_0, derivatives, signals of the schedule, whether the plant is held."""
        is_u_0 = self.source.given == "u_0"
        given = "control signal of another controller" if is_u_0 else "reference"
        held = "whether the plant is held, by a brake for instance: u does not act until it is not"
        return [
            *(Variable(name, INPUT, given) for name in self.references),
            *(
                Variable(name, INPUT, f"derivative {i + 1} of the reference")
                for place in range(len(self.derivatives))
                for i, name in enumerate(self.derivatives_of(place))
            ),
            *several("signal", self.source.signals, INPUT, "signal {i} that the gains follow"),
            *(Variable(name, INPUT, held, flag=True) for name in self.held),
        ]

    @property
    def can_be_held(self) -> bool:
        """Whether the controller can be told that the plant is held."""
        return "set_held" in self.source.operations

    @property
    def outputs(self) -> list[Variable]:
        """Results of the controller after a sample, without u."""
        found = []
        for name, width in self.channels:
            own = name.rpartition(".")[2]
            text = _DESCRIPTIONS.get(own, own)
            if name == "v[0]":
                found += several("v", 1, OUTPUT, _DESCRIPTIONS["v"], held=True)
            elif name == "theta":
                found += [
                    Variable(f"theta[{i + 1}]", OUTPUT, f"{text} for {feature}", held=True)
                    for i, feature in enumerate(self.features)
                ]
            elif width == 1 and own not in ("x_hat", "f_derivatives", "d_hat", "theta"):
                found.append(Variable(name, OUTPUT, text, held=True, whole=own in WHOLE))
            else:
                found += several(name, width, OUTPUT, f"{text}, {{i}}", held=True)
        return found

    @property
    def tunables(self) -> list[Variable]:
        """The parameters that can be changed while the FMU runs."""
        found = []
        for signal, which, starts in zip(
            ("u_min", "u_max"), ("lower", "upper"), self.limits, strict=True
        ):
            text = f"{which} limit of u"
            if self.source.sizes is None:
                found.append(Variable(signal, TUNABLE, text, starts))
            else:
                found += several(signal, len(starts), TUNABLE, text, starts.tolist())
        known = self.bandwidths
        if known is not None and known.weights is not None:
            text = "bandwidth of the controller"
            found.append(Variable("omega_c", TUNABLE, text, known.omega_c, "rad/s"))
        if known is not None and known.coefficients is not None:
            text = "bandwidth of the observer"
            found.append(Variable("omega_o", TUNABLE, text, known.omega_o, "rad/s"))
        return found

    @property
    def fixed(self) -> str:
        """Which bandwidths are no parameters, as the end of a sentence; empty if all are."""
        known = self.bandwidths
        if known is None:
            return ""
        names = {
            "omega_c": (known.omega_c, known.weights),
            "omega_o": (known.omega_o, known.coefficients),
        }
        fixed = [
            f"{name} = {value:g} rad/s" for name, (value, found) in names.items() if found is None
        ]
        if not fixed:
            return ""
        return f"; {' and '.join(fixed)}, fixed: without a closed form for another; export again"


@dataclass(frozen=True)
class PlantPart:
    """A plant in C, with the functions ``measure`` and ``advance``."""

    source: CSource
    order: int
    disturbances: int
    x0: Sequence[float]


# ---- C code that lets limits and bandwidths act which were set while an FMU runs ----


def tuning_lines(controller: ControllerPart) -> list[str]:
    """Return the body of ``model_tune``.

    Other parameters are those of the export with what was changed; the controller goes over to them
    without a jump of u.
    """
    source, path = controller.source, controller.limits_path
    name, real = source.name, source.real
    cast = "" if real == "double" else f"({real})"
    lines, limits = [], []
    places = [""] if source.sizes is None else [f"_{k + 1}" for k in range(source.sizes[2])]
    for k, place in enumerate(places):
        lines += [
            f"if (!(m->real[AT_U_MIN{place}] < m->real[AT_U_MAX{place}])) {{",
            '    return "u_min must be less than u_max";',
            "}",
        ]
        at = f"[{k}]" if place else ""
        limits += [
            f"next->{path}.low{at} = {cast}m->real[AT_U_MIN{place}];",
            f"next->{path}.high{at} = {cast}m->real[AT_U_MAX{place}];",
        ]
    known = controller.bandwidths
    offered = [variable for variable in controller.tunables if variable.unit == "rad/s"]
    for variable in offered:
        at = f"m->real[{variable.constant}]"
        lines += [
            f"if (!({at} > 0.0 && isfinite({at}))) {{",
            f'    return "{variable.name} must be finite and greater than zero";',
            "}",
        ]
    lines += [
        f"{name}_parameters *next = &m->parameters[1 - m->acting];",
        f"*next = {name}_default_parameters;",
        *limits,
    ]
    if known is not None:
        if known.weights is not None:
            lines += _omega_c_lines(known, known.weights, cast)
        if known.coefficients is not None:
            lines += _omega_o_lines(known, known.coefficients, cast)
    return [
        *lines,
        f"{name}_retune(&m->controller, next);",
        "m->acting = 1 - m->acting;",
        "return NULL;",
    ]


def _omega_c_lines(known: Bandwidths, weights: Vector, cast: str) -> list[str]:
    """Return the lines for ``k_i = w_i omega_c^(m−i+1)`` (controllers/law.py)."""
    count, dt = weights.size, known.dt
    guard = []
    if known.guard is not None:
        power = repr(1.0 / known.guard)
        guard = [
            f"    const double omega_g = pow(weights[0] * pow(omega_c, {count}), {power});",
            f"    next->{known.path}guard.respond = {cast}-expm1(-omega_g * {dt!r});",
        ]
    return [
        f"if (m->real[AT_OMEGA_C] != {known.omega_c!r}) {{ /* else the numbers of the export */",
        f"    static const double weights[{count}] = {_braced(weights.tolist())};",
        "    const double omega_c = m->real[AT_OMEGA_C];",
        f"    for (int i = 0; i < {count}; i++) {{",
        f"        next->{known.path}law[i] = {cast}(weights[i] * pow(omega_c, {count} - i));",
        "    }",
        f"    next->{known.path}fade = {cast}exp(-omega_c * {dt!r});",
        *guard,
        "}",
    ]


def _omega_o_lines(known: Bandwidths, coefficients: Matrix, cast: str) -> list[str]:
    """Return the lines for L as a polynomial in ``ω = 1 − exp(−omega_o dt)``."""
    rows, columns = coefficients.shape
    return [
        f"if (m->real[AT_OMEGA_O] != {known.omega_o!r}) {{ /* else the numbers of the export */",
        f"    static const double coefficients[{rows}][{columns}] = {{",
        *(f"        {_braced(row)}," for row in coefficients.tolist()),
        "    };",
        f"    const double omega = -expm1(-m->real[AT_OMEGA_O] * {known.dt!r});",
        f"    for (int i = 0; i < {rows}; i++) {{",
        "        double gain = 0.0;",
        f"        for (int k = {columns - 1}; k >= 0; k--) {{",
        "            gain = gain * omega + coefficients[i][k];",
        "        }",
        f"        next->{known.path}eso.gain[i] = {cast}gain;",
        "    }",
        "}",
    ]


def _braced(numbers: Sequence[float]) -> str:
    return "{" + ", ".join(map(repr, numbers)) + "}"
