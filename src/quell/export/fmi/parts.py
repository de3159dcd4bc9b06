"""The parts of a model: a controller and a plant in C, and their variables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from quell.export.c_files import CSource
from quell.export.fmi.bandwidths import Bandwidths, bandwidths
from quell.export.fmi.variables import INPUT, OUTPUT, TUNABLE, Variable, several
from quell.export.inspection import at_path, limits_path, parameters_of

_DESCRIPTIONS = {
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
    limits: tuple[float, float]  # of u
    limits_path: str  # of ``Limits`` in its parameters
    bandwidths: Bandwidths | None
    features: tuple[str, ...]

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
        )

    @property
    def channels(self) -> tuple[tuple[str, int], ...]:
        """Name and width of what its estimate has."""
        channels = self.source.channels
        if {"f_residual", "f_learned"} <= dict(channels).keys():
            channels = (("f_hat", 1), *channels)
        return channels if "status" in dict(channels) else (*channels, ("status", 1))

    @property
    def inputs(self) -> list[Variable]:
        """Reference and its derivatives."""
        described = "derivative {i} of the reference"
        return [
            Variable("r", INPUT, "reference"),
            *several("r_derivative", self.source.derivatives, INPUT, described),
        ]

    @property
    def outputs(self) -> list[Variable]:
        """Results of the controller after a sample, without u."""
        found = []
        for name, width in self.channels:
            text = _DESCRIPTIONS.get(name, name)
            if name == "theta":
                found += [
                    Variable(f"theta[{i + 1}]", OUTPUT, f"{text} for {feature}", held=True)
                    for i, feature in enumerate(self.features)
                ]
            elif width == 1 and name not in ("x_hat", "f_derivatives"):
                found.append(Variable(name, OUTPUT, text, held=True, whole=name in WHOLE))
            else:
                found += several(name, width, OUTPUT, f"{text}, {{i}}", held=True)
        return found

    @property
    def tunables(self) -> list[Variable]:
        """The parameters that can be changed while the FMU runs."""
        found = [
            Variable(name, TUNABLE, f"{which} limit of u", start)
            for name, which, start in zip(
                ("u_min", "u_max"), ("lower", "upper"), self.limits, strict=True
            )
        ]
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
