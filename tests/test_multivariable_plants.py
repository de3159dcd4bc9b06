"""Plants with several inputs and outputs: exact where they can be, and equal to other programs."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

import quell as ql
from quell.kernels import user_functions
from quell.plants.base import advance, measure, measure_all
from quell.plants.nonlinear import derivatives

from .cases import cases


def moved(plant, x, u, w, dt: float, samples: int = 1):  # type: ignore[no-untyped-def]
    """Return state and outputs after some samples under constant signals."""
    model = plant.sampled(dt, interpret=True)
    x = np.array(x, dtype=float)
    y, scratch = np.zeros(plant.outputs), np.zeros(6 * x.size)
    for _ in range(samples):
        advance(model, x, scratch, 0.0, np.array(u, dtype=float), np.array(w, dtype=float))
    measure_all(model, x, y)
    return x, y


@cases("seed", range(5))
def test_linear_plant_is_the_matrix_exponential(seed: int) -> None:
    """x(dt) follows from exp of the plant with its held inputs."""
    rng = np.random.default_rng(seed)
    n, m, p, q = 4, 2, 3, 1
    A, B = rng.standard_normal((n, n)), rng.standard_normal((n, m))
    C, E = rng.standard_normal((p, n)), rng.standard_normal((n, q))
    plant = ql.plants.LinearPlant(A, B, C, E)
    x0, u, w = rng.standard_normal(n), rng.standard_normal(m), rng.standard_normal(q)
    whole = np.zeros((n + m + q, n + m + q))
    whole[:n] = np.hstack([A, B, E])
    x = (expm(0.1 * whole) @ np.concatenate([x0, u, w]))[:n]
    found, y = moved(plant, x0, u, w, 0.1)
    np.testing.assert_allclose(found, x, atol=1e-12)
    np.testing.assert_allclose(y, C @ x, atol=1e-12)


def test_nonlinear_plant_with_the_same_equations_is_the_linear_one() -> None:
    """Runge-Kutta over small steps comes to the exact sample, with parameters as well."""

    def f(t, x, u, w, a):  # type: ignore[no-untyped-def]
        return x[1], -a * x[0] + u[0] + 0.5 * u[1] + w[0]

    nonlinear = ql.plants.NonlinearPlant(
        f, order=2, inputs=2, output=np.eye(2), substeps=20, parameters={"a": 4.0}
    )
    linear = ql.plants.LinearPlant([[0, 1], [-4, 0]], [[0, 0], [1, 0.5]], np.eye(2), [[0], [1]])
    arguments = ([0.3, -0.2], [1.0, -0.4], [0.2], 0.05)
    np.testing.assert_allclose(
        moved(nonlinear, *arguments)[0], moved(linear, *arguments)[0], atol=1e-9
    )
    other = nonlinear.with_parameters(a=1.0)
    assert abs(moved(other, *arguments)[0] - moved(linear, *arguments)[0]).max() > 1e-4


@pytest.mark.parametrize("force", [0.0, 1.0])
def test_sub_steps_are_chosen_as_for_one_input(force: float) -> None:
    """A jump of f is resolved by no number of sub-steps; a stiff plant is warned of."""

    def single(t, x, u, w):  # type: ignore[no-untyped-def]
        return x[1], u - 1e4 * x[1] - force * np.sign(x[1])

    def several(t, x, u, w):  # type: ignore[no-untyped-def]
        return x[1], u - 1e4 * x[1] - force * np.sign(x[1])

    for dt in (1e-3, 1.0):
        plants = (
            ql.plants.NonlinearPlant(single, 2),
            ql.plants.NonlinearPlant(several, 2, np.eye(2)),
        )
        if force == 0.0 and dt == 1.0:
            for plant in plants:
                with pytest.warns(ql.DesignWarning, match="stiff, it has an eigenvalue of 1e.04"):
                    assert plant.sampled(dt, interpret=True).substeps == 1000
            continue
        one, other = (plant.sampled(dt, interpret=True).substeps for plant in plants)
        assert one == other == (1 if force else 10)


class TestArm:
    """The planar arm."""

    def test_two_rods_have_the_known_mass_matrix(self) -> None:
        """M of two slender rods (Spong, Hutchinson & Vidyasagar, section 7.3)."""
        l1, l2, m1, m2, elbow = 0.5, 0.3, 2.0, 0.7, 0.8
        arm = ql.plants.arm((l1, l2), (m1, m2), payload=0.2)
        load, c = 0.2, np.cos(elbow)
        a1 = m1 * l1**2 / 3 + m2 * (l1**2 + l2**2 / 3) + load * (l1**2 + l2**2)
        a2, a3 = (m2 / 2 + load) * l1 * l2, m2 * l2**2 / 3 + load * l2**2
        M = [[a1 + 2 * a2 * c, a3 + a2 * c], [a3 + a2 * c, a3]]
        np.testing.assert_allclose(arm.mass_matrix([0.4, elbow]), M, rtol=1e-12)

    @pytest.mark.trial
    def test_energy_stays_without_friction(self) -> None:
        """A swinging arm of three links with an elastic joint keeps its energy."""
        k = 300.0
        arm = ql.plants.arm(
            (0.4, 0.3, 0.2), (2.0, 1.0, 0.5), motor_inertia=(0.0, 0.05, 0.0),
            stiffness=(np.inf, k, np.inf), substeps=10,
        )  # fmt: skip

        def energy(x):  # type: ignore[no-untyped-def]
            q, rate = x[:3], x[3:6]
            M = arm.mass_matrix(q).copy()
            M[1, 1] -= 0.05  # the motor of the elastic joint moves by itself
            theta = np.cumsum(q)
            masses, lengths = np.array([2.0, 1.0, 0.5]), np.array([0.4, 0.3, 0.2])
            ends = np.cumsum(lengths * np.sin(theta))
            heights = np.append(0.0, ends[:-1]) + 0.5 * lengths * np.sin(theta)
            spring = 0.5 * k * (x[6] - x[1]) ** 2
            return 0.5 * rate @ M @ rate + 0.025 * x[7] ** 2 + 9.81 * masses @ heights + spring

        x0 = np.array([0.3, 0.5, -0.4, 0.0, 1.0, 0.0, 0.5, 0.0])
        x, _ = moved(arm, x0, np.zeros(3), np.zeros(3), 1e-3, samples=1000)
        assert np.linalg.norm(x - x0) > 1.0
        assert energy(x) == pytest.approx(energy(x0), abs=1e-6)

    @pytest.mark.trial
    def test_moves_as_in_mujoco(self) -> None:
        """A second under gravity, with friction and motors, as another program solves it."""
        mujoco = pytest.importorskip("mujoco")
        rods = [(2.0, 0.4), (1.0, 0.3), (0.5, 0.2)]
        body = ""
        for i, (mass, length) in enumerate(rods):
            about = mass * length**2 / 12.0
            at = rods[i - 1][1] if i else 0.0
            body += (
                f'<body pos="{at} 0 0"><joint type="hinge" axis="0 -1 0" armature="{0.01 * i}" '
                f'damping="{0.1 * (i == 0)}"/><inertial pos="{length / 2} 0 0" mass="{mass}" '
                f'diaginertia="{about} {about} {about}"/>'
            )
        xml = (
            '<mujoco><option gravity="0 0 -9.81" timestep="0.0005" integrator="RK4"/><worldbody>'
            f"{body}{'</body>' * 3}</worldbody></mujoco>"
        )
        model = mujoco.MjModel.from_xml_string(xml)
        data = mujoco.MjData(model)
        start = np.array([0.3, 0.4, -0.2, 0.5, -1.0, 0.7])
        data.qpos[:], data.qvel[:] = start[:3], start[3:]
        torque = np.array([1.0, -0.5, 0.2])
        for _ in range(2000):
            data.qfrc_applied[:] = torque
            mujoco.mj_step(model, data)
        arm = ql.plants.arm(
            [each[1] for each in rods], [each[0] for each in rods],
            motor_inertia=(0.0, 0.01, 0.02), viscous=(0.1, 0.0, 0.0), substeps=1,
        )  # fmt: skip
        x, y = moved(arm, start, torque, np.zeros(3), 5e-4, samples=2000)
        np.testing.assert_allclose(x, [*data.qpos, *data.qvel], atol=1e-6)
        np.testing.assert_allclose(y, data.qpos, atol=1e-6)

    def test_encoders_are_at_motors_links_or_both(self) -> None:
        """An elastic joint has two angles, a rigid one a single."""
        kw = {"motor_inertia": 0.1, "stiffness": (np.inf, 500.0)}
        x = np.array([0.1, 0.2, 0.0, 0.0, 0.25, 0.0])
        for encoders, expected in (
            ("motor", [0.1, 0.25]), ("link", [0.1, 0.2]), ("both", [0.1, 0.25, 0.1, 0.2])
        ):  # fmt: skip
            arm = ql.plants.arm(encoders=encoders, **kw)  # type: ignore[arg-type]
            y = np.zeros(arm.outputs)
            measure_all(arm.sampled(1e-3, interpret=True), x, y)
            assert y.tolist() == expected


def test_quadrotor_turns_as_its_rotors_push() -> None:
    """Torques over inertias are the accelerations, and a spin couples the axes."""
    craft = ql.plants.quadrotor_attitude()
    thrusts = np.array([2.0, 2.5, 3.0, 2.2])
    torque = ql.plants.rotor_levers(0.17, 0.015) @ thrusts
    rate = craft.sampled(1e-3, interpret=True).rate
    dx = rate(0.0, np.array([0.0] * 6 + [*thrusts]), thrusts, np.zeros(3))
    np.testing.assert_allclose(dx[3:6], torque / [0.012, 0.012, 0.022], rtol=1e-12)
    spinning = np.array([0.0, 0.0, 0.0, 1.0, 2.0, 3.0] + [0.0] * 4)
    dx = rate(0.0, spinning, np.zeros(4), np.zeros(3))
    rates, inertia = spinning[3:6], np.array([0.012, 0.012, 0.022])
    np.testing.assert_allclose(dx[3:6], -np.cross(rates, inertia * rates) / inertia, rtol=1e-12)


class TestChannels:
    """Encoders and delays of single channels."""

    def integrators(self) -> ql.plants.LinearPlant:
        """Return two integrators."""
        return ql.plants.LinearPlant(np.zeros((2, 2)), np.eye(2), np.eye(2))

    def test_each_input_is_late_by_its_own_samples(self) -> None:
        """An integrator shows u a sample after it arrives."""
        plant = ql.plants.delayed_inputs(self.integrators(), [0.0, 0.03], dt=0.01)
        model = plant.sampled(0.01, interpret=True)
        x, y, scratch = np.zeros(plant.order), np.zeros(2), np.zeros(6 * plant.order)
        found = []
        for k in range(6):
            u = np.array([1.0, 1.0]) if k == 0 else np.zeros(2)
            advance(model, x, scratch, 0.0, u, np.zeros(2))
            measure_all(model, x, y)
            found.append(y.copy())
        steps = np.diff(found, axis=0, prepend=0.0) / 0.01
        assert np.argmax(steps[:, 0]) == 0
        assert np.argmax(steps[:, 1]) == 3
        np.testing.assert_allclose(np.sum(steps, axis=0), [1.0, 1.0])

    def test_encoders_quantize_their_output(self) -> None:
        """A resolution of zero leaves an output as it is."""
        plant = ql.plants.encoded_outputs(self.integrators(), [0.1, 0.0])
        _, y = moved(plant, [0.26, 0.26], [0.0, 0.0], [0.0, 0.0], 0.01)
        assert y.tolist() == pytest.approx([0.3, 0.26])

    def test_a_run_with_both_is_compiled(self) -> None:
        """Delays and encoders run in ``simulate``."""

        def axis() -> ql.ADRC:
            return ql.ADRC(ql.ESO.model_free(1, 1.0, 20.0, 0.01), 3.0)

        late = ql.plants.delayed_inputs(self.integrators(), [0.01, 0.02], dt=0.01)
        plant = ql.plants.encoded_outputs(late, 1e-3)
        run = ql.simulate(plant, ql.Axes([axis(), axis()]), ql.Scenario((1.0, 0.5), duration=3.0))
        assert run.status == ql.Status.OK
        np.testing.assert_allclose(run["y"][-1], [1.0, 0.5], atol=1.5e-3)


@cases(
    ("wrong", "message"),
    [
        (lambda: ql.plants.LinearPlant(np.eye(2), np.eye(3), np.eye(2)),
         r"B has shape \(3, 3\), A \(2, 2\): must be a matrix of shape \(2, 3\), a row for each"),
        (lambda: ql.plants.LinearPlant.of(3), "plant = 3: must be a linear plant"),
        (lambda: ql.plants.NonlinearPlant(lambda t, x, u, w: [1.0], 2, np.eye(2)),
         r"f returns shape \(1,\): must return the 2 derivatives"),
        (lambda: ql.plants.NonlinearPlant(
            lambda t, x, u, w: [1.0, x[3]], 2, np.eye(2)), "fails with IndexError"),
        (lambda: ql.plants.arm((0.4, 0.3), (1.0,)), "masses"),
        (lambda: ql.plants.arm(stiffness=100.0), "an elastic joint needs a stiffness and a motor"),
        (lambda: ql.plants.arm(encoders="tool"), "encoders = 'tool'"),
        (lambda: ql.plants.arm(stiffness="soft"), "stiffness = 'soft': must be one number, or one"),
        (lambda: ql.plants.quadrotor_attitude((0.1, 0.1)), "inertia has shape"),
        (lambda: ql.plants.encoded_outputs(ql.plants.arm(), -1.0), "must not be negative"),
        (lambda: ql.plants.delayed(ql.plants.arm(), 0.1, 0.01), "several: .*delayed_inputs"),
        (lambda: ql.plants.encoded(ql.plants.arm(), 1024), "several: .*encoded_outputs"),
        (lambda: ql.tune(ql.plants.arm(), 0.01),
         "2 control signals and 2 outputs, here there is one of each"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_named(wrong, message: str) -> None:  # type: ignore[no-untyped-def]
    """Errors name both shapes and the rule."""
    with pytest.raises(ValueError, match=message):
        wrong()


def drawn_arm(rng: np.random.Generator) -> ql.plants.Arm:
    """Return an arm of two links with other numbers of every kind."""
    return ql.plants.arm(
        rng.uniform(0.2, 0.5, 2), rng.uniform(0.5, 3.0, 2), viscous=rng.uniform(0.0, 0.2, 2),
        coulomb=rng.uniform(0.0, 0.3, 2), motor_inertia=rng.uniform(2e-4, 0.05, 2),
        gravity=rng.uniform(0.0, 9.81), payload=rng.uniform(0.0, 0.5), substeps=2,
    )  # fmt: skip


def joint() -> ql.ADRC:
    """Return the controller of a joint."""
    return ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=1e-3), omega_c=8.0)


@pytest.mark.trial
@pytest.mark.compiled
def test_a_hundred_drawn_arms_compile_once(compiled_functions: list[Any]) -> None:
    """Their equation and their M(q) are the same code with other numbers; each computes its own values."""
    rng, addresses = np.random.default_rng(3), set()
    for i in range(100):
        arm = drawn_arm(rng)
        model, gain = arm.sampled(1e-3), ql.Axes([joint(), joint()], M=arm.inertia).parameters.gain
        addresses.add((model.rate, model.output, gain.address))
        if i % 10:
            continue
        x, u, w = rng.standard_normal(4), rng.standard_normal(2), rng.standard_normal(2)
        found, fresh = np.zeros(4), np.zeros((2, 2))
        derivatives(model, 0.0, x, u, w, found)
        np.testing.assert_array_equal(found, arm._rate(0.0, x, u, w))
        user_functions.call(gain.address, x.reshape(2, 2), gain.numbers, fresh)
        np.testing.assert_array_equal(fresh, arm.inertia(x.reshape(2, 2)))
    assert len(addresses) == 1
    assert len(compiled_functions) <= 3


def rates(t, x, u, w, gain, K, offsets=(0.5, 0.25)):  # type: ignore[no-untyped-def]
    """Return the equation of a plant with a number, a matrix and a vector."""
    return K[0, 1] * x[1] + offsets[0] * w[0], gain * u - K[1, 0] * x[0] + K[1, 1] * offsets[1]


def combined(x, H, gain):  # type: ignore[no-untyped-def]
    """Return an output that shares a parameter with the equation."""
    return H[0, 0] * x[0] + H[0, 1] * x[1], gain * x[1]


@pytest.mark.trial
@pytest.mark.compiled
def test_parameters_are_numbers_vectors_and_matrices() -> None:
    """Compiled code reads them in their order, and other numbers compile nothing; a default is data, too."""
    K = [[0.0, 3.0], [5.0, 7.0]]
    several = ql.plants.NonlinearPlant(
        rates, 2, combined, parameters={"gain": 2.0, "K": K, "H": [[1.5, -0.5]]}
    )
    one = ql.plants.NonlinearPlant(
        lambda t, x, u, w, K, c: (K[0, 1] * x[1], c[1] * u - K[1, 0] * x[0] + c[0]), 2,
        lambda x, row: row[0] * x[0] + row[1] * x[1],
        parameters={"K": K, "c": [0.1, 2.0], "row": (0.5, 2.0)},
    )  # fmt: skip
    for plant, u in ((several, np.array([0.7])), (one, 0.7)):
        changed = plant.with_parameters(K=[[0.0, 1.0], [2.0, -1.0]])
        addresses = {each.sampled(0.01).rate for each in (plant, changed)}
        assert len(addresses) == 1
        for each in (plant, changed):
            values = []
            for model in (each.sampled(0.01), each.sampled(0.01, interpret=True)):
                dx, y = np.zeros(2), np.zeros(2)
                derivatives(model, 0.0, np.array([0.3, -0.2]), u, np.array([0.3]), dx)
                if plant is one:
                    y[0] = measure(model, np.array([0.3, -0.2]))
                else:
                    measure_all(model, np.array([0.3, -0.2]), y)
                values.append([*dx, *y])
            np.testing.assert_array_equal(*values)
            assert np.all(np.array(values[0][:3]) != 0.0)


@cases(
    ("wrong", "message"),
    [
        (lambda p: ql.plants.NonlinearPlant(rates, 2, np.eye(2), parameters=p),
         r"parameters\['K'\]: entry \(0, 0\) is nan"),
        (lambda p: ql.Axes([joint(), joint()], M=partial(gain, K=p["K"])), r"M: K: entry \(0, 0\)"),
        (lambda p: ql.Axes([joint(), joint()], M=partial(gain, k=1.0)),
         r"M: partial\(…\) binds k, which is no parameter; must be one of K"),
        (lambda p: ql.Axes([joint(), joint()], B0=partial(gain, np.zeros((2, 2)))),
         r"B0: partial\(…\) binds 1 values without a name"),
        (lambda p: ql.Axes([joint(), joint()], B0=partial(gain, K=np.ones((2, 2, 1)))),
         r"B0: K has shape \(2, 2, 1\): must be a number, or an array with one or two dim"),
        (lambda p: ql.Axes([joint(), joint()], B0=partial(gain, K="stiff")), "B0: K = 'stiff': must"),
        (lambda p: ql.Axes([joint(), joint()], B0=partial(two_of, K=1.0)), "B0: parameter d has no"),
    ],
)  # fmt: skip
def test_parameters_that_do_not_fit_are_named(wrong: Any, message: str) -> None:
    """By argument, name, value and rule."""
    with pytest.raises(ValueError, match=message):
        wrong({"gain": 1.0, "K": [[np.nan, 1.0], [1.0, 1.0]]})


def gain(x, K):  # type: ignore[no-untyped-def]
    """Return a matrix that depends on parameters."""
    return np.eye(2) + np.sum(K)


def two_of(x, K, d):  # type: ignore[no-untyped-def]
    """Return a matrix that depends on two parameters."""
    return np.eye(2) + K * d
