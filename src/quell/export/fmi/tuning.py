"""C code that lets limits and bandwidths act which were set while an FMU runs."""

from __future__ import annotations

from collections.abc import Sequence

from quell.export.fmi.bandwidths import Bandwidths
from quell.export.fmi.parts import ControllerPart
from quell.types import Matrix, Vector


def tuning_lines(controller: ControllerPart) -> list[str]:
    """Return the body of ``model_tune``.

    Other parameters are those of the export with what was changed; the controller goes over to them
    without a jump of u.
    """
    source, path = controller.source, controller.limits_path
    name, real = source.name, source.real
    cast = "" if real == "double" else f"({real})"
    lines = [
        "if (!(m->real[AT_U_MIN] < m->real[AT_U_MAX])) {",
        '    return "u_min must be less than u_max";',
        "}",
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
        f"next->{path}.low = {cast}m->real[AT_U_MIN];",
        f"next->{path}.high = {cast}m->real[AT_U_MAX];",
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
    """Return the lines for ``k_i = w_i omega_c^(m−i+1)`` (controllers/adrc/law.py)."""
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
    """Return the lines for L as a polynomial in ``ω = 1 − exp(−omega_o dt)`` (bandwidths.py)."""
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
