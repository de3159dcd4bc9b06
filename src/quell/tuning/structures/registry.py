"""The names of the structures."""

from __future__ import annotations

from quell import checks
from quell.lti.canonical import design_models
from quell.tuning.structures import baselines
from quell.tuning.structures.adrc import AdrcStructure, Form
from quell.tuning.structures.base import Model, Structure

_PID = {"pi": (False, True), "pi-unfiltered": (False, False), "pid": (True, True)}
_ADRC = {
    "bandwidths": Form(),
    "poles": Form(free_poles=True),
    "half-gain": Form(half_observer=True),
    "half-gain-law": Form(half_law=True),
    "reduced": Form(reduced=True),
    "model-based": Form(based=True),
    "model-based-poles": Form(based=True, free_poles=True),
    "delay": Form(knows_delay=True),
    "delay-poles": Form(knows_delay=True, free_poles=True),
    "bandwidths-2": Form(extended=2),
    "bandwidths-3": Form(extended=3),
    "poles-2": Form(free_poles=True, extended=2),
    "poles-3": Form(free_poles=True, extended=3),
    "model-based-2": Form(based=True, extended=2),
    "resonator": Form(free_poles=True, extended=3, resonators=1),
    "resonator-2": Form(free_poles=True, extended=5, resonators=2),
    "resonator-3": Form(free_poles=True, extended=7, resonators=3),
}
LQG, CASCADE, NOTCH = "lqg", "p-pi-notch", "adaptive-notch"
STRUCTURES = (*_ADRC, *_PID, LQG, CASCADE, NOTCH)
"""Names of the structures: forms of ADRC, PI and PID, LQG, the cascade of servo drives, a notch."""
WITH_ONE_INTEGRATOR = {
    "bandwidths-2": "bandwidths",
    "bandwidths-3": "bandwidths",
    "poles-2": "poles",
    "poles-3": "poles",
    "model-based-2": "model-based",
}
"""The same with one integrator for each structure with several, whose k_i is infinite."""
SEVERAL_INTEGRATORS = tuple(WITH_ONE_INTEGRATOR)
"""Names of those with more than one integrator."""
AT_FREQUENCIES = ("resonator", "resonator-2", "resonator-3", NOTCH)
"""Names of those with models of sinusoids."""
FEEDING_FORWARD = (*_ADRC, CASCADE)
"""Names of those with the feedforward of a model."""


def orders_of(name: str, model: Model, order: int | None) -> tuple[int, ...]:
    """Return the orders to search: of a free ADRC 1 and 2, unless the plant or user says one.

    With a model they are the numbers of the models for a design, the plant itself first.
    """
    if name in _PID or name in (LQG, CASCADE, NOTCH):
        return (0,)
    if _ADRC[name].based:
        return tuple(range(len(design_models(model.plant))))
    if order is not None:
        return (checks.whole("order", order, 1, 8),)
    return (1,) if model.degree == 1 and model.delay == 0.0 else (1, 2)


def make_structure(name: str, model: Model, order: int = 0) -> Structure:
    """Return a structure for a loop; ``order`` is one of ``orders_of``.

    Raises
    ------
    ValueError
        for an unknown name, or a structure that the plant does not allow.
    """
    checks.one_of("structure", name, STRUCTURES)
    if name in _PID:
        derivative, filtered = _PID[name]
        return baselines.FilteredPID(model, derivative=derivative, filtered=filtered)
    if name == LQG:
        return baselines.LqgStructure(model)
    if name == CASCADE:
        return baselines.CascadeStructure(model)
    if name == NOTCH:
        return baselines.NotchStructure(model)
    form = _ADRC[name]
    if not form.based:
        return AdrcStructure(model, f"{name} of order {order}", order, form)
    chosen = design_models(model.plant)[order]
    label = f"{name} of order {chosen.order}" if str(chosen) else name
    return AdrcStructure(model, label, 0, form, chosen)
