"""The draw of loops of one axis, which was run once (``draw_axes`` writes the cases).

The cases are data from then on: parts that are added to quell do not change them.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

Recipe = dict[str, Any]


def make(name: str, /, **parts: Any) -> Recipe:
    """Return a recipe."""
    return {"make": name, **parts}


def signal(name: str, **parts: Any) -> Recipe:
    """Return the recipe of a signal."""
    return make(f"signals.{name}", **parts)


def learner(name: str, **parts: Any) -> Recipe:
    """Return the recipe of a learner."""
    return make(f"learners.{name}", **parts)


def feature(name: str, **parts: Any) -> Recipe:
    """Return the recipe of features."""
    return make(f"features.{name}", **parts)


def together(*blocks: Recipe) -> Recipe:
    """Return the recipe of some blocks of features."""
    return make("sum", of=[*blocks])


def function(name: str, /, **bound: Any) -> Recipe:
    """Return the recipe of a function of ``functions``."""
    return make("function", name=name, **bound)


class Bag:
    """Things that are drawn: each once before any comes again, so that rare ones come, too."""

    def __init__(self, draw: random.Random, things: Sequence[Any]) -> None:
        self._draw, self._things, self._left = draw, [*things], []

    def __call__(self) -> Any:
        """Return the next one."""
        if not self._left:
            self._left = [*self._things]
            self._draw.shuffle(self._left)
        return self._left.pop()


CHAIN = make("plants.LinearPlant", A=[[0.0, 1.0], [-2.0, -0.3]], B=[0.0, 1.5], C=[1.0, 0.0])
LAG = make("plants.LinearPlant", A=[[-1.0]], B=[1.5], C=[1.0])
ZERO = make("tuple", of=[[1.5, 6.0], [1.0, 0.5, 2.0, 1.0]])
TWO_FORCES = make(
    "plants.LinearPlant", A=[[0.0, 1.0], [-2.0, -0.3]], B=[0.0, 1.5], C=[1.0, 0.0],
    E=[[0.0, 1.0], [1.0, 0.0]],
)  # fmt: skip
LOCAL = (
    "1 / (s (s + 0.5))",
    2,
    2.0,
    0.01,
    12.0,
    1.5,
    3.0,
    0.5,
    make("tuple", of=[[2.0], [1.0, 0.5, 0.0]]),
)

# name, order, b0, dt, omega_o, omega_c, limit of u, height of references, model of observers, plant
PLANTS: list[tuple[Any, ...]] = [
    ("two masses", 4, 1.0, 0.01, 10.0, 1.0, 5.0, 0.2, make("plants.two_mass_spring"), make("plants.two_mass_spring")),
    ("two masses, other", 4, 4.0, 0.01, 12.0, 1.2, 4.0, 0.1, None, make("plants.two_mass_spring", m1=1.0, m2=0.5, k=2.0, c1=0.05, c2=0.02)),
    ("torsional", 4, 5.5e4, 1e-3, 90.0, 20.0, 5.0, 1.0, make("plants.torsional_identified"), make("plants.torsional")),
    ("torsional, late", 4, 5.5e4, 1e-3, 80.0, 15.0, 4.0, 1.5, None, make("plants.torsional", late=2, counts=None, dac_bits=None)),
    ("torsional as identified", 4, 5.5e4, 1e-3, 90.0, 20.0, 5.0, 1.0, None, make("plants.torsional_identified")),
    ("motor", 2, 500.0, 1e-3, 150.0, 25.0, 12.0, 1.0, make("tuple", of=[[500.0], [1.0, 25.5, 0.0]]), make("plants.dc_motor")),
    ("motor, cogging", 2, 500.0, 1e-3, 200.0, 30.0, 20.0, 2.0, None, make("plants.dc_motor", stiction=0.02, cogging=[[6, 0.01, 0.3], [12, 0.004, 1.0]], counts=2048)),
    ("motor, coil", 3, 5e5, 1e-3, 150.0, 20.0, 20.0, 1.0, None, make("plants.dc_motor", inductance=5e-4, coulomb=0.0)),
    ("lagged two masses", 4, 1.0, 0.01, 10.0, 1.2, 6.0, 0.2, None, make("plants.lagged_two_mass_spring", k_cubic=0.3)),
    ("lagged, weak", 4, 1.0, 0.01, 10.0, 1.0, 6.0, 0.2, None, make("plants.lagged_two_mass_spring", effectiveness=0.7, lag=0.02)),
    ("chain", 2, 1.5, 0.01, 12.0, 1.5, 2.5, 0.5, CHAIN, CHAIN),
    ("chain, two forces", 2, 1.5, 0.01, 15.0, 2.5, 3.0, 0.5, CHAIN, TWO_FORCES),
    ("lag", 1, 1.5, 0.01, 12.0, 2.0, 1.5, 0.5, LAG, LAG),
    ("with a zero", 2, 1.5, 0.01, 12.0, 1.5, 2.0, 0.5, ZERO, make("LinearPlant.of", model=ZERO)),
    ("unstable", 2, 1.0, 0.01, 20.0, 3.0, 8.0, 0.3, make("tuple", of=[[1.0], [1.0, 0.0, -2.0]]), make("LinearPlant.of", model=make("tuple", of=[[1.0], [1.0, 0.0, -2.0]]))),
    ("third order", 3, 2.0, 0.02, 8.0, 1.0, 3.0, 0.5, make("tuple", of=[[2.0], [1.0, 3.0, 3.0, 1.0]]), make("LinearPlant.of", model=make("tuple", of=[[2.0], [1.0, 3.0, 3.0, 1.0]]))),
    ("three masses", 2, 1.0, 0.01, 20.0, 2.0, 4.0, 0.3, None, make("plants.n_mass", inertias=[1.0, 0.5, 2.0], stiffnesses=[3.0, 2.0])),
    ("three masses, play", 2, 1.0, 0.01, 20.0, 2.0, 4.0, 0.3, None, make("plants.n_mass", inertias=[1.0, 0.5, 2.0], stiffnesses=[3.0, 2.0], dampings=[0.01, 0.02], play=[0.1, 0.0], loads=[1, 3])),
    ("lag, late", 1, 1.5, 0.01, 10.0, 2.0, 1.5, 0.5, LAG, make("plants.delayed", plant=LAG, delay=0.02, dt=0.01)),
    ("chain, late by part of a sample", 2, 1.5, 0.01, 12.0, 1.5, 3.0, 0.5, CHAIN, make("plants.delayed", plant=CHAIN, delay=0.0125, dt=0.01)),
    ("chain, encoder", 2, 1.5, 0.01, 12.0, 1.5, 3.0, 0.5, CHAIN, make("plants.encoded", plant=CHAIN, counts=16000)),
    ("pendulum", 2, 1.0, 0.01, 15.0, 2.0, 5.0, 0.8, None, make("plants.NonlinearPlant", f=function("pendulum"), order=2)),
    ("swing", 2, 1.0, 0.01, 15.0, 2.0, 5.0, 0.5, None, make("plants.NonlinearPlant", f=function("swing"), order=2, output=function("mixed"), parameters={"m": 2.0, "gain": 1.5, "friction": [0.0, 0.1], "rows": [[0.0, 3.0, 0.0], [0.02, 1.0, 2.0]]})),
    ("friction", 2, 1.5, 0.01, 12.0, 2.0, 3.0, 0.5, CHAIN, make("identified", dt=0.01, num=[1.5], den=[1.0, 0.3, 0.0], delay=0.02, friction=0.1, friction_width=0.05)),
    ("friction, prompt", 1, 2.0, 0.01, 12.0, 2.0, 3.0, 0.5, None, make("identified", dt=0.01, num=[2.0], den=[1.0, 0.5], friction=0.1, friction_width=0.1)),
]  # fmt: skip


class Draw:
    """The draw of one axis and of several; its numbers have three digits."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        bag = lambda *things: Bag(self.random, things)  # noqa: E731
        self.plants = Bag(self.random, PLANTS)
        self.observers = bag(
            "current", "current", "predictor", "reduced", "half gain", "poles", "m = 2", "m = 3",
            "delay", "model", "model, m = 2", "model, other", "kalman", "cascade", "nonlinear",
            "m = 2, reduced", "kalman, m = 2", "cascade, m = 2", "nonlinear, m = 2", "far",
        )  # fmt: skip
        self.learners = bag(*[None] * 5, *LEARNERS)
        self.guards = bag(
            None, {}, {"bound": 1.5}, {"time": 1.0}, {}, {"bound": 10.0, "time": 0.5}, "certified"
        )
        self.laws = bag(
            *[{}] * 6,
            "feedback",
            "feedback 2",
            "poles",
            "half",
            "feedforward",
            "rigid",
            "of",
            "series",
            "delayed",
        )
        self.limits = bag("none", "wide", "wide", "tight", "tight", "rate", "rates", "one-sided")
        self.extras = bag(
            *[None] * 9,
            "safe",
            "safe rates",
            "held",
            "schedule r",
            "schedule y",
            "schedule speed",
            "schedule external",
            "schedule 2",
            "schedule all",
            "online",
            "online 2",
            "safe held schedule",
            "safe error",
        )
        self.prefilters = bag(
            *[None] * 5, "model", "model 3", "differentiator", "profile", "zv", "zvd", "shaper"
        )
        self.precision = bag(*["double"] * 6, "single")
        self.references = bag(
            "step",
            "sine",
            "switch",
            "ramp",
            "trapezoid",
            "smooth",
            "limited",
            "chirp",
            "multisine",
            "prbs",
            "repeated",
            "samples",
            "sum",
        )
        self.noises = bag(None, "white", "white", "slow", "sine")
        self.forces = bag("none", "step", "sine", "constant", "prbs")
        self.others = bag(
            "pid",
            "pid 2",
            "ppi",
            "notch",
            "lqg",
            "ratio",
            "tf",
            "tf y",
            "dead time",
            "from pid",
            "compensator",
            "compensated",
            "compensated learns",
            "compensated schedule",
            "simc",
            "simc 2",
            "python",
        )

    def near(self, value: float, share: float = 0.2) -> float:
        """Return a number near to another one."""
        return float(f"{value * (1.0 + share * (2.0 * self.random.random() - 1.0)):.3g}")

    # ---- One axis ----

    def observer(self, plant: Any, kind: str) -> tuple[str, Recipe]:
        """Return the name and the recipe of an observer."""
        _, order, b0, dt, omega_o, _, _, _, model, _ = plant
        b0, omega_o = self.near(b0, 0.1), self.near(omega_o)
        usual: Recipe = {"order": order, "b0": b0, "omega_o": omega_o, "dt": dt}
        m = {"disturbance_order": int(kind.partition("m = ")[2][0])} if "m = " in kind else {}
        if model is None and kind in ("model", "model, m = 2", "model, other", "far"):
            kind = "current"
        first = kind.partition(",")[0]
        if kind.startswith("model"):
            form = {"form": "reduced"} if "other" in kind else {}
            return kind, make("ESO.model_based", plant=model, omega_o=omega_o, dt=dt, **m, **form)
        if kind == "far":
            return kind, make(
                "ESO.model_based", plant=model, omega_o=omega_o, dt=dt, b0=b0, keep_zeros=True
            )
        if first == "kalman":
            drift = 3e-2 * omega_o ** (order + 1.0) * (omega_o**2.0 if m else 1.0)
            return kind, make(
                "ESO.kalman",
                order=order,
                b0=b0,
                dt=dt,
                noise_variance=1e-6,
                drift=float(f"{1e-3 * drift:.3g}"),
                **m,
            )
        if first == "cascade":
            return kind, make("ESO.cascade", **usual, **m)
        if first == "nonlinear":
            return kind, make("ESO.nonlinear", **usual, delta=0.05, **m)
        options: Recipe = {
            "predictor": {"form": "predictor"}, "reduced": {"form": "reduced"}, "half gain": {"half_gain": True},
            "poles": {"poles": [[-0.8, 0.6], *[-1.0 - 0.1 * i for i in range(order - 1)]]}, "delay": {"delay": 2.0 * dt},
            "m = 2, reduced": {"form": "reduced"},
        }.get(kind, {})  # fmt: skip
        if "poles" in options:
            options["poles"] = [
                make("tuple", of=p) if isinstance(p, list) else p for p in options["poles"]
            ]
        return f"model-free {kind}", make("ESO.model_free", **usual, **m, **options)

    def law(self, kind: Any, plant: Any) -> tuple[str, Recipe]:
        """Return options of the law."""
        _, order, b0, dt, _, _, _, _, _, _ = plant
        if not kind:
            return "", {}
        inertia = float(f"{1.0 / b0:.3g}")
        n = order
        return kind, {
            "feedback": {"feedback": make("NonlinearFeedback", alpha=make("tuple", of=[0.75 + 0.25 * i for i in range(n)]), delta=0.05)},
            "feedback 2": {"feedback": make("NonlinearFeedback", alpha=make("tuple", of=[0.5 + 0.25 * i for i in range(n)]), delta=make("tuple", of=[0.05 * (i + 1) for i in range(n)]))},
            "poles": {"law_poles": [-1.0 - 0.2 * i for i in range(n)]},
            "half": {"half_gain": True},
            "feedforward": {"feedforward": True},
            "rigid": {"feedforward": make("Feedforward.rigid", inertia=inertia, viscous=0.1 * inertia, coulomb=0.05 * inertia, coulomb_speed=0.1)},
            "of": {"feedforward": make("Feedforward.of", plant=CHAIN)},
            "series": {"feedforward": make("Feedforward", coefficients=make("tuple", of=[0.3 * inertia, 0.1 * inertia, inertia]), constant=-0.1 * inertia, coulomb=0.1 * inertia, coulomb_speed=0.2)},
            "delayed": {"feedforward": make("Feedforward.rigid", inertia=inertia, delay=3.0 * dt, derivatives=2)},
        }[kind]  # fmt: skip

    def limit(self, kind: str, plant: Any) -> tuple[str, Recipe]:
        """Return limits of u."""
        most, dt = plant[6], plant[3]
        rate = float(f"{most / (8.0 * dt):.3g}")
        return kind, {
            "none": {}, "wide": {"u_min": -2.0 * most, "u_max": 2.0 * most},
            "tight": {"u_min": -self.near(0.4 * most), "u_max": self.near(0.5 * most)},
            "rate": {"u_min": -most, "u_max": most, "rate_limit": rate},
            "rates": {"u_min": -most, "u_max": most, "rate_limit": make("tuple", of=[-0.7 * rate, rate])},
            "one-sided": {"u_max": self.near(0.6 * most)},
        }[kind]  # fmt: skip

    def extra(self, kind: Any, plant: Any) -> tuple[str, Recipe]:
        """Return a safe set, a brake, or a schedule."""
        if kind is None:
            return "", {}
        _, _, b0, _, omega_o, omega_c, _, height, _, _ = plant
        few, many = float(f"{0.7 * b0:.3g}"), float(f"{1.6 * b0:.3g}")
        points = [-0.5 * height, 0.6 * height]
        safe = {"y_min": -0.8 * height, "y_max": 0.8 * height}
        rates = {
            **safe,
            "rate_min": -2.0 * height * omega_c,
            "rate_max": 2.0 * height * omega_c,
            "alpha": 3.0 * omega_c,
            "f_rate": 0.1 * b0,
            "noise": 1e-5,
        }

        def by(signal: str, **more: Any) -> Recipe:
            table = make("Schedule", points=points, signal=signal, b0=[few, many], **more)
            return {"schedule": table}

        return kind, {
            "safe": {"safe_set": make("SafeSet", **safe, alpha=3.0 * omega_c)},
            "safe rates": {"safe_set": make("SafeSet", **rates)},
            "safe error": {"safe_set": make("SafeSet", **safe, alpha=3.0 * omega_c, gain_error=0.1)},
            "held": {"held": make("HeldPlant", noise=1e-5)},
            "schedule r": by("reference"), "schedule y": by("y"), "schedule speed": by("speed"),
            "schedule external": by("external"),
            "schedule 2": {"schedule": make("Schedule", points=[points, [-1.0, 0.0, 1.0]], signal=make("tuple", of=["y", "speed"]), b0=[[few, b0, many], [b0, many, many]])},
            "schedule all": by("reference", omega_c=[0.8 * omega_c, 1.3 * omega_c], omega_o=[0.8 * omega_o, 1.2 * omega_o]),
            "online": {"schedule": make("OnlineGain", low=0.5 * b0, high=2.0 * b0, bandwidth=2.5 * omega_o)},
            "online 2": {"schedule": make("OnlineGain", low=0.5 * b0, high=2.0 * b0, memory_time=1.0, tolerance=0.2)},
            "safe held schedule": {"safe_set": make("SafeSet", **rates), "held": make("HeldPlant"), **by("reference")},
        }[kind]  # fmt: skip

    def prefilter(self, kind: Any, plant: Any) -> tuple[str, Any]:
        """Return a filter of the reference."""
        _, _, _, _, _, omega_c, _, height, _, _ = plant
        if kind is None:
            return "", None
        return kind, {
            "model": make("ReferenceModel", omega=3.0 * omega_c), "model 3": make("ReferenceModel", omega=4.0 * omega_c, order=3),
            "differentiator": make("TrackingDifferentiator", acceleration=4.0 * height * omega_c**2),
            "profile": make("ProfileGenerator", v_max=height * omega_c, a_max=4.0 * height * omega_c**2, j_max=20.0 * height * omega_c**3),
            "zv": make("ZV", omega=3.0 * omega_c), "zvd": make("ZVD", omega=4.0 * omega_c, zeta=0.1),
            "shaper": make("Shaper", times=make("tuple", of=[0.0, 0.3 / omega_c, 0.6 / omega_c]), amplitudes=make("tuple", of=[0.3, 0.4, 0.3])),
        }[kind]  # fmt: skip

    def scenario(self, plant: Any, forces: int = 1, schedule: bool = False, x: int = 0) -> Recipe:
        """Return a scenario of 150 to 350 samples."""
        _, _, _, dt, _, omega_c, most, height, _, _ = plant
        samples = self.random.randrange(150, 330)
        found: Recipe = {
            "reference": self.reference(self.references(), height, samples * dt, omega_c),
            "duration": float(f"{samples * dt:.6g}"), "seed": self.random.randrange(1000),
        }  # fmt: skip
        noise = self.noises()
        if noise == "white":
            found["noise"] = signal(
                "BandLimitedNoise", power=float(f"{1e-7 * height**2 * dt:.3g}"), sample_time=dt
            )
        elif noise == "slow":
            found["noise"] = signal(
                "BandLimitedNoise",
                power=float(f"{1e-7 * height**2 * dt:.3g}"),
                sample_time=3.0 * dt,
            )
        elif noise == "sine":
            found["noise"] = signal("Sinusoid", amplitude=1e-3 * height, omega=30.0)
        force, half = self.forces(), 0.4 * samples * dt
        found["disturbances"] = {
            "none": [], "constant": [0.1 * most], "step": [signal("Step", height=0.2 * most, at=half)],
            "sine": [signal("Sinusoid", amplitude=0.1 * most, omega=2.0 * omega_c)],
            "prbs": [signal("PRBS", amplitude=0.1 * most, bits=6, step=7.0 * dt, seed=3)],
        }[force]  # fmt: skip
        if forces == 2 and found["disturbances"]:
            found["disturbances"].append(
                signal("Chirp", amplitude=0.05 * most, omega_end=5.0, duration=2.0)
            )
        if self.random.random() < 0.25:
            found["rest_at"] = [float(f"{(samples // 2) * dt:.6g}")]
        if schedule:
            found["schedule"] = [signal("Sinusoid", amplitude=height, omega=omega_c)]
        return make("Scenario", **found)

    def reference(self, kind: str, height: float, time: float, omega_c: float) -> Recipe:
        """Return a reference."""
        part = lambda share: float(f"{share * time:.3g}")  # noqa: E731
        step, sine = (
            signal("Step", height=height, at=part(0.05)),
            signal("Sinusoid", amplitude=height, omega=self.near(omega_c)),
        )
        return {
            "step": step, "sine": sine, "switch": make("switch", first=sine, until=part(0.5), then=signal("Step", height=-height, at=part(0.5))),
            "ramp": signal("Ramp", slope=float(f"{height / time:.3g}"), stop=part(0.7)), "trapezoid": signal("Trapezoid", distance=height, duration=part(0.6)),
            "smooth": signal("SmoothMove", distance=height, duration=part(0.7), start=part(0.1)),
            "limited": signal("LimitedMove", distance=height, v_max=height * omega_c, a_max=2.0 * height * omega_c**2, j_max=10.0 * height * omega_c**3),
            "chirp": signal("Chirp", amplitude=height, omega_start=0.3 * omega_c, omega_end=2.0 * omega_c, duration=time),
            "multisine": signal("Multisine", omegas=[0.5 * omega_c, omega_c, 2.0 * omega_c], amplitudes=[0.5 * height, 0.3 * height, 0.1 * height]),
            "prbs": signal("PRBS", amplitude=0.5 * height, bits=5, step=part(0.1), seed=2),
            "repeated": signal("Repeated", cycle=signal("Trapezoid", distance=height, duration=part(0.3)), period=part(0.4)),
            "samples": signal("Samples", times=[0.0, part(0.2), part(0.5), part(0.9)], values=[0.0, height, 0.5 * height, -0.5 * height]),
            "sum": signal("Sum", terms=make("tuple", of=[step, signal("Sinusoid", amplitude=0.2 * height, omega=4.0 * omega_c)])),
        }[kind]  # fmt: skip

    def one(self) -> tuple[str, Recipe]:
        """Return the name and the case of a loop with ADRC."""
        plant = self.plants()
        names = [plant[0]]
        name, observer = self.observer(plant, self.observers())
        names.append(name)
        parts: Recipe = {"observer": observer, "omega_c": self.near(plant[5])}
        learns = self.learners()
        if learns is not None:
            names.append(learns)
            parts["learner"] = LEARNERS[learns](plant[1], plant)
            guard = self.guards()
            if guard == "certified":
                guard = {"certified_for": plant[8]} if plant[8] else {}
            if guard is not None:
                names.append("guard" + "".join(f" {key}" for key in guard))
                parts["guard"] = make("Guard", **guard)
        extra = self.extras()
        for method, drawn in (
            (self.law, self.laws()),
            (self.limit, self.limits()),
            (self.extra, extra),
        ):
            name, options = method(drawn, plant)
            parts |= options
            names.append(name)
        prefilter = self.prefilters()
        self._without_contradictions(names, parts, extra)
        if "feedforward" in parts and prefilter in ("zv", "zvd", "shaper"):
            prefilter = "model 3"
        controller = make("ADRC", **parts)
        name, prefilter = self.prefilter(prefilter, plant)
        if prefilter is not None:
            controller = make("Prefiltered", controller=controller, prefilter=prefilter)
        names.append(name)
        case: Recipe = {"plant": plant[9], "controller": controller}
        case["scenario"] = self.scenario(
            plant, 2 if "forces" in plant[0] else 1, extra == "schedule external"
        )
        if self.precision() == "single":
            case["precision"] = "single"
            names.append("single")
        return ", ".join(name for name in names if name), case

    def _without_contradictions(self, names: list[str], parts: Recipe, extra: Any) -> None:
        """Leave out what quell refuses beside other parts."""
        kind, extended = parts["observer"]["make"], "disturbance_order" in parts["observer"]
        extra = extra or ""
        drop: set[str] = set()
        if extended:
            drop |= {"guard", "safe_set"}
        if "nonlinear" in kind or extra in ("schedule all",) or extra.startswith("online"):
            drop |= {"learner", "guard"}
        if extra.startswith("online") and not 1 <= parts["observer"].get("order", 9) <= 2:
            drop.add("schedule")
        if extra.startswith(("schedule", "safe held")) and "certified_for" in parts.get(
            "guard", {}
        ):
            parts["guard"] = make("Guard")
        if extra.startswith("schedule") and kind == "ESO.model_based":
            drop |= {"learner", "guard"}
        if "safe" in extra and parts["observer"].get("form", "current") != "current":
            drop.add("safe_set")
        for key in drop & parts.keys():
            del parts[key]
            names.append(f"no {key}")

    def other(self) -> tuple[str, Recipe]:
        """Return the name and the case of a loop with another controller."""
        kind, plant = self.others(), self.plants()
        if kind == "ratio":
            plant = PLANTS[0]
        _, order, b0, dt, omega_o, omega_c, _, height, model, _ = plant
        observed, observer = self.observer(plant, self.observers())
        limited, limits = self.limit(self.limits(), plant)
        w, g = omega_c, 1.0 / b0
        if order >= 3:
            plant = self.random.choice(PLANTS[10:14])
            return self.other()
        kp, kd = (2.0 * w * g, 0.0) if order == 1 else (4.0 * w * w * g, 3.0 * w * g)
        short = lambda x: float(f"{x:.3g}")  # noqa: E731
        pid = make("PID", kp=short(kp), ki=short(kp * w), kd=short(kd), tf=short(0.2 / w), dt=dt)
        learns = learner("Kalman", u=True)
        compensator = make(
            "Compensator",
            observer=observer,
            omega_c=w,
            learner=learns,
            guard=make("Guard"),
            **limits,
        )
        plain = make("Compensator", observer=observer, **limits)
        by_y = make(
            "Schedule", points=[-0.5 * height, 0.6 * height], signal="y", b0=[0.8 * b0, 1.5 * b0]
        )
        drive = self.random.choice(
            [pid, make("PPI", kv=w, kp=short(2.0 * w * g), tn=short(2.0 / w), dt=dt)]
        )
        try:
            controller = {
                "pid": lambda: {**pid, **limits, "b": 0.7, "tt": short(1.0 / w)},
                "pid 2": lambda: {**pid, **limits, "tf": make("tuple", of=[short(0.2 / w), short(0.1 / w)]), "c": 0.5},
                "ppi": lambda: make("PPI", kv=w, kp=short(2.0 * w * g), tn=short(2.0 / w), tf=short(0.1 / w), notches=[make("Notch", omega=9.0 * w)], inertia=short(g), viscous=short(0.1 * g), dt=dt, **limits),
                "notch": lambda: make("NotchPID", notch=make("Notch", omega=9.0 * w, depth=0.2), kp=short(kp), ki=short(kp * w), kd=short(kd), tf=short(0.2 / w), dt=dt, **limits),
                "lqg": lambda: make("LQG", plant=model or CHAIN, omega_c=w, omega_o=omega_o, dt=dt, **limits),
                "ratio": lambda: make("ResonanceRatio", omega_o=5.0, dt=dt, **limits),
                "tf": lambda: make("LinearController.of", num=[short(kd + 0.1 * kp), short(kp)], den=[short(0.1 / w), 1.0], dt=dt, **limits),
                "tf y": lambda: make("LinearController.of", num=[short(kp), short(kp * w)], den=[1.0, 0.0], feedback="output", tracking_time=short(1.0 / w), dt=dt, **limits),
                "dead time": lambda: make("adrc_for_dead_time", gain=1.5, time_constant=1.0, dead_time=0.05, dt=dt, **limits),
                "from pid": lambda: make("ADRC.from_pid", kp=short(kp), ki=short(0.5 * kp * w), kd=short(kd), tf=short(0.1 / w), dt=dt, b0=b0, **limits),
                "compensator": lambda: make("Compensated", controller={**pid, **limits}, compensator=plain),
                "compensated": lambda: make("Compensated", controller=drive, compensator={**plain, **self.extra(self.random.choice(["safe", "safe rates", "held"]), plant)[1]}),
                "compensated learns": lambda: make("Compensated", controller=drive, compensator=compensator),
                "compensated schedule": lambda: make("Compensated", controller=drive, compensator={**compensator, "schedule": by_y}),
                "simc": lambda: make("PID.simc", gain=1.5, tau1=1.0, theta=0.1, dt=dt, **limits),
                "simc 2": lambda: make("PID.simc_double_integrator", gain=b0, theta=0.1, dt=dt, **limits),
                "python": lambda: make("ADRC", observer=observer, omega_c=w, learner=learner("PythonModel", model=make("model in Python"), period=4), guard=make("Guard"), **limits),
            }[kind]()  # fmt: skip
        except KeyError:
            raise ValueError(kind) from None
        names = [plant[0], kind, observed if "comp" in kind else "", limited]
        prefilter, made = self.prefilter(self.prefilters(), plant)
        if made is not None:
            controller, names = (
                make("Prefiltered", controller=controller, prefilter=made),
                [*names, prefilter],
            )
        case = {"plant": plant[9], "controller": controller, "scenario": self.scenario(plant)}
        if self.precision() == "single":
            case["precision"], names = "single", [*names, "single"]
        return ", ".join(name for name in names if name), case


def _rls(*blocks: Recipe, **options: Any) -> Any:
    return lambda n, plant: learner("RLS", features=together(*blocks), **options)


_S, _B, _U = feature("State"), feature("Bias"), feature("Input")
LEARNERS: dict[str, Any] = {
    "Kalman": lambda n, p: learner("Kalman"),
    "Kalman u": lambda n, p: learner("Kalman", u=True, bias_bandwidth=0.2),
    "Kalman state only": lambda n, p: learner(
        "Kalman", bias=False, state_bandwidth=0.1, frequency=p[5]
    ),
    "Kalman bias, u": lambda n, p: learner(
        "Kalman", state=False, u=True, gain_interval=make("tuple", of=[0.7, 1.4])
    ),
    "Harmonic": lambda n, p: learner("Harmonic", omegas=[2.0 * p[5]]),
    "Harmonic 2": lambda n, p: learner(
        "Harmonic", count=2, limits=make("tuple", of=[0.5 * p[5], 6.0 * p[5]]), u=True
    ),
    "Harmonic orders": lambda n, p: learner(
        "Harmonic", count=2, orders=make("tuple", of=[1, 3]), search=True, bias=False
    ),
    "Harmonic slow": lambda n, p: learner(
        "Harmonic", orders=make("tuple", of=[2]), pair_bandwidth=0.1, state=False, search=True
    ),
    "RLS": lambda n, p: learner("RLS"),
    "RLS u": _rls(_S, _B, _U, memory_time=90.0),
    "RLS polynomial": _rls(_S, feature("Polynomial", degree=2), _B, prior=5.0),
    "RLS cubic": _rls(feature("Polynomial", degree=3, states=[1]), _B),
    "RLS strongest": _rls(
        _S, feature("RBF", count=8), feature("Periodic", highest=4), _B, strongest=9
    ),
    "RLS RBF": _rls(feature("RBF", count=9, width=0.4, states=[1]), _B, relearn=3.0),
    "RLS RBF centers": _rls(_S, feature("RBF", centers=[[0.0], [0.5], [-0.5]], states=[1]), _B),
    "RLS map": _rls(feature("Periodic", orders=make("tuple", of=[1, 3])), _B, recall=True),
    "RLS periodic": _rls(feature("Periodic", period=0.7, highest=3), _B, bias_bandwidth=0.2),
    "RLS friction": lambda n, p: learner(
        "RLS",
        features=together(_S, feature("Friction", width=0.02, states=[2 if n > 1 else 1]), _B),
    ),
    "RLS friction sign": lambda n, p: learner(
        "RLS",
        features=together(feature("Friction", sign=True, states=[1]), _B),
        scale=[1.0] * (n + 2),
    ),
    "RLS custom": _rls(
        _S, feature("Custom", function=function("squared"), names=make("tuple", of=["y |y|"])), _B
    ),
    "RLS Fourier": _rls(feature("RandomFourier", count=8, seed=1), _B),
    "RLS first state": lambda n, p: learner(
        "RLS", features=together(feature("State", count=1), _B), frequency=p[5]
    ),
    "NLMS": lambda n, p: learner("NLMS"),
    "NLMS features": lambda n, p: learner(
        "NLMS", features=together(_S, _B, _U), rate=0.1, regularisation=0.02
    ),
    "NLMS Fourier": lambda n, p: learner(
        "NLMS", features=feature("RandomFourier", count=10, length=0.5)
    ),
    "gradient": lambda n, p: learner("BatchGradient"),
    "gradient RBF": lambda n, p: learner(
        "BatchGradient",
        features=together(feature("RBF", count=8, states=[1]), _B),
        rate=1e-4,
        batch=3,
    ),
    "MLP": lambda n, p: learner("MLP", hidden=3),
    "MLP every": lambda n, p: learner(
        "MLP", features=together(_S, _B), hidden=2, every=2, memory_time=90.0, noise=0.2, seed=1
    ),
    "Gaussian process": lambda n, p: learner("GaussianProcess", budget=6),
    "Gaussian process few": lambda n, p: learner(
        "GaussianProcess",
        features=together(_S, _U),
        budget=4,
        every=1,
        length=0.7,
        memory_time=90.0,
        novelty=0.1,
    ),
    "Repetitive": lambda n, p: learner("Repetitive", period=80 * p[3]),
    "Repetitive weak": lambda n, p: learner("Repetitive", period=48 * p[3], gain=0.3),
    "model of a user": lambda n, p: learner(
        "Online", model=make("model of a user"), features=together(_S, _U)
    ),
    "none": lambda n, p: learner("NoLearner"),
}
"""Learners by their name in a case: functions of the order and the plant."""
