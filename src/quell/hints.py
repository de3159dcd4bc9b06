"""Errors for names that do not exist, of modules, objects and arguments, which say what is meant.

An error of a user's call names what to write. Names from other packages and textbooks have their
own line here; for others the nearest name is given.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

# What stands for a name that people type, by the name in small letters without underscores.
_PID, _PLANT = "quell.baselines.PID(kp, ki, kd, tf=…, dt=…)", "a tuple (num, den) or (A, B, C)"
_NOISE = "quell.signals.BandLimitedNoise(power, sample_time)"
OF_MODULES = {
    **dict.fromkeys(("pid", "pidcontroller", "pi"), _PID),
    **dict.fromkeys(("lqg", "lqr"), "quell.baselines.LQG"),
    **dict.fromkeys(("ladrc", "nladrc", "adrccontroller"), "quell.ADRC(observer, omega_c)"),
    **dict.fromkeys(
        ("leso", "neso", "observer", "extendedstateobserver"),
        "quell.ESO.model_free(order, b0, omega_o, dt)",
    ),
    **dict.fromkeys(
        ("tf", "ss", "transferfunction", "statespace", "system"),
        f"{_PLANT}; as a plant quell.plants.LinearPlant.of(model)",
    ),
    **dict.fromkeys(
        ("sim", "simulation", "simulator", "run", "inputoutputresponse", "forcedresponse"),
        "quell.simulate(plant, controller, scenario)",
    ),
    **dict.fromkeys(("plant", "motor", "dcmotor"), "quell.plants, with quell.plants.dc_motor()"),
    **dict.fromkeys(("kalman", "kalmanfilter"), "quell.learners.Kalman()"),
    **dict.fromkeys(("harmonic", "oscillator"), "quell.learners.Harmonic()"),
    **dict.fromkeys(("neuralnetwork", "nn", "network"), "quell.learners.MLP(…) or TorchModel(…)"),
    **dict.fromkeys(("ilc", "iterativelearning"), "quell.learners.Repetitive(period)"),
    **dict.fromkeys(("sine", "sin", "sinus", "cosine"), "quell.signals.Sinusoid(amplitude, omega)"),
    **dict.fromkeys(("noise", "whitenoise", "gaussiannoise"), _NOISE),
    **dict.fromkeys(("array", "table", "interpolated"), "quell.signals.Samples(times, values)"),
    **dict.fromkeys(("square", "pulse"), "quell.signals.Repeated, or Step(at=…) − Step(at=…)"),
    **dict.fromkeys(
        ("bode", "nyquist", "margin", "margins", "sensitivity"),
        "quell.analysis.analyse(plant, controller)",
    ),
    **dict.fromkeys(("notch", "notchfilter"), "quell.baselines.NotchPID"),
    **dict.fromkeys(("trajectory", "profile"), "quell.controllers.ProfileGenerator"),
    **dict.fromkeys(("codegen", "ccode", "toc"), "quell.export.c(controller, folder)"),
    **dict.fromkeys(("load", "setup"), "quell.setup.load(file)"),
}
_STEP, _ESTIMATE = "controller.step(r, y)", "controller.estimate"
OF_CONTROLLERS = {
    **dict.fromkeys(("update", "compute", "control", "output", "call", "calculate"), _STEP),
    **dict.fromkeys(("fhat", "f"), f"{_ESTIMATE}.f"),
    **dict.fromkeys(("xhat", "x", "z", "states"), f"{_ESTIMATE}.x"),
    **dict.fromkeys(("u", "uhat"), f"{_ESTIMATE}.u"),
    **dict.fromkeys(("theta", "weights", "coefficients"), f"{_ESTIMATE}.theta"),
    **dict.fromkeys(("authority", "flags"), f"{_ESTIMATE}.authority and .status"),
    **dict.fromkeys(("omegao", "b0", "order", "eso"), "controller.observer and its attributes"),
    **dict.fromkeys(("umin", "umax", "saturation"), "controller.limits; set_limits changes them"),
    "simulate": "quell.simulate(plant, controller, scenario)",
    "export": "quell.export.c(controller, folder)",
    **dict.fromkeys(("margins", "bode"), "quell.analysis.analyse(plant, controller)"),
}
# Where there are several, the first that the call has.
OF_ARGUMENTS = {
    **dict.fromkeys(("wo", "omegaobserver", "observerbandwidth", "ωo"), "omega_o"),
    **dict.fromkeys(("wc", "omegacontroller", "controllerbandwidth", "bandwidth"), "omega_c"),
    **dict.fromkeys(("b", "gain", "b_0", "bhat"), "b0"),
    **dict.fromkeys(("ts", "h", "t_s", "sampletime", "samplingtime", "delta", "period"), "dt"),
    **dict.fromkeys(("umax", "max", "upper", "limit"), "u_max"),
    **dict.fromkeys(("umin", "min", "lower"), "u_min"),
    **dict.fromkeys(("limits", "saturation", "sat"), "u_min, u_max"),
    **dict.fromkeys(("ref", "setpoint", "target", "sp"), "reference"),
    "r": "reference|resistance",
    **dict.fromkeys(("freq", "frequency", "f", "hz"), "omega"),
    **dict.fromkeys(("j", "mass"), "inertia|inertias"),
    **dict.fromkeys(("amp", "size"), "amplitude|height"),
    **dict.fromkeys(("disturbance", "load", "loads", "w", "d"), "disturbances"),
    **dict.fromkeys(("t", "tend", "tfinal", "time", "seconds", "stoptime"), "duration|at"),
    **dict.fromkeys(("n", "degree"), "order"),
    **dict.fromkeys(("model", "sys", "system", "process", "g"), "plant"),
}


def plain(name: str) -> str:
    """Return a name in small letters, without underscores: the keys of these tables."""
    return name.casefold().replace("_", "")


def _nearest(name: str, known: Iterable[str]) -> str:
    """Return the known name that is nearest to a name; empty if none is near."""
    import difflib  # only where there is an error

    return next(iter(difflib.get_close_matches(name, list(known), n=1, cutoff=0.72)), "")


class MissingAttributeError(AttributeError):
    """An attribute that does not exist; its text says what is meant, if that is known.

    The text is found when it is asked for: code that only looks whether there is an attribute does
    not pay for it.
    """

    def __init__(
        self,
        owner: str,
        name: str,
        known: Callable[[], Iterable[str]],
        meant: Callable[[], Mapping[str, str]],
    ) -> None:
        super().__init__(f"{owner} has no attribute {name!r}")
        self._known, self._meant, self._name = known, meant, name

    def __str__(self) -> str:
        text = str(self.args[0])
        if self._name.startswith("_"):
            return text
        asked = plain(self._name)
        near = self._meant().get(asked)
        if near is None:
            public = {plain(each): each for each in self._known() if not each.startswith("_")}
            near = public.get(_nearest(asked, public))
        return text if near is None else f"{text}: did you mean {near}?"

    def __reduce__(self) -> Any:
        return AttributeError, (str(self),)


class Hinted:
    """A base class of objects whose errors for attributes that they lack say what is meant."""

    def __getattr__(self, name: str) -> Any:
        kind = type(self)
        if hasattr(kind, name):  # a property, whose own error is the one to see
            return object.__getattribute__(self, name)
        known = functools.partial(dir, kind)
        raise MissingAttributeError(f"{kind.__name__!r} object", name, known, self._meant)

    def _meant(self) -> Mapping[str, str]:
        """Return what stands for names that do not exist."""
        return {}


def explained(example: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator: a call with wrong arguments says which, and shows ``example``.

    A class as well as a function can be decorated.
    """

    def decorate(function: Any) -> Any:
        if isinstance(function, type):
            function.__init__ = decorate(function.__init__)  # type: ignore[misc]
            return function

        @functools.wraps(function)
        def call(*arguments: Any, **named: Any) -> Any:
            try:
                return function(*arguments, **named)
            except TypeError as error:
                if error.__traceback__ is None or error.__traceback__.tb_next is not None:
                    raise  # of the function's own work
                said = _said(function, arguments, named) or str(error)
                raise TypeError(f"{said}; write {example}") from None

        return call

    return decorate


def _meant(name: str, parameters: Iterable[str]) -> str:
    """Return the arguments that stand for one that does not exist; empty if none is known."""
    known = {plain(each): each for each in parameters}
    if plain(name) in known:
        return known[plain(name)]
    for near in OF_ARGUMENTS.get(plain(name), "").split("|"):
        if near and all(each in known.values() for each in near.split(", ")):
            return near
    return _nearest(name, known.values())


def _said(function: Callable[..., Any], arguments: Any, named: Mapping[str, Any]) -> str:
    """Return what is wrong with the arguments of a call."""
    import inspect  # only where there is an error

    every = dict(inspect.signature(function).parameters)
    own = 1 if next(iter(every), "") in ("self", "cls") else 0
    parameters = dict(list(every.items())[own:])
    title = function.__qualname__.removesuffix(".__init__")
    for name in named:
        if name not in parameters:
            near = _meant(name, parameters)
            more = f", did you mean {near}?" if near else f"; it takes {', '.join(parameters)}"
            return f"{title}: {name} is no argument{more}"
    by_place = [
        name for name, each in parameters.items() if each.kind is not inspect.Parameter.KEYWORD_ONLY
    ]
    given = {*by_place[: len(arguments) - own], *named}
    missing = [
        name
        for name, each in parameters.items()
        if each.default is inspect.Parameter.empty
        and each.kind not in (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
        and name not in given
    ]
    return f"{title} needs {', '.join(missing)}, too" if missing else ""
