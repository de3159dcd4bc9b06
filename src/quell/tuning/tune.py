"""``tune``: the best controller for a plant or a set of plants, of one axis or several."""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from quell import checks
from quell.analysis.loop import LoopAnalysis, analyse_axis
from quell.controllers.feedforward import Feedforward, checked_feedforward
from quell.hints import explained, plain
from quell.lti.canonical import canonical
from quell.parallel import one_blas_thread
from quell.plants.base import signals_of
from quell.plants.linear import LinearPlant
from quell.signals.shapes import Signal, as_signal
from quell.tuning import acceptance
from quell.tuning.axes import tune_together
from quell.tuning.by_simulation import tune_by_simulation
from quell.tuning.constraints import Constraints, LoadSpectrum, given_constraints
from quell.tuning.designs import (
    SIMPLEST,
    Task,
    range_of_u,
    simplest,
    tuned_designs,
    with_noise_bound,
    without_damping,
)
from quell.tuning.optimiser.loops import Inputs, PlantSet, load_step, samples_of
from quell.tuning.optimiser.requirements import OBJECTIVES, OF_SPECTRUM
from quell.tuning.plants import (
    Given,
    as_list,
    beyond_control,
    given_plants,
    model_of,
    plant_set,
    with_known_noise,
)
from quell.tuning.report import Design, relative
from quell.tuning.structures.base import resonances
from quell.tuning.structures.registry import (
    AT_FREQUENCIES,
    CASCADE,
    FEEDING_FORWARD,
    STRUCTURES,
    WITH_ONE_INTEGRATOR,
)
from quell.tuning.tables import (
    Limits,
    Rest,
    checked_rest,
    held_sizes,
    late_plant,
    plant_table,
    rest_of_linear,
    rest_of_plant,
    rest_within,
    scenario_of,
    scenario_tables,
    windows_of,
)
from quell.tuning.tuned import Check, Tuned, Uncertain, checked
from quell.tuning.written import Written
from quell.types import Progress, Vector

COMPARED = ("pi", "pid", "bandwidths", "reduced", "half-gain", "poles", "model-based")
"""The structures that a result is compared with by default; and the cascade at a resonance."""
# A design without prefilter leaves less of the error in the scenario by this factor.
_LESS = 0.95
ONLY_TOGETHER = ("disk", "B0_off", "operating_points")
"""Options of several axes, which one has not."""
TOGETHER = (
    *("constraints", "objective", "check_samples", "seed", "setup", "written", "progress"),
    *ONLY_TOGETHER,
)
"""All options of several axes."""
_OF_PLANT = ("plant", "controller", "limits")
# Names of the limits of a controller.
_LIMITS = ("u_min", "u_max", "rate_limit")


@explained("quell.tune(([1.0], [1.0, 2.0, 1.0]), dt=0.01)")
def tune(
    plant: Any,
    dt: Any = None,
    *,
    controller: Any = None,
    structure: str = SIMPLEST,
    order: int | None = None,
    frequencies: Sequence[float] = (),
    objective: Any = "load-iae",
    constraints: Constraints | None = None,
    compare: Sequence[str] | None = None,
    reference: Any = None,
    duration: float | None = None,
    load: float = 1.0,
    feedforward: bool | Feedforward | None = None,
    delay: Any = 0.0,
    actuator_lag: float = 0.0,
    operating_point: Any = None,
    uncertain: Mapping[str, tuple[float, float]] | None = None,
    b_range: Sequence[float] = (1.0, 1.0),
    quantile: float = 1.0,
    samples: int = 20,
    check_samples: int = 400,
    seed: int = 0,
    setup: Mapping[str, Any] | None = None,
    written: Written | bool = True,
    rest: Any = None,
    scenario: Any = None,
    search: Mapping[str, Any] | None = None,
    in_use: Any = None,
    disk: float | None = None,
    B0_off: float = 0.0,
    operating_points: Sequence[Any] | None = None,
    progress: Progress | None = None,
    **limits: Any,
) -> Tuned:
    """Return the controller with the best objective under constraints, for one axis or several.

    Of one axis it is the best controller of a structure. Of several, ``controller`` says all but
    omega_c and omega_o of each axis, which are chosen; learners are not in the bounds. What is
    bounded, and how these are searched, stands in ``quell.tuning.axes``.

    The loop is linear and sampled exactly; all constraints hold for all plants, at all frequencies
    within 0.1 %. PI, PID and the other structures of ``compare`` are tuned under the same
    constraints. The search is deterministic (``optimiser/search.py``).

    Parameters
    ----------
    plant
        a linear plant of any kind that ``analyse`` accepts; a ``PlantBatch`` or a list of plants,
        of which the first is the nominal one; with ``uncertain``, a function that makes one.
        Of several axes one with an output for each, in continuous time: a ``LinearPlant`` or
        matrices (A, B, C), also behind delays or encoders, which are left out; or a nonlinear one
        with its operating points.
    dt
        sample time [s]; a controller has its own.
    controller
        axes (``quell.Axes``), whose orders, forms of observers, B0 and names are kept. Then
        ``constraints``, ``objective`` (for the load), ``check_samples``, ``seed``, ``setup``,
        ``written``, ``progress`` and those below of several axes have an effect, others are
        refused. Of the constraints m_s, m_t, m_ks [1/s^n], damping, noise_over_pi and omega_o_dt
        count, for each channel; m_ks is by default that of each axis alone.
    structure
        one of ``quell.tuning.STRUCTURES``: ``"poles"`` is an ADRC with poles of its own,
        ``"p-pi-notch"`` the cascade of servo drives with a notch for each resonance. By default,
        ``"simplest"``, the simplest of ``compare`` whose objective is within 5 % of the best.
    order
        order of an ADRC without model; 1 and 2 are tried by default.
    frequencies
        of a load that is known [rad/s], for the structures ``"resonator"``, ``"resonator-2"`` and
        ``"resonator-3"``, which reject one, two or three without error; tuned with the rest by
        default. ``"adaptive-notch"`` starts with them.
    objective
        ``"load-iae"``: least integral of ``|y|`` after a step of the load; ``"load"``: largest
        integral gain, the least integral of y, whose optima may ring, as y of both signs counts
        for nothing; ``"tracking"``: least RMS of ``r − y``; a ``quell.tuning.LoadSpectrum``: least
        RMS of y under a load of which the spectrum, or a band, is known.
    constraints
        the bounds; by default M_s = M_t = 1.6, a damping of 0.4, and one for what noise does to u,
        which follows from the noise of y and the limits of u where they are given
        (``Constraints``); the resolution of a plant's encoder is known.
    compare
        names of other structures; by default ``COMPARED``, and ``"p-pi-notch"`` for a plant with a
        resonance. An empty list for none. A structure with several integrators is always compared
        with the same of one.
    reference
        signal or number, from rest, for ``"tracking"`` and for ``u_max`` and ``rate_max`` of the
        constraints.
    duration
        how long the reference is followed, and u bounded by these [s]; without a reference the
        response to the load. ``"load-iae"`` lasts until y is at rest.
    load
        step of the load at the plant's input [u-unit], for ``"load-iae"``, and for the bounds of u
        where there is no reference.
    feedforward
        whether the controller gets the feedforward of the first plant's model, ``Feedforward.of``
        with its delay and friction, or a ``Feedforward`` of yours. It changes no margin, so only
        ``"tracking"`` has to do with it. The cascade uses inertia and viscous friction; PID and LQG
        controllers have none, so ``"simplest"`` is one of the others. By default an axis, which
        needs no u at rest, has it where limits of u are given, with a profile generator that keeps
        u within them (``reference.py``), unless the objective is ``"tracking"`` or the reference of
        the scenario moves from sample to sample.
    delay, actuator_lag, operating_point
        as for ``analyse``; ``delay`` may have a value for each plant.
    uncertain
        lowest and highest value of the parameters of ``plant``, which is then called with them.
    b_range
        lowest and highest b over that of the plant, around 1.
    quantile
        of the objective over the plants, which is minimised; 1 is the worst case.
    samples, check_samples
        plants of the set, and fresh ones on which the result is checked.
    seed
        of the samples.
    setup
        tables of a setup file that ``Tuned.toml`` completes; made from ``plant`` by default.
    written
        plant and scenario of ``setup`` as objects, in which the controller is judged with all that
        is not linear in the plant; True for those of the tables that are made, False to simulate
        nothing and to add no prefilter.
    rest
        u and y at rest, where the plant works: the scenario of ``Tuned.toml`` begins there. Of a
        nonlinear plant the operating point by default, else zero.
    scenario
        tunes by simulation (extra ``tuning``), for saturation, friction, encoders and criteria of
        your own: a ``Scenario`` that the plants, which need not be linear, run through, or one for
        each. The optimum of the linear parts for the load is the start, and their bounds M_s, M_t
        and M_ks hold. ``objective`` is then the name of a metric, as ``"iae"``, a function of a
        ``Trajectory``, an ``Objective`` with a statistic over the plants, or several by name.
    search
        options of ``quell.tuning.simulated.search``: ``trials``, ``sampler``, ``storage``,
        ``executor``, …; and ``factor``, the width of the ranges around the start.
    in_use
        a controller that the result replaces. Where the bound of noise is a guess, M_ks may be as
        large as with that one: what noise does to u then is known to be borne.
    disk
        of several axes: least disk margin of all inputs, and of all outputs, at once; by default
        what a single loop has with m_s and m_t.
    B0_off
        of several axes: share by which each entry of B0 may be off, 0.2 for 20 %; the result is
        checked with ``check_samples`` drawn errors.
    operating_points
        of several axes, for a nonlinear plant, the nominal one first: states x, for which the u
        that holds them is found, or (x, u). The bounds hold at each of them.
    progress
        called with the structure or axis and the share that is done.
    **limits
        ``u_min``, ``u_max``, ``rate_limit`` of the controllers.

    Returns
    -------
    Tuned
        the controller, its analysis, the references, active constraints, trade-off, figures. Of
        several axes ``met`` says whether all bounds hold; if they can't, a line that begins with
        NOT says what to do.

    Raises
    ------
    ValueError
        for arguments out of range or without effect, plants with different signs of the gain, a
        plant that no controller of the structure stabilises, constraints that contradict each
        other (which, and by how much); for an axis that cannot be tuned alone (it is named), one
        whose law is not linear, axes of compensators, and those with one learner for all.

    Examples
    --------
    >>> import quell as ql
    >>> how = {"structure": "pi-unfiltered", "objective": "load", "compare": ()}
    >>> bounds = ql.tuning.Constraints(m_s=1.4, m_t=None)
    >>> tuned = ql.tune(([1.0], [1.0, 3.0, 3.0, 1.0]), dt=0.02, constraints=bounds, **how)
    >>> round(tuned.design.values["K"], 2), round(tuned.design.values["T_i"], 2)
    (0.63, 1.96)
    >>> import numpy as np
    >>> M = np.array([[1.2, 0.35], [0.35, 0.2]])
    >>> A, B = np.kron(np.eye(2), [[0, 1], [0, 0]]), np.kron(np.linalg.inv(M), [[0], [1]])
    >>> arm = ql.plants.LinearPlant(A, B, np.eye(4)[[0, 2]])
    >>> arm = ql.plants.delayed_inputs(arm, 2e-3, 1e-3)
    >>> joint = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3), omega_c=8.0)
    >>> tuned = ql.tune(arm, controller=ql.Axes([joint, joint], M=M), B0_off=0.1)
    >>> tuned.met, max(axis.measures["M_s"] for axis in tuned.axes) <= 1.602
    (True, True)
    """
    asked = {**locals(), **limits}
    if hasattr(dt, "step"):  # a controller in its place
        asked |= {"dt": None, "controller": dt}
    if asked["controller"] is not None:
        why = "with a controller, whose bandwidths are tuned for the coupled loop; change that"
        _refuse({name: why for name in asked if name not in (*TOGETHER, *_OF_PLANT)}, asked)
        parts = {name: asked[name] for name in TOGETHER}
        return tune_together(tune, plant, asked["controller"], **parts)
    if dt is None:
        raise ValueError(
            "tune: needs dt, too, the sample time [s]; of several axes controller=quell.Axes(…)"
        )
    _refuse(dict.fromkeys(ONLY_TOGETHER, "without controller=, quell.Axes of several axes"), asked)
    u_limits = range_of_u(limits)
    options = {"reference": reference, "duration": duration, "load": load, "quantile": quantile}
    options |= {"samples": samples, "check_samples": check_samples, "seed": seed}
    if uncertain is None:
        constraints = with_known_noise(given_constraints(constraints), as_list(plant)[0], u_limits)
    checks.whole("seed", seed, 0)
    if compare is not None and not checks.is_sequence(compare):
        raise ValueError(
            f"compare = {compare!r}: must be a list of structures, as compare=['pi', 'pid'], or an "
            "empty list for none"
        )
    spectrum = objective if isinstance(objective, LoadSpectrum) else None
    if spectrum is not None and scenario is not None:
        raise ValueError("objective = LoadSpectrum: is about the linear loop; leave scenario out")
    if spectrum is not None:
        objective = OF_SPECTRUM
    elif scenario is not None or not isinstance(objective, str) or objective not in OBJECTIVES:
        how: dict[str, Any] = {"structure": structure, "order": order, "constraints": constraints}
        how |= {"compare": compare, "delay": delay, "actuator_lag": actuator_lag, "setup": setup}
        how |= {"operating_point": operating_point, "uncertain": uncertain, "b_range": b_range}
        how |= {"samples": samples, "check_samples": check_samples, "seed": seed}
        if uncertain is None and operating_point is None:
            late = float(np.ravel(delay)[0]) + actuator_lag
            feedforward = _by_model(feedforward, as_list(plant)[0], late)
        how["feedforward"] = feedforward or False
        how |= {"progress": progress, **limits}
        _refuse(_without_effect_in_simulations(uncertain is not None), options)
        linear = partial(tune, dt=dt, rest=rest, written=False)
        found = tune_by_simulation(linear, plant, scenario, objective, search or {}, how)
        if not isinstance(written, Written) or found.loop is None:
            return found  # what was tuned by simulation was judged in it
        return replace(found, loop=found.loop._replace(written=written))
    if search is not None:
        raise ValueError("search = {...}: is for a tuning by simulation; give a scenario, too")
    dt = checks.positive("dt", dt, "s")
    _check_names(structure, compare)
    for name, value in limits.items():
        if name not in _LIMITS:
            fields = {plain(each): each for each in Constraints.__dataclass_fields__}
            if field := fields.get(plain(name)):
                bound = f"constraints=quell.tuning.Constraints({field}={value!r})"
                raise ValueError(f"{name} = {value!r}: is a bound of the loop; give {bound}")
            known = [*inspect.signature(tune).parameters][:-1] + list(_LIMITS)
            near = difflib.get_close_matches(name, known, n=1)
            hint = f", did you mean {near[0]}?" if near else "; help(quell.tune) has all"
            raise ValueError(f"{name}: tune has no such argument{hint}")
    if not 0.0 < checks.finite("quantile", quantile) <= 1.0:
        raise ValueError(f"quantile = {quantile!r}: must be above 0 and at most 1, the worst case")
    report = progress or (lambda part, share: None)
    how = {"actuator_lag": actuator_lag, "b_range": b_range}
    how |= {"delay": delay, "operating_point": operating_point}
    box = None if uncertain is None else Uncertain(plant, uncertain)
    if box is not None:
        plant = box.plants(box.design_set(checks.whole("samples", samples, 1), seed))
    given = given_plants(plant, dt, **how)
    known_rest = checked_rest(rest)
    if known_rest is None and box is None:
        known_rest = rest_of_plant(as_list(plant)[0], dt, operating_point)
    if setup is None or "scenario" not in setup:
        known_rest = rest_within(LinearPlant.of(given.linear[0]), known_rest, u_limits)
    plants = plant_set(given, dt)
    if reason := beyond_control(plants):
        raise ValueError(reason)
    bounds = given_constraints(constraints)
    lines = tuple(checks.positive_vector("frequencies", frequencies).tolist())
    model = model_of(given, plants, bounds)._replace(load=spectrum, frequencies=lines)
    late = float(np.ravel(delay)[0]) + actuator_lag
    known = as_list(plant)[0] if operating_point is None else given.linear[0]
    forward = _by_model(feedforward, known, late)
    if compare is None:
        compare = (*COMPARED, CASCADE) if resonances(model) else COMPARED
    names = [*compare, structure] if structure != SIMPLEST else [*compare] or ["poles"]
    if lines and not set(names) & set(AT_FREQUENCIES):
        raise ValueError(
            f"frequencies = {list(lines)!r}: has no effect: only {', '.join(AT_FREQUENCIES)} have "
            "them; give one of these structures, or leave frequencies out"
        )
    without = () if lines or spectrum is not None else set(names) & set(AT_FREQUENCIES)
    if without:
        raise ValueError(
            f"structure {', '.join(sorted(without))} has models of sinusoids: give "
            "frequencies, or an objective LoadSpectrum"
        )
    if structure in WITH_ONE_INTEGRATOR:
        names.append(WITH_ONE_INTEGRATOR[structure])
    if forward is not None:
        _check_feedforward(names if structure == SIMPLEST else [structure], feedforward)
    drawn = box is not None or b_range[0] != b_range[1]
    unused = _without_effect(objective, bounds, reference is not None)
    unused |= _without_effect_of_plants(box is not None, drawn, plants, objective)
    _refuse(unused | _without_effect_of_noise(bounds), {**options, **vars(bounds)})
    inputs = _inputs(objective, reference, duration, load, plants, forward)
    _check_u_max(bounds.u_max, inputs, plants)
    by_default = feedforward is None and objective != "tracking" and written is not False
    by_default &= not (isinstance(written, Written) and written.moves)
    by_default &= bool(set(names) & set(FEEDING_FORWARD))
    if by_default and math.isfinite(u_limits[1] - u_limits[0]):
        forward = _of_axis(given, written, bool(resonances(model)))
    task = Task(plants, model, bounds, objective, inputs, quantile, order, limits, forward)
    with one_blas_thread():
        task, noise_bound = with_noise_bound(task, _m_ks_of(in_use, given))
        designs = tuned_designs(list(dict.fromkeys(names)), task, report)
        chosen = _chosen(designs, structure, task)
        tables, loop = _file(given, task, setup, written, known_rest, u_limits, chosen)
        judged, refused = None, ""
        if loop is not None and loop.shaped and any(map(math.isfinite, u_limits)):
            report("limits of u", 1.0)
            chosen, judged, refused = _accepted(chosen, designs, structure, task, given, loop)
        if chosen.undamped:
            task = without_damping(task)
        check = None
        if drawn:
            report("check", 1.0)
            check = _check(box, given, how, task, chosen, (check_samples, seed))
    return Tuned(
        axes=(chosen,),
        designs=designs,
        analysis=_analysis(given, plants, chosen),
        constraints=task.constraints,
        objective=objective,
        task=task,
        check=check,
        setup=tables,
        loop=loop,
        judged_at_limits=judged,
        told=(refused,) if refused else (),
        noise_bound=noise_bound,
        signals=signals_of(as_list(plant)[0]),
    )


def _chosen(designs: Mapping[str, Design], structure: str, task: Task) -> Design:
    """Return the design of the structure, or the simplest one that can do what is asked."""
    if structure == SIMPLEST:
        able = STRUCTURES if task.feedforward is None else FEEDING_FORWARD
        usable = {name: each for name, each in designs.items() if name in able}
        found = simplest(usable, task.objective)
    else:
        found = designs[structure]
    if found.controller is None:
        raise ValueError(f"structure = {structure!r}: {found.reason} ({task.constraints})")
    return found


def _by_model(
    feedforward: bool | Feedforward | None, plant: Any, late: float
) -> Feedforward | None:
    """Return the feedforward of a plant with a delay [s] of u besides its own, if it is wanted."""
    given = checked_feedforward(bool(feedforward) if feedforward is None else feedforward)
    if isinstance(given, Feedforward):
        return given
    if not given:
        return None
    found = Feedforward.of(plant)
    late += found.delay or 0.0
    return replace(found, delay=late) if late > 0.0 else found


def _check_names(structure: str, compare: Sequence[str] | None) -> None:
    checks.one_of("structure", structure, (SIMPLEST, *STRUCTURES))
    for name in compare or ():
        checks.one_of("compare", name, STRUCTURES)


def _check_feedforward(names: Sequence[str], given: bool | Feedforward | None) -> None:
    """Raise an error unless one of the structures has all of the feedforward that is given."""
    if not set(names) & set(FEEDING_FORWARD):
        raise ValueError(
            f"feedforward: {', '.join(names)} has none; give a structure that has, as poles, "
            "model-based or p-pi-notch, or feedforward = false"
        )
    if list(names) == [CASCADE] and isinstance(given, Feedforward):
        used, extra = (1, 2), ("coulomb", "constant", "delay", "derivatives")
        unused = [name for name in extra if getattr(given, name)]
        unused += [
            f"coefficients[{i}]" for i, c in enumerate(given.coefficients) if c and i not in used
        ]
        if unused:
            raise ValueError(
                f"feedforward: {', '.join(unused)} would have no effect: structure = {CASCADE!r} "
                "feeds inertia and viscous friction forward; leave them out, or give poles or "
                "model-based"
            )


def _inputs(
    objective: str,
    reference: Any,
    duration: float | None,
    load: float,
    plants: PlantSet,
    feedforward: Feedforward | None,
) -> Inputs:
    """Return the reference and its feedforward, or without one the step of the load."""
    if objective == "tracking" and reference is None:
        raise ValueError("reference = None: objective = 'tracking' needs a signal to follow")
    last = checks.optional(checks.positive, "duration", duration, "s")
    step = load_step(plants, checks.nonzero("load", load, "or nothing is rejected"), last)
    if reference is None:
        return step
    if not callable(reference):
        reference = as_signal(reference, "reference")
    count = samples_of(plants.dt * step.r.size * step.distance if last is None else last, plants.dt)
    t: Vector = np.arange(count, dtype=np.float64) * plants.dt
    r, none = np.asarray(reference(t), dtype=np.float64), np.zeros(t.size)
    if not np.any(r):
        raise ValueError(
            f"reference = {reference!r}: is 0 for all of the {count * plants.dt:g} s that it is "
            "followed; give one that moves, or a longer duration"
        )
    if feedforward is None:
        return Inputs(r, none, load=load)
    if not isinstance(reference, Signal):
        raise ValueError(
            f"reference = {reference!r}: must be a signal of quell.signals, whose derivatives the "
            "feedforward uses"
        )
    followed, u_ff = feedforward.linear_part(reference, t, plants.dt)
    return Inputs(followed, none, u_ff, load=load)


# ---- Options without effect ----


def _refuse(unused: Mapping[str, str], options: Mapping[str, Any]) -> None:
    """Raise an error for an option that differs from its default and has no effect.

    ``unused`` says why by the option's name, and what to do.
    """
    parameters = {**inspect.signature(tune).parameters, **inspect.signature(Constraints).parameters}
    for name, why in unused.items():
        value, default = options[name], getattr(parameters.get(name), "default", None)
        if value is not default and value != default:
            raise ValueError(f"{name} = {value!r}: has no effect: {why}, or leave it out")


def _without_effect_in_simulations(uncertain: bool) -> dict[str, str]:
    """Return why options have no effect in a tuning by simulation, by name."""
    why = "the scenario says what a tuning by simulation runs through; change that"
    unused = dict.fromkeys(("reference", "duration", "load"), why)
    unused["quantile"] = (
        "in a tuning by simulation the objective has the statistic over the plants; give an "
        "Objective with one"
    )
    if not uncertain:
        unused |= dict.fromkeys(("samples", "check_samples"), _NOTHING_DRAWN.format(""))
    return unused


_NOTHING_DRAWN = "no plant is drawn; give ranges of its parameters, uncertain ([plant.uncertain]){}"


def _without_effect(objective: str, bounds: Constraints, followed: bool) -> dict[str, str]:
    """Return why options of the responses over time have no effect, by name."""
    if objective == "tracking":
        return {"load": "objective = 'tracking' follows the reference; give another objective"}
    unused: dict[str, str] = {}
    if bounds.u_max is None and bounds.rate_max is None:
        how = "give objective = 'tracking', or a bound of u: u_max or rate_max of the constraints"
        unused["reference"] = f"objective = {objective!r} is about the load; {how}"
        unused["duration"] = f"∫|y| and k_i are those until y is at rest; {how}"
    if objective == "load" and (unused or followed):
        unused["load"] = "k_i is the same for all loads; give objective = 'load-iae'"
    if objective == OF_SPECTRUM and (unused or followed):
        unused["load"] = "the spectrum has the size of the load; scale its power"
    return unused


def _without_effect_of_plants(
    uncertain: bool, drawn: bool, plants: PlantSet, objective: str
) -> dict[str, str]:
    """Return why options of the set of plants have no effect, by name."""
    unused: dict[str, str] = {}
    if not drawn:
        why = _NOTHING_DRAWN.format(", or b_range")
        unused |= dict.fromkeys(("check_samples", "seed"), why)
    if not uncertain:
        unused["samples"] = _NOTHING_DRAWN.format("")
    if objective == "load":
        unused["quantile"] = "k_i is the same for all plants; give objective = 'load-iae'"
    elif len(plants.plants) == 1:
        unused["quantile"] = "there is one plant; give several, b_range, or uncertain"
    return unused


def _without_effect_of_noise(bounds: Constraints) -> dict[str, str]:
    """Return why rules of the noise's bound have no effect, by name."""
    given = next((name for name in ("u_std", "m_ks") if getattr(bounds, name) is not None), None)
    unused: dict[str, str] = {}
    if given is not None:
        why = f"{given} bounds what noise does to u; leave that out"
        unused = dict.fromkeys(("noise_share", "noise_over_pi"), why)
    elif bounds.noise:
        unused["noise_over_pi"] = "the noise of y is known; noise_share is its bound"
    else:
        unused["noise_share"] = (
            "the noise of y is not known; give noise_std or resolution, with u_min and u_max"
        )
    if bounds.noise_over_pi is None:  # also says that nothing is guessed
        unused.pop("noise_over_pi", None)
    return unused


# ---- What u must be at rest ----

# Rounding, and the plant's gain at the lowest frequency of the grid in the place of that at zero.
_AT_REST = 1e-3


def _check_u_max(u_max: float | None, inputs: Inputs, plants: PlantSet) -> None:
    """Raise an error for a bound of ``|u|`` below what u must be where the loop is at rest.

    With integral action u is there ``r/P(0) − d``, for any controller. A search would end at loops
    that are too slow to come to rest.
    """
    if u_max is None:
        return
    d, last = float(inputs.d[-1]), inputs.r[inputs.r.size // 2 :]
    if np.ptp(last) > 0.0:  # not at rest at the end
        return
    gain = float(np.min(np.abs(plants.P[:, 0])))
    held = abs(float(last[-1])) / gain if gain > 0.0 else 0.0
    if max(abs(d), held) <= (1.0 + _AT_REST) * u_max:
        return
    what = f"the step load = {d:g}"
    remedy = f"give load, the largest step of it, below {u_max:g}"
    if held > abs(d):
        what = f"the reference, which ends at {last[-1]:g}"
        remedy = f"give a reference that ends below {u_max * gain:.3g}"
    raise ValueError(
        f"constraints.u_max = {u_max:g}: NOT possible for any controller: it bounds |u| in the "
        f"response to {what}, and at rest |u| must be {max(abs(d), held):.4g} there; {remedy}, or "
        "leave this bound out; limits of u are others: u_min, u_max of the controller"
    )


def _analysis(given: Given, plants: PlantSet, design: Design) -> LoopAnalysis:
    assert design.controller is not None
    delay, lag = float(given.delays[0]), given.actuator_lag
    return analyse_axis(given.linear[0], design.controller, delay=delay, actuator_lag=lag)


def _m_ks_of(controller: Any, given: Given) -> float | None:
    """Return M_ks of a controller with the first plant; None without one, or if it is unstable."""
    if controller is None:
        return None
    delay, lag = float(given.delays[0]), given.actuator_lag
    try:
        loop = analyse_axis(given.linear[0], controller, delay=delay, actuator_lag=lag)
    except ValueError:  # it has no linear law
        return None
    return loop.noise_to_control_peak if loop.stable else None


def _check(
    box: Uncertain | None,
    given: Given,
    how: Mapping[str, Any],
    task: Task,
    design: Design,
    draws: tuple[int, int],
) -> Check:
    """Return the check on fresh parameters and gains."""
    count, seed = draws
    checks.whole("check_samples", count, 1)
    low, high = (float(end) for end in how["b_range"])
    factors = low + (high - low) * np.random.default_rng([seed, 2]).random(count)
    if box is None:
        linear = [given.linear[i % len(given.linear)] for i in range(count)]
        fresh = given._replace(
            linear=tuple(linear), delays=np.resize(given.delays, count), factors=np.ones(1)
        )
        values, names = factors[:, None], ["b/b0"]
    else:
        values, names = box.fresh(count, seed), list(box.ranges)
        fresh = given_plants(box.plants(values), task.plants.dt, **{**how, "b_range": (1.0, 1.0)})
    plants = plant_set(fresh, task.plants.dt, factors if low != high else None)
    assert design.solution is not None
    return checked(task.problem(), design.solution, plants, values, names)


def _file(
    given: Given,
    task: Task,
    known: Mapping[str, Any] | None,
    written: Written | bool,
    rest: Rest | None,
    limits: Limits,
    design: Design,
) -> tuple[dict[str, Any], acceptance.Loop | None]:
    """Return the tables of a setup file, ``known`` ones first, and the loop that they describe.

    By default they have the first plant, a step and a load. What is not in ``known`` is added:
    ``[[metrics]]`` have a window for each part of the scenario. The loop is None for tables with a
    scenario whose objects are not in ``written``.
    """
    plants, linear = task.plants, LinearPlant.of(given.linear[0])
    delay, lag, dt = float(given.delays[0]), given.actuator_lag, plants.dt
    tables: dict[str, Any] = {"title": "Tuned controller", "dt": dt} | dict(known or {})
    if linear.disturbances == 0:
        linear = LinearPlant(linear.A, linear.B, linear.C)
    plant: Any = written.plant if isinstance(written, Written) else None
    scenario = written.scenario if isinstance(written, Written) else None
    if plant is None:
        plant = late_plant(linear, lag, delay, dt)
    if "plant" not in tables:
        rest = None if rest is None or not any(rest[:2]) else rest_of_linear(linear, rest)
        tables["plant"], waiting = plant_table(linear, lag, delay, dt)
        if rest is not None:
            rest = rest._replace(x0=(*rest.x0, *[rest.u] * waiting))
    if "scenario" not in tables:
        step = load_step(plants)
        last = float(f"{step.r.size * step.distance * dt:.2g}")
        rest = None if rest is None or not any((*rest[:2], *rest.x0)) else rest
        analysis = _analysis(given, plants, design)
        tau = acceptance.time_constant(analysis, plants)
        axis = acceptance.axis_of(linear, tau, plants)
        needed = 0.0 if axis is None else axis.needs(tau)
        sizes = held_sizes(linear, rest, limits, needed)
        tables |= scenario_tables(last, linear.disturbances, rest, sizes)
    elif "metrics" not in tables:
        tables["metrics"] = windows_of(tables["scenario"])
    if scenario is None and known is not None and "scenario" in known:
        return tables, None
    file = Written(plant, scenario or scenario_of(tables["scenario"]), dt)
    at = 0.0 if rest is None else rest.u
    shaped = task.objective != "tracking" and written is not False and not file.moves
    if shaped and any(map(math.isfinite, limits)):
        parts = [LinearPlant.of(each) for each in given.linear]
        late = [(lag, float(each)) for each in given.delays]
        file = acceptance.with_others(file, parts, late, plants)
    return tables, acceptance.Loop(file, linear, task.model, plants, limits, at, shaped)


def _of_axis(given: Given, written: Written | bool, flexible: bool) -> Feedforward | None:
    """Return the feedforward of an axis, which needs no u at rest; None for another plant.

    Of a plant with zeros it is the rigid part: the series of its inverse would not end. But one
    with a resonance whose zeros swing, too, as a motor with a load behind a spring, has a flat
    output, with which it is exact.
    """
    linear = LinearPlant.of(given.linear[0])
    if np.linalg.matrix_rank(linear.A) == linear.order:
        return None
    plant = written.plant if isinstance(written, Written) else linear
    zeros = canonical(linear).zeros
    rigid = 2 if zeros.size else min(linear.order, 3)
    flexible = flexible and bool(np.all(zeros.imag != 0.0))
    try:
        found = Feedforward.of(
            plant,
            terms=None if flexible else rigid,
            derivatives=4 if flexible else 3,
            flat=flexible,
        )
    except ValueError:
        return None
    late = 0.0 if isinstance(written, Written) else float(given.delays[0]) + given.actuator_lag
    late += found.delay or 0.0
    return replace(found, delay=late) if late > 0.0 else found


def _accepted(
    first: Design,
    designs: Mapping[str, Design],
    structure: str,
    task: Task,
    given: Given,
    loop: acceptance.Loop,
) -> tuple[Design, acceptance.Judged, str]:
    """Return the design that is accepted at the limits of u, with what it does, and what is not.

    Of a structure that is named it is the only one. A process whose step overshoots at the limits
    of u is slowed by its prefilter. So one that needs none takes its place where it leaves less of
    the error in the scenario, the step and all loads together.
    """
    able = STRUCTURES if task.feedforward is None else FEEDING_FORWARD
    others = [
        each
        for name, each in designs.items()
        if name in able and each is not first and each.controller is not None
        if each.undamped <= first.undamped
        if relative(first, each, task.objective) <= acceptance.WORSE
    ]
    others.sort(key=lambda each: -relative(each, first, task.objective))

    def judged(design: Design) -> acceptance.Judged:
        return acceptance.judge(loop, _controller(design), _analysis(given, task.plants, design))

    others = others if structure == SIMPLEST else []
    found, its, refused = acceptance.accepted(first, others, judged, first.name)
    if its.prefilter is None:
        return found, its, refused
    slowed = least = loop.written.error(its.controller)
    best = found
    for each in others:
        analysis = _analysis(given, task.plants, each)
        if each is best or not acceptance.quick_without(loop, _controller(each), analysis):
            continue
        other, left = judged(each), loop.written.error(_controller(each))
        if not other.failures and left < _LESS * least:
            best, its, least = each, other, left
    if best is not found:
        refused = (
            f"{found.name} is left out: at the limits of u its step needs a prefilter, with which "
            f"∫|r − y| in the scenario is {slowed:.3g}; {best.name} needs none and has {least:.3g}"
        )
    return best, its, refused


def _controller(design: Design) -> Any:
    assert design.controller is not None
    return design.controller
