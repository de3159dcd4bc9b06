"""The real-time loop of three axes beside that of one: step times, and honest first motions.

    python benchmarks/rig_axes.py                         # 10 s of each, in this process
    python benchmarks/rig_axes.py --udp                   # with the rig in a process of its own
    python benchmarks/rig_axes.py --loops 300 --seed 1    # how often the check of signs is wrong

The three axes are like the one: order 2, ``Kalman`` with a guard, 1 kHz. Runs take turns, so that
what else the machine does meets all of them. With ``--udp`` the rig ticks in its own process, and a
frame has three measurements and three control signals in the place of one.

The loops of ``--loops`` are random machines of two and three axes whose B0 is known up to 30 %,
with friction and with loads of up to 0.9 of the limits: none of the honest ones may be ended by the
check of the first motion. The same machines with one encoder turned round are the wrong ones.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from measured import options_of, parser_of, write

import quell as ql
from quell.kernels import dispatch
from quell.realtime import RigRun, Safety, TwinDevice, open_device, run_rig
from quell.realtime.cycle import ControlLoop
from quell.realtime.recordings import row_channels
from quell.realtime.run import mode_changes
from quell.realtime.safety import reference_samples
from quell.realtime.supervisor import Cause, Mode
from quell.realtime.system import virtual_clock
from quell.realtime.telemetry import ring

DT = 1e-3
# A machine whose processors are taken away for tenths of a second must not end the run.
HOLD = 250
GAIN = np.array([[2.0, 0.3, 0.1], [0.2, 3.0, 0.4], [0.1, 0.2, 1.5]])


def axis(b0: float = 1.0, **limits: Any) -> ql.ADRC:
    """Return the controller of an axis."""
    observer = ql.ESO.model_free(order=2, b0=b0, omega_o=60.0, dt=DT)
    learner = ql.learners.Kalman()
    return ql.ADRC(observer, omega_c=8.0, learner=learner, guard=ql.Guard(), **limits)


def machine(gain: Any, damping: Any = 0.5) -> Any:
    """Return ``y'' = gain u − damping y'``."""
    n, m = gain.shape
    A, B, C = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, m)), np.zeros((n, 2 * n))
    A[:n, n:], A[n:, n:], B[n:], C[:, :n] = np.eye(n), -damping * np.eye(n), gain, np.eye(n)
    return ql.plants.LinearPlant(A, B, C)


def loops() -> dict[str, tuple[Any, Any, Any]]:
    """Return plant, controller and reference by name."""
    one = ql.plants.LinearPlant([[0.0, 1.0], [0.0, -0.5]], [0.0, 2.0], [1.0, 0.0])
    three = ql.Axes([axis() for _ in range(3)], GAIN, u_min=-20.0, u_max=20.0)
    reference = ql.signals.Sinusoid(0.5, 2.0)
    return {
        "one": (one, axis(2.0, u_min=-20.0, u_max=20.0), reference),
        "three": (machine(GAIN), three, (reference,) * 3),
    }


@contextlib.contextmanager
def served(name: str) -> Iterator[str]:
    """Start ``quell rig`` in its own process; yield its URL."""
    size = 3 if name == "three" else 1
    gain = GAIN if size == 3 else np.array([[2.0]])
    plant: Any = machine(gain)
    table = f"A = {plant.A.tolist()}, B = {plant.B.tolist()}, C = {plant.C.tolist()}"
    text = f'kind = "linear", {table}'
    if size == 1:
        text = 'kind = "linear", num = [2.0], den = [1.0, 0.5, 0.0]'
    with TemporaryDirectory() as folder:
        file = Path(folder) / "plant.toml"
        file.write_text(f"dt = {DT}\nplant = {{ {text} }}\n", encoding="utf-8")
        command = ("rig", "--plant", str(file), "--dt", str(DT), "--device", "udp://127.0.0.1:0")
        process = subprocess.Popen(
            [sys.executable, "-m", "quell", *command, "--watchdog", str(2 * HOLD)],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        try:
            line = process.stdout.readline()
            yield line.partition(" at ")[2].split(": a tick")[0].split(", with")[0]
        finally:
            process.terminate()
            process.wait()


def opened(url: str, counts: Any) -> Any:
    """Open the device; a rig on a busy machine may take seconds until it ticks."""
    for _ in range(10):
        with contextlib.suppress(ConnectionError):
            return open_device(url, DT, signals=counts)
    return open_device(url, DT, signals=counts)


def timed(name: str, seconds: float, udp: bool) -> RigRun:
    """Run a loop."""
    plant, controller, reference = loops()[name]
    safety = Safety(hold=HOLD, most_overruns=HOLD)
    if not udp:
        return run_rig(
            TwinDevice(plant, DT), controller, reference, duration=seconds, safety=safety
        )
    counts = (3, 3) if name == "three" else None
    with served(name) as url:
        device = opened(url, counts)
        return run_rig(device, controller, reference, duration=seconds, safety=safety)


def first_motion(seed: int) -> tuple[bool, bool, bool]:
    """Return whether the check has ended an honest run, whether it is stable, and a wrong one."""
    rng = np.random.default_rng(seed)
    n, dt = int(rng.integers(2, 4)), 4.0 * DT
    known = np.diag(np.exp(rng.uniform(-1.0, 3.0, n)))
    known = known @ (np.eye(n) + rng.uniform(-0.3, 0.3, (n, n)))
    true = known * rng.uniform(0.7, 1.3, (n, n))
    limits = np.exp(rng.uniform(0.0, 2.0, n))
    damping = float(rng.choice([0.0, 0.5, 5.0]))
    load = rng.uniform(-0.9, 0.9, n) * limits * float(rng.choice([0.0, 1.0]))
    heights = rng.uniform(-1.0, 1.0, n) * (np.abs(known) @ limits) / 36.0

    def ended(turned: int | None) -> tuple[bool, bool]:
        plant = machine(true, damping)
        C = plant.C.copy()
        if turned is not None:
            C[turned] *= -1.0
        plant = ql.plants.LinearPlant(plant.A, plant.B, C)
        parts = [
            ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=36.0, dt=dt), 6.0) for _ in range(n)
        ]
        axes = ql.Axes(parts, known, u_min=-limits, u_max=limits)
        scenario = ql.Scenario(tuple(ql.signals.Step(h, at=0.02) for h in heights), 1.5)
        rules = Safety(settle=20, y_min=-1e9, y_max=1e9).rules(axes, scenario)
        channels = row_channels(axes.channels, (), n, n)
        width = sum(size for _, size in channels)
        twin = TwinDevice(plant, dt)
        twin._handle.w[:] = load
        reference = reference_samples(scenario, axes, 0.3)
        loop = ControlLoop.of(twin, axes, reference, rules, virtual_clock([0]), ring(4096, width))
        loop.run()
        causes = [change.cause for change in mode_changes(loop.controller.supervisor, dt)]
        stable = bool(
            np.all(np.abs(twin.x[:n] * np.diag(C[:, :n])) < 10 * (1e-9 + np.max(np.abs(heights))))
        )
        return Cause.WRONG_WAY in causes, stable

    honest, stable = ended(None)
    return honest, stable, ended(int(rng.integers(n)))[0]


def main() -> None:
    """Print step times, or how often the check of signs ends a run."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--udp", action="store_true")
    parser.add_argument("--loops", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    options = options_of(parser, seconds=1.0, rounds=1)
    figures: dict[str, Any] = {}
    if options.quick or not options.loops:
        figures["times"] = times(options.rounds, options.seconds, options.udp)
    if options.quick or options.loops:
        figures["first motions"] = first_motions(options.loops or 1, options.seed)
    write(options, figures)


def first_motions(loops: int, seed: int) -> dict[str, int]:
    """Print and return how often the check of signs ends a run."""
    dispatch.interpret_all = True  # quicker than to compile for two and for three axes
    rows = []
    for i in range(loops):
        rows.append(first_motion(seed + i))
        if rows[-1][0]:
            print(f"seed {seed + i}: an honest run was ended", flush=True)
    honest, stable, wrong = np.array(rows).T
    print(
        f"honest and at rest at the end: {np.sum(stable)}, of which ended by the check "
        f"{np.sum(honest & stable)}; other honest ones {np.sum(~stable)}, ended "
        f"{np.sum(honest & ~stable)}; one encoder turned round: {wrong.size}, ended "
        f"{np.sum(wrong)}"
    )
    return {
        "loops": loops,
        "at rest at the end": int(np.sum(stable)),
        "of these ended": int(np.sum(honest & stable)),
        "others ended": int(np.sum(honest & ~stable)),
        "turned round, ended": int(np.sum(wrong)),
    }


def times(rounds: int, seconds: float, udp: bool) -> dict[str, Any]:
    """Print and return step times and lateness of one axis and of three."""
    figures: dict[str, Any] = {}
    runs: dict[str, list[RigRun]] = {"one": [], "three": []}
    for _ in range(rounds):
        for name, kept in runs.items():
            kept.append(timed(name, seconds, udp))
    medians = {}
    for name, kept in runs.items():
        steps = [run.timing.step.summary() for run in kept]
        late = [run.timing.lateness.summary() for run in kept]
        medians[name] = float(np.median([each["p50"] for each in steps]))
        for what, all_of in (("step time", steps), ("lateness", late)):
            medians_of = {
                key: 1e6 * float(np.median([each[key] for each in all_of])) for key in all_of[0]
            }
            figures[f"{name}, {what} [us]"] = medians_of
            values = ", ".join(f"{key} {value:.1f}" for key, value in medians_of.items())
            print(f"{name:6} {what:10} [us], medians of {len(kept)}: {values}")
        cycles, overruns = (
            sum(getattr(run.tally, key) for run in kept) for key in ("cycles", "overruns")
        )
        print(f"{name:6} {cycles} cycles, {overruns} overruns")
        figures |= {f"{name}, cycles": cycles, f"{name}, overruns": overruns}
    figures["three over one"] = medians["three"] / medians["one"]
    print(f"median step time of three axes over one: {figures['three over one']:.2f}")
    assert Mode.RUN in [change.mode for change in runs["three"][0].changes]
    return figures


if __name__ == "__main__":
    main()
