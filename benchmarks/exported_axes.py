"""Exported axes on this machine: bits, compilers, sanitizers, coverage, in long runs.

    python benchmarks/exported_axes.py [--samples 20000] [--only TEXT] [--results FILE]

As ``exported.py`` does for one u and one y: the axes of each row are exported, in double precision
and, where that is possible, in single, compiled without a warning by gcc, clang and as C++, and run
in a loop with a plant that couples them (``exported_axes.c``): noise, saturation, bursts of NaN in
r and y of single axes, absurd values, manual operation, retuning, restarts, a brake. The
interpreted kernels replay what the C code was given; the columns have the number of samples, and
how many of them differ in a bit of u or of the flags. Branches are those of ``robot.c`` that the
run has taken (gcov).
"""

from __future__ import annotations

import math
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from exported import COMPILERS, QUICK, branches, counted, earlier_rows, ready_row
from measured import check_present, options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.export import c_source
from quell.export.library.vectors import Action, Player

HERE = Path(__file__).resolve().parent
SQUARE = np.array([[1.0, 0.3, 0.1], [0.2, 2.0, 0.1], [0.0, 0.3, 0.5]])
WIDE = np.hstack([SQUARE, [[0.5], [0.2], [0.4]]])
LIMITS = {"u_min": -5.0, "u_max": 5.0}
RULES: dict[str, Any] = {
    "each": "each", "direction": "direction", "priority": ["axis3", "axis1", "axis2"],
}  # fmt: skip


def joint(learner: Any = None, order: int = 2, **parts: Any) -> ql.ADRC:
    """Return the controller of an axis."""
    observer = ql.ESO.model_free(order=order, b0=1.0, omega_o=30.0, dt=0.01)
    guard = None if learner is None else ql.Guard()
    return ql.ADRC(observer, 5.0, learner=learner, guard=guard, **parts)


def learning() -> list[ql.ADRC]:
    """Return three axes with learners and guards."""
    learners = ql.learners
    return [
        joint(learners.Harmonic()),
        joint(learners.Kalman(), feedforward=True),
        joint(learners.RLS()),
    ]


def turning(x: Any) -> Any:
    """Return B0 that turns with the first axis, and has no inverse far out."""
    c, s = math.cos(x[0, 0]), math.sin(x[0, 0])
    if abs(x[1, 0]) > 3.0:
        return (1.0, 1.0), (1.0, 1.0)
    return (c, -s), (s, c)


def cases() -> dict[str, Any]:
    """Return the axes of each row."""
    found: dict[str, Any] = {}
    for name, rule in RULES.items():
        limits = {**LIMITS, "rate_limit": 200.0}
        found[f"learners, {name}"] = ql.Axes(learning(), SQUARE, saturation=rule, **LIMITS)
        found[f"learners, rates, more actuators, {name}"] = ql.Axes(
            learning(),
            WIDE,
            saturation=rule,
            weights=[1, 2, 1, 3],
            wished=[0.5, 0, 0, -0.5],
            **limits,
        )
    arm = ql.plants.arm(gravity=0.0)
    two = [joint(ql.learners.Kalman()), joint(ql.learners.Harmonic())]
    found["learners, mass matrix of an arm"] = ql.Axes(two, M=arm.inertia, **LIMITS)
    found["learners, function that fails"] = ql.Axes(two, turning, **LIMITS)
    found["no learner, orders 1 and 3"] = ql.Axes([joint(order=1), joint(order=3)], **LIMITS)
    held = [
        joint(held=ql.HeldPlant()),
        joint(safe_set=ql.SafeSet(-1.5, 1.5, alpha=8.0, f_rate=1.0)),
    ]
    found["held, safe set"] = ql.Axes(held, np.eye(2) + 0.2, **LIMITS)
    return found


def feedback() -> dict[str, Any]:
    """Return state feedback with each kind of gain of its observer."""
    A = [[0, 1, 0, 0], [-5, -0.1, 5, 0.1], [0, 0, 0, 1], [5, 0.1, -5, -0.1]]
    B, C, E = [0, 1.5, 0, 0], [[1, 0, 0, 0], [0, 0, 1, 0]], [0, 0, 0, 1.0]
    noise = {"noise_variance": [1e-6, 1e-6], "drift": [1.0]}
    gain = ql.controllers.state_feedback(A, B, 3.0, 0.01)
    found = {}
    for name, options in {
        "poles": {"omega_o": 30.0},
        "fixed gains, two rates": {**noise, "time_varying": False, "every": (1, 4)},
        "covariance": {**noise, "disturbance_order": 2},
    }.items():
        observer = ql.ESO.state_space(A, B, C, E, 0.01, **options)
        law = ql.controllers.StateFeedback(
            observer, gain, controlled=C[1:], rate_limit=200.0, **LIMITS
        )
        found[f"state feedback, {name}"] = law
    return found


def script(samples: int, axes: int, single: bool) -> np.ndarray:
    """Return the rows (action, references, noise, share of u) of a run."""
    random, k = np.random.default_rng(7), np.arange(samples)
    action, share = np.zeros(samples), np.full(samples, 0.9)
    r, noise = np.zeros((samples, axes)), 1e-3 * random.standard_normal((samples, axes))
    for i in range(axes):
        j = k + 311 * i
        r[:, i] = np.sin(0.01 * j) + np.where(j % 3000 < 1500, 0.0, 1.0)
        noise[j % 997 < 5, i] = np.nan
        noise[j % 4001 == 17, i] = np.inf
        noise[j % 9973 == 400, i] = 1e30 if single else 1e300
        noise[j % 19_999 == 15_000, i] = 1e11 if single else 1e55
        r[j % 1511 < 2, i] = np.nan
    noise[:3] = np.nan  # before the first sample
    action[k % 101 == 50] = Action.APPLIED
    manual = (k % 5000 >= 2000) & (k % 5000 < 2100)
    action[manual], share[manual] = Action.TRACK, 0.99
    action[k % 5000 == 2100] = Action.HAND_OVER
    for every, at, what in (
        (7000, 3000, Action.LIMIT), (7000, 3500, Action.FREE), (6000, 5000, Action.HELD),
        (6000, 5200, Action.RELEASED), (20_000, 19_000, Action.RESET),
        (16_000, 15_500, Action.START),
    ):  # fmt: skip
        action[k % every == at] = what
    return np.column_stack([action, r, noise, share])


def build(folder: Path, compiler: str, axes: ql.Axes, derivatives: int) -> Path:
    """Compile robot.c and the loop; return the program."""
    place = folder / compiler.replace("+", "p")
    place.mkdir()
    shutil.copy(HERE / "exported_axes.c", place / "loop.c")
    for file in (folder / "src").iterdir():
        shutil.copy(file, place)
    rows = ", ".join("{" + ", ".join(map(repr, row)) + "}" for row in axes.first_gain.tolist())
    more = ", x" * derivatives
    defines = (f"-DGAIN={{{rows}}}", f"-DDERIVATIVES={derivatives}", f"-DMORE(x)={more}")
    command = [*COMPILERS[compiler], *defines, "robot.c", "loop.c", "-lm", "-o", "loop"]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{compiler}: {done.stderr[:2000]}")
    return place / "loop"


def played(program: Path, rows: np.ndarray, axes: ql.Axes, single: bool) -> np.ndarray:
    """Run a program over the rows; return what it was given and its results."""
    done = subprocess.run([program], input=rows.tobytes(), capture_output=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr.decode()[:2000])
    n, m, kind = axes.outputs, axes.inputs, np.float32 if single else np.float64
    fields = [("r", n), ("y", n), ("given", m), ("u", m), ("status", 1)]
    return np.frombuffer(done.stdout, [(name, kind, (size,)) for name, size in fields])


def authorities(states: Any) -> Iterator[float]:
    """Yield the authority of the learner of each axis, 0 without a guard."""
    for state in states:
        guard = state.guard
        yield float(guard.sample[0].authority) if hasattr(guard, "sample") else 0.0


def replayed(
    axes: ql.Axes, rows: np.ndarray, given: np.ndarray, single: bool
) -> tuple[int, int, ql.Status, float]:
    """Return the samples that were replayed, those that differ, all flags, largest authority."""
    player = Player(axes, "single" if single else "double")
    player.limit_at("limits", 0.5)
    authority = 0.0
    for k, row in enumerate(given):
        authority = max(authority, *authorities(player.state.axes))
        player.play(Action(int(rows[k, 0])), row["r"], row["y"], row["given"])
    u = np.array([row.u for row in player.rows])
    status = np.array([row.status for row in player.rows])
    same = np.all(u == given["u"], axis=1) & (status == given["status"][:, 0])
    flags = ql.Status(int(np.bitwise_or.reduce(status)))
    return same.size, int(np.sum(~same)), flags, authority


def judged(
    name: str, axes: ql.Axes, precision: str, samples: int, compilers: Iterable[str]
) -> list[str]:
    """Return a row of the table."""
    single = precision == "single"
    try:
        source = c_source(axes, "robot", precision=precision)
    except ValueError as error:  # a function B0 in single precision, or a learner in Python
        return [name, precision, "refused", "0", "0", "", "", str(error)[24:80]]
    rows = script(samples, axes.outputs, single)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "src").mkdir()
        (folder / "src/robot.h").write_text(source.header, encoding="utf-8")
        (folder / "src/robot.c").write_text(source.source, encoding="utf-8")
        runs = {
            each: played(build(folder, each, axes, source.derivatives), rows, axes, single)
            for each in compilers
        }
        taken = branches(folder / "coverage", "robot")
    given = runs["gcc"]
    others = sum(
        not all(
            np.array_equal(run[part], given[part], equal_nan=True) for part in given.dtype.names
        )
        for run in runs.values()
    )
    count, wrong, flags, authority = replayed(axes, rows, given, single)
    return [
        name,
        precision,
        f"{count}",
        f"{wrong}",
        f"{others}",
        taken,
        f"{authority:.2f}",
        "|".join(each.name or "" for each in flags),
    ]


def main() -> None:
    """Run the rows and print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--samples", type=int, default=20_000, help="samples of each run in C")
    parser.add_argument("--only", default="", help="rows whose name has this text")
    parser.add_argument("--precision", choices=("double", "single"), help="one precision only")
    parser.add_argument("--results", type=Path, help="file of rows that are ready")
    options = options_of(parser, samples=300, only="no learner", precision="double")
    check_present(options, tools=("gcc", "g++", "clang", "gcov"))
    warnings.simplefilter("ignore")
    console, known, bad = Console(width=160), earlier_rows(options.results), 0
    heads = (
        "axes",
        "precision",
        "replayed",
        "differ",
        "compilers that differ",
        "branches taken",
        "authority",
        "flags seen",
    )
    table, rows = Table(*heads), []
    chosen = QUICK if options.quick else COMPILERS
    for name, axes in cases().items():
        for precision in [options.precision] if options.precision else ["double", "single"]:
            if options.only in name:
                make = partial(judged, name, axes, precision, options.samples, chosen)
                cells = ready_row(known, (name, precision), make, options.results)
                bad += cells[3:5] != ["0", "0"]
                console.print(" | ".join(cells), highlight=False)
                table.add_row(*cells)
                rows.append(cells)
    console.print(table)
    print(f"{bad} rows differ" if bad else "all rows are as they must be")
    write(options, {"bad rows": bad, **counted(heads, rows)})


if __name__ == "__main__":
    main()
