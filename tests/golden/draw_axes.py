"""The draw of several axes and of driven controllers, which was run once; it writes the cases.

``python -m tests.golden.draw_axes`` draws all cases anew: their results are other ones then.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

from .draw import (
    LEARNERS,
    PLANTS,
    Bag,
    Draw,
    Recipe,
    feature,
    function,
    learner,
    make,
    signal,
    together,
)

_S, _B = feature("State"), feature("Bias")

# ---- Several axes ----

_GANTRY = make("plants.LinearPlant", A=[[0, 1, 0, 0], [0, -2, 0, 0], [0, 0, 0, 1], [0, 0, 0, -3]], B=[[0, 0], [5, 0.5], [0, 0], [0.4, 6]], C=[[1, 0, 0, 0], [0, 0, 1, 0]])  # fmt: skip
_SPRING = make("plants.LinearPlant", A=[[0, 1, 0, 0], [-4, -0.4, 3, 0.1], [0, 0, 0, 1], [3, 0.1, -5, -0.6]], B=[[0, 0], [1, 0.3], [0, 0], [0.2, 1]], C=[[1, 0, 0, 0], [0, 0, 1, 0]], E=[[0], [1], [0], [0.5]])  # fmt: skip
_THREE = make("plants.LinearPlant", A=[[0, 1, 0, 0, 0, 0], [0, -1, 0.5, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0.5, 0, 0, -2, 0, 0.3], [0, 0, 0, 0, 0, 1], [0, 0, 0, 0.3, 0, -1]], B=[[0, 0, 0, 0], [1, 0.3, 0.1, 0.5], [0, 0, 0, 0], [0.2, 2, 0.1, 0.2], [0, 0, 0, 0], [0, 0.3, 0.5, 0.4]], C=[[1, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 1, 0]])  # fmt: skip
_SQUARE3 = make("plants.LinearPlant", A=[[-1, 0.2, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0.3, -1, -2, -1, 0, 0], [0, 0, 0, 0, 0, 1], [0, 0.3, 0, 0, -1, -1]], B=[[1, 0.3, 0.1], [0, 0, 0], [0, 0, 0], [0.2, 2, 0.1], [0, 0, 0], [0, 0.3, 0.5]], C=[[1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 0, 0, 1, 0]])  # fmt: skip
_WIDE2 = make("plants.LinearPlant", A=[[0, 1, 0, 0], [0, -0.5, 0.4, 0], [0, 0, 0, 1], [0.4, 0, 0, -0.5]], B=[[0, 0, 0], [1, 0.1, 0.3], [0, 0, 0], [0.1, 0.5, -0.3]], C=[[1, 0, 0, 0], [0, 0, 1, 0]])  # fmt: skip
_ARM = make("plants.arm", viscous=0.1)
_SOFT = make(
    "plants.arm", gravity=0.0, coulomb=0.2, motor_inertia=0.05, stiffness=200.0, damping=0.5
)
_TANKS = make("plants.NonlinearPlant", f=function("tanks"), order=4, inputs=2, output=function("places"))  # fmt: skip
_DRONE = make("plants.quadrotor_attitude")
_MATRIX2, _MATRIX3 = [[1.0, 0.3], [0.2, 1.0]], [[1.0, 0.3, 0.1], [0.2, 2.0, 0.1], [0.0, 0.3, 0.5]]
_MATRIX34 = [[1.0, 0.3, 0.1, 0.5], [0.2, 2.0, 0.1, 0.2], [0.0, 0.3, 0.5, 0.4]]
_MASS = function("mass_of", inertia=0.8, arms=[0.3, 0.2], coupling=[[9.0, 0.2], [0.15, 0.1]])

# name, orders, dt, omega_o, omega_c, limit of u, height, ways to say B0, plant
MACHINES: list[tuple[Any, ...]] = [
    ("gantry", (2, 2), 1e-3, 60.0, 8.0, 4.0, 0.1, [{"B0": [[5.0, 0.5], [0.4, 6.0]]}, {"B0": [[6.0, 0.3], [0.4, 5.0]]}, {"M": [[0.2, -0.015], [-0.015, 0.17]]}], _GANTRY),
    ("gantry, encoders", (2, 2), 1e-3, 60.0, 8.0, 4.0, 0.1, [{"B0": [[5.0, 0.5], [0.4, 6.0]]}], make("plants.encoded_outputs", plant=_GANTRY, resolution=[1e-5, 2e-5])),
    ("gantry, late", (2, 2), 1e-3, 50.0, 6.0, 4.0, 0.1, [{"B0": [[5.0, 0.5], [0.4, 6.0]]}], make("plants.delayed_inputs", plant=_GANTRY, delay=[1e-3, 2e-3], dt=1e-3)),
    ("springs", (2, 2), 0.01, 15.0, 2.0, 2.0, 0.3, [{"B0": _MATRIX2}, {"B0": function("square_gain")}, {"M": function("mass_matrix")}, {"M": _MASS}, {"B0": function("sometimes_singular")}], _SPRING),
    ("tanks", (2, 2), 0.01, 15.0, 2.0, 2.0, 0.3, [{"B0": _MATRIX2}, {"B0": function("square_gain")}], _TANKS),
    ("three", (2, 2, 2), 0.01, 15.0, 2.0, 2.0, 0.3, [{"B0": _MATRIX34}, {"B0": _MATRIX34, "weights": [1.0, 2.0, 3.0, 4.0]}, {"B0": _MATRIX34, "wished": [0.1, 0.0, 0.0, -0.1]}], _THREE),
    ("orders 1, 3, 2", (1, 3, 2), 0.01, 12.0, 1.5, 2.0, 0.3, [{"B0": _MATRIX3}], _SQUARE3),
    ("two of three", (2, 2), 0.01, 15.0, 2.0, 2.0, 0.3, [{"B0": [[1.0, 0.1, 0.3], [0.1, 0.5, -0.3]]}, {"B0": function("wide_gain"), "weights": [1.0, 2.0, 1.0]}], _WIDE2),
    ("arm", (2, 2), 1e-3, 60.0, 8.0, 30.0, 0.5, [{"M": make("mass matrix of", plant=_ARM)}, {"B0": [[3.0, -4.0], [-4.0, 12.0]]}], _ARM),
    ("soft arm", (2, 2), 1e-3, 50.0, 6.0, 20.0, 0.3, [{"M": make("mass matrix of", plant=_ARM)}], _SOFT),
    ("craft", (2, 2, 2), 2e-3, 40.0, 5.0, 2.0, 0.2, [{"B0": "craft"}, {"B0": "craft", "wished": [2.0] * 4}], _DRONE),
]  # fmt: skip
# Levers of the craft, divided by its inertias.
_CRAFT = [[10.017, -10.017, -10.017, 10.017], [10.017, 10.017, -10.017, -10.017], [0.682, -0.682, 0.682, -0.682]]  # fmt: skip


class DrawAxes(Draw):
    """The draw of several axes."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        bag = lambda *things: Bag(self.random, things)  # noqa: E731
        self.machines = Bag(self.random, MACHINES)
        self.saturations = bag("each", "direction", "priority")
        self.bounds = bag("none", "wide", "tight", "tight", "rate", "rates")
        self.kinds = bag(
            "own",
            "own",
            "plain",
            "plain",
            "all RLS",
            "all NLMS",
            "each",
            "own safe",
            "safe",
            "compensators",
            "compensators learn",
            "drives",
            "all RLS safe",
            "all GP",
            "held",
        )
        self.each = bag(
            "current", "current", "predictor", "m = 2", "half gain", "reduced", "kalman", "cascade"
        )
        self.of_all = bag(
            together(feature("AllAxes", features=_S), _B),
            together(feature("AllAxes", features=_S, inputs=True), _B),
            together(feature("AllAxes", features=together(_S, feature("Polynomial", degree=2, states=[1]))), _B),
            together(_S, feature("AllAxes", features=feature("RandomFourier", count=5)), _B),
            together(feature("Friction", states=[1]), feature("AllAxes", features=_S), _B),
        )  # fmt: skip

    def axes(self) -> tuple[str, Recipe]:
        """Return the name and the case of several axes."""
        machine = self.machines()
        name, orders, dt, omega_o, omega_c, most, height, gains, plant = machine
        gain = dict(self.random.choice(gains))
        kind, saturation, bound = self.kinds(), self.saturations(), self.bounds()
        n = len(orders)
        names = ["x", "tool", "lift"][:n]
        shared, axes, words = "all" in kind, {}, [name, kind]
        observed = "current" if shared or "safe" in kind else self.each()
        for i, order in enumerate(orders):
            of = (name, order, 1.0, dt, omega_o, omega_c, most, height, None, None)
            parts: Recipe = {
                "observer": self.observer(of, observed if not shared else "current")[1]
            }
            parts["observer"]["b0"] = 1.0
            if shared:
                parts["observer"]["omega_o"] = omega_o
            if not kind.startswith(("compensators", "drives")):
                parts["omega_c"] = omega_c if shared else self.near(omega_c)
            learns = (
                kind in ("own", "own safe", "compensators learn")
                and i != 1
                and "m = " not in observed
            )
            if learns:
                choice = self.random.choice(
                    [each for each in LEARNERS if not each.startswith(("none", "MLP", "Gaussian"))]
                )
                parts["learner"], parts["guard"] = LEARNERS[choice](order, of), make("Guard")
                parts["omega_c"] = self.near(omega_c)
                words.append(choice)
            if kind.endswith("safe") and i < 2:
                v = 40.0 * height * omega_c**2
                stated = {"gain_error": 0.02, "largest_u": v} if "function" in str(gain) else {}
                parts["safe_set"] = make(
                    "SafeSet",
                    y_min=-0.8 * height,
                    y_max=0.8 * height,
                    rate_min=-2.0 * height * omega_c,
                    rate_max=2.0 * height * omega_c,
                    alpha=3.0 * omega_c,
                    **stated,
                )
            if kind == "held" and i == 0:
                parts["held"] = make("HeldPlant")
            if kind in ("plain", "own") and i == 0 and self.random.random() < 0.5:
                parts["feedforward"] = True
            axes[names[i]] = make(
                "Compensator" if kind.startswith(("compensators", "drives")) else "ADRC", **parts
            )
        if gain.get("B0") == "craft":
            gain["B0"] = _CRAFT
        options: Recipe = {"axes": axes, **gain}
        rate = float(f"{most / (8.0 * dt):.3g}")
        m = (
            len(gain["B0"][0])
            if isinstance(gain.get("B0"), list)
            else 3
            if "wide" in str(gain)
            else n
        )
        options |= {
            "none": {}, "wide": {"u_min": -2.0 * most, "u_max": 2.0 * most},
            "tight": {"u_min": [-0.3 * most] * m, "u_max": [(0.3 + 0.05 * i) * most for i in range(m)]},
            "rate": {"u_max": most, "rate_limit": rate},
            "rates": {"u_min": -most, "u_max": most, "rate_limit": [make("tuple", of=[-0.7 * rate, rate])] + [rate] * (m - 1)},
        }[bound]  # fmt: skip
        if bound != "none" and saturation != "each":
            options["saturation"] = names[::-1] if saturation == "priority" else saturation
        if kind == "drives":
            c = omega_c
            options["drives"] = [
                make("PID", kp=4.0 * c * c, ki=c**3, kd=3.0 * c, tf=0.1 / c, dt=dt),
                make("PPI", kv=c, kp=2.0 * c, tn=2.0 / c, dt=dt),
                make("PID", kp=c, dt=dt),
            ][:n]
        if shared:
            learns = {"all RLS": "RLS", "all NLMS": "NLMS", "all RLS safe": "RLS"}.get(kind)
            options["learner"] = (
                learner("GaussianProcess", features=feature("AllAxes", features=_S), budget=5)
                if learns is None
                else learner(learns, features=self.of_all())
            )
            if learns is None:
                options["learner"] = [options["learner"], *[None] * (n - 1)]
            if self.random.random() < 0.7:
                options["guard"] = make("Guard")
        if kind == "each":
            options["learner"] = [
                learner("RLS", features=self.of_all()),
                *[learner("NLMS", features=self.of_all())] * (n - 1),
            ]
            options["guard"] = make("Guard")
        words += [next(iter(gain)), bound, *([saturation] if "saturation" in options else [])]
        case: Recipe = {"plant": plant, "controller": make("Axes", **options)}
        case["scenario"] = self.scenario_of(n, m, machine, kind)
        if (
            self.precision() == "single"
            and "function" not in str(gain)
            and "mass matrix" not in str(gain)
        ):
            case["precision"] = "single"
            words.append("single")
        return ", ".join(words), case

    def scenario_of(self, n: int, m: int, machine: Any, kind: str) -> Recipe:
        """Return a scenario of 100 to 250 samples."""
        _, _, dt, omega_o, omega_c, most, height, _, _ = machine
        of = ("", 2, 1.0, dt, omega_o, omega_c, most, height, None, None)
        found = self.scenario(of)
        samples = self.random.randrange(100, 220)
        found["duration"] = float(f"{samples * dt:.6g}")
        found.pop("rest_at", None)
        if self.random.random() < 0.3:
            found["rest_at"] = [float(f"{(samples // 2) * dt:.6g}")]
        count = m if kind.startswith("compensators") else n
        size = 0.1 * most if kind.startswith("compensators") else height
        found["reference"] = make(
            "tuple",
            of=[
                self.reference(self.references(), size, samples * dt, omega_c) for _ in range(count)
            ],
        )
        return found

    def state_feedback(self) -> tuple[str, Recipe]:
        """Return the name and the case of a state feedback."""
        flexible: Recipe = {
            "A": [[0, 1, 0, 0], [-5, -0.1, 5, 0.1], [0, 0, 0, 1], [5, 0.1, -5, -0.1]], "B": [[0], [1.5], [0], [0]],
            "C": [[1, 0, 0, 0], [0, 0, 1, 0]], "E": [[0], [0], [0], [1.0]],
        }  # fmt: skip
        kind = self.random.choice(
            [
                "poles",
                "Riccati",
                "Riccati, m = 2",
                "late encoder",
                "two inputs",
                "jitter",
                "current",
            ]
        )
        observer: Recipe = {**flexible, "dt": 0.01}
        usual: Recipe = {"noise_variance": [1e-6, 1e-6], "drift": [1.0]}
        observer |= {
            "poles": {"omega_o": self.near(12.0)}, "Riccati": usual, "Riccati, m = 2": {**usual, "disturbance_order": 2},
            "late encoder": {**usual, "every": [1, self.random.choice([2, 3])]}, "jitter": {**usual, "jitter": [1e-3]},
            "two inputs": {"omega_o": self.near(10.0)}, "current": {**usual, "form": "current"},
        }[kind]  # fmt: skip
        gain: Any = [self.near(each) for each in (2.0, 1.5, 1.0, 0.5)]
        controlled: Any = [[0.0, 0.0, 1.0, 0.0]]
        plant = make("plants.LinearPlant", **flexible)
        if kind == "two inputs":
            two = {"A": [[0, 1, 0, 0], [0, -0.5, 0, 0], [0, 0, 0, 1], [0, 0, 0, -0.5]], "B": [[0, 0], [1, 0.3], [0, 0], [0.2, 1]], "C": [[1, 0, 0, 0], [0, 0, 1, 0]], "E": [[0, 0], [1, 0.3], [0, 0], [0.2, 1]]}  # fmt: skip
            observer |= two
            plant, gain, controlled = (
                make("plants.LinearPlant", **two),
                [[2.0, 2.5, -0.4, -0.6], [-0.4, -0.5, 2.0, 2.4]],
                None,
            )
        limits = self.random.choice(
            [{}, {"u_min": -1.0, "u_max": 1.0}, {"u_max": 0.5, "rate_limit": 60.0}]
        )
        parts: Recipe = {"observer": make("ESO.state_space", **observer), "gain": gain, **limits}
        if controlled:
            parts["controlled"] = controlled
        machine = ("", (), 0.01, 12.0, 1.5, 1.0, 0.3, [], plant)
        scenario = self.scenario_of(2 if kind == "two inputs" else 1, 1, machine, "own")
        return f"state feedback, {kind}, {'free' if not limits else 'limits'}", {
            "plant": plant,
            "controller": make("StateFeedback", **parts),
            "scenario": scenario,
        }

    def long(self) -> tuple[str, Recipe]:
        """Return the name and the case of a loop long enough for learners to be trusted, and not.

        The reference is a sinusoid; late in the run a force comes that has nothing to do with it.
        """
        plant = self.random.choice([each for each in PLANTS if each[0] in _FOR_LONG])
        name, order, b0, dt, _, omega_c, _, height, _, recipe = plant
        learns, kind = self.learners(), self.random.choice(["current", "predictor", "half gain"])
        learns = learns if learns not in (None, "none") else "Kalman"
        guard = self.random.choice([{}, {"time": 0.5}, {"bound": 1.5}])
        observer = self.observer((name, order, 0.8 * b0, *plant[3:8], None, None), kind)[1]
        sine = signal("Sinusoid", amplitude=height, omega=float(f"{2.0 * omega_c:.3g}"))
        samples = self.random.randrange(600, 800)
        late = float(f"{0.7 * samples * dt:.6g}")
        force = signal("PRBS", amplitude=0.2 * plant[6], bits=7, step=4.0 * dt, start=late, seed=5)
        noise = signal(
            "BandLimitedNoise", power=float(f"{1e-8 * height**2 * dt:.3g}"), sample_time=dt
        )
        controller = make("ADRC", observer=observer, omega_c=2.0 * omega_c, learner=LEARNERS[learns](order, plant), guard=make("Guard", **guard), u_max=4.0 * plant[6])  # fmt: skip
        scenario = make("Scenario", reference=sine, duration=float(f"{samples * dt:.6g}"), disturbances=[force], noise=noise, seed=self.random.randrange(1000))  # fmt: skip
        words = f"long, {name}, {kind}, {learns}, guard{''.join(f' {key}' for key in guard)}"
        return words, {"plant": recipe, "controller": controller, "scenario": scenario}

    def long_axes(self) -> tuple[str, Recipe]:
        """Return such a case of two axes, whose learners see their own axis or all."""
        sines = [signal("Sinusoid", amplitude=0.3, omega=omega) for omega in (3.0, 4.0)]
        observer = make("ESO.model_free", order=2, b0=1.0, omega_o=20.0, dt=0.01)
        kind = self.random.choice(["own", "all RLS", "all NLMS", "each"])
        own = {"learner": self.random.choice([learner("Kalman"), learner("RLS"), learner("Harmonic", omegas=[3.0])]), "guard": make("Guard")}  # fmt: skip
        axes = {name: make("ADRC", observer=observer, omega_c=3.0, **(own if kind == "own" else {})) for name in ("x", "tool")}  # fmt: skip
        of_all = learner("NLMS" if "NLMS" in kind else "RLS", features=together(feature("AllAxes", features=_S), _B))  # fmt: skip
        options: Recipe = {} if kind == "own" else {"learner": [of_all, of_all] if kind == "each" else of_all, "guard": make("Guard", time=1.0)}  # fmt: skip
        name, plant = self.random.choice([("springs", _SPRING), ("tanks", _TANKS)])
        controller = make("Axes", axes=axes, B0=_MATRIX2, u_min=-8.0, u_max=8.0, **options)
        force = signal("PRBS", amplitude=0.5, bits=7, step=0.04, start=4.0, seed=5)
        scenario = make("Scenario", reference=make("tuple", of=sines), duration=6.0, disturbances=[force], seed=3)  # fmt: skip
        return f"long, {name}, {kind}", {"plant": plant, "controller": controller, "scenario": scenario}  # fmt: skip


_FOR_LONG = (
    "chain",
    "chain, two forces",
    "lag",
    "third order",
    "pendulum",
    "friction",
    "motor",
    "two masses",
)


# ---- Driven controllers, and the files ----


def events(draw: random.Random, samples: int, in_c: bool, kind: str) -> list[list[Any]]:
    """Return events of a driven controller: sample, name and argument."""
    found: list[list[Any]] = [[k, "applied", 0.6] for k in draw.sample(range(20, 60), 3)]
    begin = draw.randrange(70, 90)
    if draw.random() < 0.7:
        found += [[begin, "manual", None], [begin + 15, "hand_over", None]]
    if draw.random() < 0.5:
        found.append([begin + 40, "start", None])
    if draw.random() < 0.5:
        found.append([samples - 60, "reset", None])
    if "held" in kind or draw.random() < 0.1:
        found += [[begin + 25, "held", True], [begin + 35, "held", False]]
    if "external" in kind and not in_c:
        found += [[k, "signals", [0.01 * k - 0.5]] for k in range(5, samples, 40)]
    if not in_c:
        more = [[samples - 40, "memory", draw.random() < 0.5], [samples - 30, "forget", None]]
        found += [each for each in more if draw.random() < 0.6]
    return sorted(found, key=lambda each: int(each[0]))


def drawn(
    seed: int, counts: Sequence[tuple[str, int]], driven: bool, in_c: int = 0
) -> list[Recipe]:
    """Return cases that quell takes, of each way as many as ``counts`` say."""
    from .loops import drive_case, simulate_case

    draw, cases = DrawAxes(seed), []
    for way, count in counts:
        number = 0
        while number < count:
            name, case = getattr(draw, way)()
            if driven:
                scale = 0.3 if way in ("axes", "state_feedback") else 0.6
                scale = 0.1 if "'dt': 0.001" in str(case["controller"]) else scale
                kept = {key: case[key] for key in ("controller", "precision") if key in case}
                samples = draw.random.randrange(180, 240)
                case = {**kept, "samples": samples, "seed": len(cases) + 1, "scale": scale}
                for_c = number < in_c * count // 100
                case["events"] = events(draw.random, samples, for_c, name)
                case["c"] = for_c
            try:
                outcome = (drive_case if driven else simulate_case)(case)
            except (ValueError, TypeError, AttributeError) as error:
                print(f"{name}: {str(error)[:110]}")
                continue
            if any(isinstance(v, str) for v in outcome["numbers"].get("u", ())):
                continue
            number += 1
            cases.append({"name": f"{len(cases) + 1:03d} {name}", **case})
    return cases


def main() -> None:
    """Write the cases of the parts ``loops`` and ``driven``, without results."""
    from quell.kernels import dispatch

    from .corpus import write

    dispatch.interpret_all = True
    ways = [
        ("one", 170),
        ("other", 50),
        ("axes", 65),
        ("state_feedback", 15),
        ("long", 16),
        ("long_axes", 6),
    ]
    write("loops", {"written": [], "cases": drawn(20261128, ways, driven=False)})
    ways = [("one", 48), ("other", 14), ("axes", 22), ("state_feedback", 6)]
    write("driven", {"written": [], "cases": drawn(1128, ways, driven=True, in_c=70)})


if __name__ == "__main__":
    main()
