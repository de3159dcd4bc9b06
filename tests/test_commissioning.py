"""From a rig to a tuned controller: the experiment keeps its limits, its record shows the plant, the step is as predicted."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.cli.options import ModelOptions, ReadOptions
from quell.cli.tune import Asked, identified
from quell.commissioning import Experiment, Limits, experiment, verify
from quell.identification import Measured, decided, excitation, identify
from quell.kernels import dispatch
from quell.plants import LinearPlant
from quell.realtime import TwinDevice, open_device, run
from quell.realtime.registry import listen
from quell.realtime.rig import Rig
from quell.realtime.system import virtual_clock
from quell.tuning.plants import identified_plants

from .commands import Shown
from .test_identification import answer

pytestmark = pytest.mark.compiled

DT = 0.01
PLANT = LinearPlant.of(([1.0], [1.0, 20.0]))
# A machine that is busy with other things may make the loop as late as it likes.
PATIENT = {"settle": 5, "hold": 10_000, "most_overruns": 10_000, "ramp": 10}


@contextmanager
def as_python(on_virtual_clock: bool) -> Iterator[None]:
    """Run loops as plain Python, which no test here is about, on a clock that need not wait for a twin."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dispatch, "interpret_all", True)
        if on_virtual_clock:
            patch.setattr(run, "system_clock", lambda spin: virtual_clock())
        yield


@cache
def at_twin(den: tuple[float, ...], b: float) -> tuple[Any, Experiment]:
    """Return a twin and the record of an experiment at it."""
    twin = TwinDevice(LinearPlant.of(([b], den)), DT)
    limits = Limits(-2.0, 2.0, -1.0, 1.0, 3.0)
    with as_python(on_virtual_clock=True):
        return twin, experiment(lambda: twin, DT, limits, priority=0)


@pytest.mark.parametrize(
    ("den", "b", "kind"),
    [((1.0, 20.0), -8.0, "prbs"), ((1.0, 3.0, 0.0), 6.0, "relay")],
)
def test_an_experiment_keeps_its_limits_and_shows_the_plant(
    den: tuple[float, ...], b: float, kind: str
) -> None:
    """A lag of negative gain gets a PRBS, a drifting plant a relay; y stays within, and the model is the plant."""
    _, done = at_twin(den, b)
    assert done.kind == kind
    assert done.sign == np.sign(b)
    u, y = done.measured.u, done.measured.y
    assert np.max(np.abs(y)) < 1.0
    assert np.max(np.abs(u)) <= 2.0
    found = identify(u, y, DT, order=len(den) - 1, held_out=0.0)
    assert found.num[0] == pytest.approx(b, rel=0.02)
    assert found.den == pytest.approx(den, rel=0.05, abs=0.05)


def test_an_experiment_at_a_rig_over_udp_shows_the_plant() -> None:
    """A session for each part, and a plant that stays where the last one left it."""
    with (
        as_python(on_virtual_clock=False),
        closing(listen("udp://127.0.0.1:0")) as listener,
        Rig(PLANT, DT, listener=listener, rest=False, wait=0.02) as rig,
    ):
        rig.prepare()
        ticking = threading.Thread(target=rig.run, kwargs={"priority": 0})
        ticking.start()
        try:
            limits = Limits(-2.0, 2.0, -1.0, 1.0, 0.8)
            how: dict[str, Any] = {"safety": PATIENT, "priority": 0}
            done = experiment(lambda: open_device(listener.url, DT), DT, limits, **how)
        finally:
            rig.stop()
            ticking.join()
    found = identify(done.measured.u, done.measured.y, DT, order=1, held_out=0.0, delay=(0.0, DT))
    assert found.num[0] == pytest.approx(1.0, rel=0.05)
    assert found.den == pytest.approx((1.0, 20.0), rel=0.05)


def test_an_experiment_without_effect_or_room_is_refused() -> None:
    """U that does not act, and y outside of its limits: one line each, and nothing is identified."""
    twin = TwinDevice(LinearPlant.of(([1e-9], [1.0, 8.0])), DT)
    limits = Limits(-2.0, 2.0, -1.0, 1.0, 1.0)
    with (
        as_python(on_virtual_clock=True),
        pytest.raises(ValueError, match=r"y moved by .* u does not act"),
    ):
        experiment(lambda: twin, DT, limits, priority=0)
    for change, message in (
        ({"u_min": 1.0}, "must have zero, the safe u"),
        ({"y_min": 3.0}, "y_min"),
        ({"duration": 0.0}, "duration = 0.0"),
        ({"u_rest": 5.0}, "u_rest = 5.0: must be between"),
    ):
        given: dict[str, float] = {"u_min": -2.0, "u_max": 2.0, "y_min": -1.0, "y_max": 1.0}
        with pytest.raises(ValueError, match=message):
            Limits(**(given | {"duration": 1.0} | change))


def test_a_fault_ends_the_experiment() -> None:
    """A sensor that fails in the probe: nothing more is applied after the ramp, and the error says what it was."""

    class Failing:
        """A twin whose measurements end after some samples."""

        def __init__(self) -> None:
            self.twin, self.left, self.closed = TwinDevice(PLANT, DT), 60, 0

        def read(self) -> float:
            self.left -= 1
            return self.twin.read() if self.left > 0 else float("nan")

        def write(self, u: float) -> None:
            self.twin.write(u)

        def close(self) -> None:
            self.closed += 1

    device = Failing()
    limits = Limits(-2.0, 2.0, -1.0, 1.0, 5.0)
    with (
        as_python(on_virtual_clock=True),
        pytest.raises(ValueError, match="the experiment was stopped: .*RAMP"),
    ):
        experiment(lambda: device, DT, limits, safety={"settle": 5, "hold": 3}, priority=0)
    assert device.closed <= 4  # run_rig closes it twice: two parts of three, at most


def test_the_verifying_step_is_as_predicted() -> None:
    """A tuned loop at the twin of the identified plant: prediction and measurement agree."""
    twin, done = at_twin((1.0, 20.0), -8.0)
    model = identify(done.measured.u, done.measured.y, DT, order=1, held_out=0.0)
    observer = ql.ESO.model_free(1, float(model.num[0]), omega_o=20.0, dt=DT)
    controller = ql.ADRC(observer, omega_c=5.0, u_min=-2.0, u_max=2.0)
    limits = Limits(-2.0, 2.0, -1.0, 1.0, 2.0)
    with as_python(on_virtual_clock=True):
        step = verify(lambda: twin, controller, model, limits, done.y_rest, 2.0, priority=0)
    assert step.run.completed
    assert step.height > 0.0
    assert "fit of the prediction" in step.describe()
    assert step.fit > 85.0
    assert [axis.get_ylabel()[:2] for axis in step.plot()] == ["y\n", "u\n"]


def test_the_deviations_of_a_model_are_plants_around_it() -> None:
    """The points are on the 95 % ellipsoid of a, b and delay, in pairs, as far out as it is in each of them; a pole at s = 0 stays there."""
    rng = np.random.default_rng(0)
    u = excitation("prbs", (0.5, 10.0), 20.0, 0.02).u
    y = answer(([5.0], [1.0, 0.8, 0.0]), u, 0.02) + 0.02 * rng.standard_normal(u.size)
    found = ql.identify(u, y, 0.02, order=2, delay=(0.0, 0.1))
    plants, delays = identified_plants(found)
    assert len(plants) == 9
    assert delays[0] == 0.0
    assert max(delays) >= 0.01
    assert all(den[-1] == 0.0 and den[0] == 1.0 for _, den in plants)
    spread = np.sqrt(np.diag(found.covariance))
    b = np.array([num[0] for num, _ in plants])
    radius = np.sqrt(7.815)  # χ² of three degrees of freedom at 95 %
    assert np.max(np.abs(b - b[0])) == pytest.approx(radius * spread[-1], rel=1e-3)
    assert np.mean(b[1:]) == pytest.approx(b[0], rel=1e-9)
    a = np.array([den[1] for _, den in plants])
    assert np.max(np.abs(a - a[0])) == pytest.approx(radius * spread[0], rel=1e-3)
    quiet = ql.identify(
        u, 1e-3 * y + rng.standard_normal(u.size), 0.02, order=1, delay=0.0, held_out=0.0
    )
    with pytest.raises(ValueError, match="does not decide the sign of the gain"):
        identified_plants(quiet)


@pytest.mark.trial
def test_a_record_is_identified_and_tuned(
    quell: Callable[..., Shown], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``quell tune record.csv``: model, tuned controller, and a setup that ``quell run`` accepts.

    Without the structures that it is compared with, which take ten times as long.
    """
    monkeypatch.setattr(ql.tuning, "tune", partial(ql.tune, compare=()))
    rng = np.random.default_rng(0)
    u = excitation("prbs", (0.5, 20.0), 10.0, 0.02).u
    y = answer(([5.0], [1.0, 3.0]), u, 0.02) + 0.01 * rng.standard_normal(u.size)
    table = np.column_stack([np.arange(u.size) * 0.02, u, y])
    np.savetxt(tmp_path / "data.csv", table, delimiter=",", header="t,u,y", comments="")
    options = ("--structure", "pi", "--max-delay", "0", "--model-order", "1", "--no-figures")
    shown = quell("tune", "data.csv", *options, "--out", "tuned.toml", "--json", "out.json")
    assert shown.code == 0, shown.err
    told = json.loads((tmp_path / "out.json").read_text())
    assert told["model"]["den"] == pytest.approx([1.0, 3.0], rel=0.05)
    assert told["plants"] == 7  # the model, and two for each of pole, b and gain
    assert ql.setup.load(tmp_path / "tuned.toml").controller.dt == pytest.approx(0.02)
    refused = quell("tune", "--device", "twin:two-mass", "--u-max", "1")
    assert refused.code == 2
    assert "an experiment also needs --u-min, --y-min, --y-max, --dt" in refused.err
    limits = ("--u-min=-1", "--u-max=1", "--y-min=-1", "--y-max=1", "--dt", "0.01")
    refused = quell("tune", "--device", "twin:two-mass", *limits)
    assert refused.code == 2
    assert "there is no terminal to ask at; give --yes" in refused.err


def test_a_faulty_model_is_not_tuned_for() -> None:
    """A record of a plant that runs away: the report says why there is nothing to tune."""
    from rich.console import Console

    u = excitation("prbs", (0.5, 20.0), 10.0, 0.02).u
    y = answer(([5.0], [1.0, -0.5]), u, 0.02)
    with pytest.raises(ValueError, match="no plant to tune for: .* is unstable"):
        identified(
            Console(quiet=True),
            Measured(u, y, 0.02, None),
            Asked(None, ReadOptions(), ModelOptions(max_delay=0.0), 1),
        )
    assert decided(identify(u, y, 0.02, order=1)).shortcomings
