"""Exported controllers on this machine: bits, compilers, sanitizers, coverage, speed, long runs.

    python benchmarks/exported.py [--samples 100000] [--only TEXT] [--part PART] [--results FILE]

Every controller, observer, learner and feature of the contract tests is exported in double and in
single precision, compiled without a warning by gcc, clang and as C++, and run in a loop with a
plant (``exported.c``): noise, saturation, bursts of NaN, absurd values, manual operation, retuning,
restarts. The interpreted kernels replay what the C code was given; the columns have the number of
samples, and how many of them differ in a bit. "compiled" is the largest difference of u to the
compiled kernels, relative to the RMS of u; "1 ulp of y" is what the compiled kernels themselves
make of measurements that are moved by one unit of the last digit. The first comes from fused
multiply-add alone: with ``--without-fma`` the kernels are compiled without it, and all differences
must be zero. Branches are those of ``servo.c`` that the run has taken (gcov). All rows take 35
minutes of a core, MLP four of them: ``--results`` names a file to which each row is added when it
is ready, and whose rows are not run again. The parts are ``bits``, ``speed`` (the exported learner
against ``reference.c``) and ``long`` (10^8 samples in single and in double precision).
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from c_reference import c_design
from measured import check_present, options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.controllers import in_single_precision
from quell.controllers.base import reset_loop
from quell.controllers.bumpless import samples_to_settle
from quell.controllers.prefilters import without_prefilters
from quell.experiments import two_mass_spring as study
from quell.export import TranslationError
from quell.export.controller_source import limits_path
from quell.export.library.vectors import Action, Player

HERE = Path(__file__).resolve().parent
# Runs this file with kernels that are compiled without fused multiply-add.
_WITHOUT_FMA = f"""
import runpy, sys
from quell.kernels import linking
sys.path.insert(0, {str(HERE)!r})
linking.OPTIONS["fastmath"] = {{"nsz"}}
runpy.run_path({str(HERE / "exported.py")!r}, run_name="__main__")
"""
STRICT = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
EXACT = ("-O2", "-ffp-contract=off")
COMPILERS = {
    "gcc": ("gcc", "-std=c99", *STRICT, *EXACT),
    "clang": ("clang", "-std=c99", *STRICT, *EXACT),
    "g++": ("g++", "-std=c++11", "-x", "c++", "-Wall", "-Wextra", "-Werror", *EXACT),
    "sanitizers": (
        "gcc", "-std=c99", "-O1", "-g", "-ffp-contract=off", "-fsanitize=address,undefined",
        "-fno-sanitize-recover=all",
    ),
    "coverage": ("gcc", "-std=c99", "-O0", "-ffp-contract=off", "--coverage"),
}  # fmt: skip
QUICK = ("gcc", "coverage")  # the others take seconds each
NAMES = ("r", "y", "given", "u", "status")


def cases() -> Iterator[tuple[str, Any]]:
    """Yield name and controller of everything that the contract tests know."""
    sys.path.insert(0, str(HERE.parent))
    from tests.contracts.examples import LEARNERS, OBSERVERS
    from tests.contracts.test_controllers import CONTROLLERS

    yield from CONTROLLERS.items()
    for name, observer in OBSERVERS.items():
        yield f"observer: {name}", ql.ADRC(observer, omega_c=1.5, u_min=-3.0, u_max=3.0)
    observer = OBSERVERS["model-free, order 2, current"]
    limits = {"u_min": -5.0, "u_max": 5.0}
    for name, learner in LEARNERS.items():
        yield (
            f"learner: {name}",
            ql.ADRC(observer, 1.5, learner=learner, guard=ql.Guard(), **limits),
        )
    yield "learner without guard", ql.ADRC(observer, 1.5, learner=ql.learners.RLS(), **limits)


def script(samples: int, single: bool) -> np.ndarray:
    """Return the rows (action, reference, noise, share of u) of a run."""
    random, k = np.random.default_rng(7), np.arange(samples)
    rows = np.zeros((samples, 4))
    rows[:, 1] = np.sin(0.01 * k) + np.where(k % 3000 < 1500, 0.0, 2.0)
    rows[:, 2] = 1e-3 * random.standard_normal(samples)
    rows[:, 3] = 0.9
    rows[k % 997 < 5, 2] = np.nan  # also before the first sample
    rows[k % 4001 == 17, 2] = np.inf
    rows[k % 9973 == 400, 2] = 1e30 if single else 1e300
    rows[k % 49_999 == 45_000, 2] = 1e11 if single else 1e55  # usable, and absurd all the same
    rows[k % 1511 < 2, 1] = np.nan
    rows[k % 101 == 50, 0] = Action.APPLIED
    manual = (k % 5000 >= 2000) & (k % 5000 < 2100)
    rows[manual, 0], rows[manual, 3] = Action.TRACK, 0.99
    rows[k % 5000 == 2100, 0] = Action.HAND_OVER
    rows[k % 7000 == 3000, 0] = Action.LIMIT
    rows[k % 7000 == 3500, 0] = Action.FREE
    rows[k % 20_000 == 19_000, 0] = Action.RESET
    rows[k % 33_000 == 31_000, 0] = Action.START
    return rows


def build(folder: Path, compiler: str, defines: tuple[str, ...]) -> Path:
    """Compile servo.c and the loop; return the program."""
    place = folder / compiler.replace("+", "p")
    place.mkdir()
    shutil.copy(HERE / "exported.c", place / "loop.c")
    for file in (folder / "src").iterdir():
        shutil.copy(file, place)
    command = [*COMPILERS[compiler], *defines, "servo.c", "loop.c", "-lm", "-o", "loop"]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{compiler}: {done.stderr[:2000]}")
    return place / "loop"


def played(program: Path, rows: np.ndarray, single: bool) -> np.ndarray:
    """Run a program over the rows; return what it was given and its results."""
    done = subprocess.run([program], input=rows.tobytes(), capture_output=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr.decode()[:2000])
    kind = np.float32 if single else np.float64
    return np.frombuffer(done.stdout, [(name, kind) for name in NAMES])


def same_bits(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two results are the same; the sign of a NaN does not count."""
    return all(np.array_equal(one[name], other[name], equal_nan=True) for name in NAMES)


def branches(folder: Path, name: str = "servo") -> str:
    """Return the share of the branches of NAME.c that were taken, in per cent."""
    command = ["gcov", "-b", f"loop-{name}.gcda"]
    text = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False).stdout
    part = text.partition(f"{name}.c'")[2]
    found = re.search(r"Taken at least once:(\d+\.\d+)% of (\d+)", part)
    return f"{float(found[1]):.0f} % of {found[2]}" if found else "–"


def replayed(
    controller: Any, rows: np.ndarray, given: np.ndarray, names: set[str]
) -> tuple[int, int]:
    """Return how many samples the interpreted kernels replayed, and how many of them differ."""
    player, path = Player(controller), limits_path(controller)
    if path:
        player.limit_at(path, 0.5)
    for k, row in enumerate(given):
        action = available(Action(int(rows[k, 0])), names, path)
        player.play(action, row["r"], row["y"], row["given"])
    status = np.array([row.status for row in player.rows])
    same = (player.u_of(slice(None))[:, 0] == given["u"]) & (status == given["status"])
    return same.size, int(np.sum(~same))


def available(action: Action, names: set[str], path: str) -> Action:
    """Return the action, or a step if the controller can't do it."""
    needs = {
        Action.TRACK: "track" in names,
        Action.HAND_OVER: "hand_over" in names,
        Action.LIMIT: bool(path),
        Action.FREE: bool(path),
        Action.START: "start" in names,
    }
    return action if needs.get(action, True) else Action.STEP


def compiled(
    controller: Any, rows: np.ndarray, given: np.ndarray, names: set[str], y: np.ndarray
) -> np.ndarray:
    """Return u of the compiled methods for the measurements ``y``."""
    runner, path = copy.deepcopy(controller), limits_path(controller)
    derivatives = int(getattr(controller, "derivatives", 0))
    u = np.empty(given.size)
    for k, row in enumerate(given):
        action = available(Action(int(rows[k, 0])), names, path)
        r = row["r"]
        more = [0.5 * r] * derivatives
        if action is Action.APPLIED:
            runner.applied(row["given"])
        elif action is Action.HAND_OVER:
            runner.hand_over()
        elif action in (Action.LIMIT, Action.FREE):
            runner.set_limits(u_max=0.5 if action is Action.LIMIT else controller.limits.high)
        elif action is Action.RESET:
            reset_loop(runner.parameters, runner._state)  # reset() would forget what was learned
        elif action is Action.START:
            runner.start(row["y"], row["given"], r)
        track = action is Action.TRACK
        u[k] = runner.track(r, y[k], row["given"], *more) if track else runner.step(r, y[k], *more)
    return u


def moved(y: np.ndarray) -> np.ndarray:
    """Return measurements that are one unit of the last digit higher or lower, by chance."""
    up = np.random.default_rng(8).random(y.size) < 0.5
    with np.errstate(over="ignore"):
        return np.nextafter(y, np.where(up, np.inf, -np.inf).astype(y.dtype))


def judged(name: str, controller: Any, precision: str, options: argparse.Namespace) -> list[str]:
    """Return a row of the table."""
    single = precision == "single"
    shown = in_single_precision(controller) if single else controller
    rows = script(options.samples, single)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "servo"
        done = ql.export.c(controller, folder, name="servo", precision=precision, accept=True)
        names, path = set(done.source.operations), limits_path(shown)
        inner = without_prefilters(controller)
        if "start" in names and samples_to_settle(inner.observer) > 20_000:
            names.discard("start")  # interpreted it would take minutes
        defines = tuple(
            f"-D{each}"
            for each in (
                *(f"HAS_{what.upper()}" for what in ("track", "start") if what in names),
                *([f"LIMITS={path}"] if path else []),
                f"HALVES(x)={', x' * done.source.derivatives}",
            )
        )
        chosen = QUICK if options.quick else COMPILERS
        runs = {each: played(build(folder, each, defines), rows, single) for each in chosen}
        taken = branches(folder / "coverage")
    given = runs["gcc"]
    others = sum(not same_bits(each, given) for each in runs.values())
    count, wrong = replayed(shown, rows, given, names)
    arguments, y = (shown, rows, given, names), given["y"]
    u, size = compiled(*arguments, y), float(np.sqrt(np.mean(np.square(given["u"])))) or 1.0
    difference = float(np.max(np.abs(u - given["u"]))) / size
    rounding = float(np.max(np.abs(compiled(*arguments, moved(y)) - u))) / size
    flags = ql.Status(int(np.bitwise_or.reduce(given["status"].astype(int))))
    cells = [name, precision, f"{count}", f"{wrong}", f"{others}"]
    return [*cells, f"{difference:.0e}", f"{rounding:.0e}", taken, f"{int(flags)}"]


def bits(options: argparse.Namespace, console: Console) -> dict[str, Any]:
    """Print the table of all combinations; return its numbers."""
    heads = ("controller", "precision", "replayed", "differ", "compilers that differ",
             "compiled", "1 ulp of y", "branches taken", "flags seen")  # fmt: skip
    table, rows = Table(*heads), []
    known, wrong = earlier_rows(options.results), 0
    for name, controller in cases():
        if options.only not in name:
            continue
        for precision in ("double", "single"):
            make = partial(row_of, name, controller, precision, options)
            cells = ready_row(known, (name, precision), make, options.results)
            wrong += cells[2] != "refused" and cells[3:5] != ["0", "0"]
            console.print(" | ".join(cells), highlight=False)
            table.add_row(*cells)
            rows.append(cells)
            if cells[2] == "refused":  # what has Python parts does not work in single precision
                break
    console.print(table)
    console.print(f"{wrong} rows have an error" if wrong else "all rows are as they must be")
    return {"bad rows": wrong, **counted(heads, rows)}


def row_of(name: str, controller: Any, precision: str, options: argparse.Namespace) -> list[str]:
    """Return a row of the table, also for what is refused or fails."""
    try:
        return judged(name, controller, precision, options)
    except TranslationError as error:
        return [name, precision, "refused", str(error)[:40], "", "", "", "", ""]
    except (RuntimeError, ValueError) as error:
        return [name, precision, "FAILED", str(error)[:200], "", "", "", "", ""]


def counted(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> dict[str, Any]:
    """Return the number of rows, and their cells, as numbers where they are some, by name."""
    found: dict[str, Any] = {}
    for name, precision, *cells in rows:
        row = found[f"{name}, {precision}"] = {}
        for head, cell in zip(heads[2:], cells, strict=True):
            try:
                row[head] = float(cell)
            except ValueError:  # of a row that was refused, for instance
                row[head] = cell
    return {"rows": len(found), "of them refused": sum(
        "refused" in row.values() for row in found.values()
    ), "row": found}  # fmt: skip


def earlier_rows(file: Path | None) -> dict[tuple[str, str], list[str]]:
    """Return the rows in a file by controller and precision."""
    if file is None or not file.exists():
        return {}
    rows = map(json.loads, file.read_text(encoding="utf-8").splitlines())
    return {(row[0], row[1]): row for row in rows}


def ready_row(
    known: Mapping[tuple[str, str], list[str]],
    key: tuple[str, str],
    make: Callable[[], list[str]],
    results: Path | None,
) -> list[str]:
    """Return a row that is known, or make it and add it to the file of rows."""
    if key in known:
        return known[key]
    cells = make()
    if results:
        with results.open("a", encoding="utf-8") as file:
            print(json.dumps(cells), file=file)
    return cells


def chosen_rows(
    known: Iterable[tuple[str, Any]], text: str, part: slice, precision: str | None = None
) -> list[tuple[str, Any, str]]:
    """Return those of the controllers whose name has a text, in one precision or both."""
    precisions = [precision] if precision else ["double", "single"]
    rows = [(name, each, kind) for name, each in known for kind in precisions if text in name]
    return rows[part]


def shown_rows(
    rows: Iterable[tuple[str, Any, str]],
    heads: Sequence[str],
    make: Callable[[str, Any, str], list[str]],
    results: Path | None,
) -> list[list[str]]:
    """Make a row for each controller, print it when it is ready, and all of them as a table."""
    console, table, known, done = Console(width=160), Table(*heads), earlier_rows(results), []
    for name, controller, precision in rows:
        work = partial(make, name, controller, precision)
        done.append(ready_row(known, (name, precision), work, results))
        console.print(" | ".join(done[-1]), highlight=False)
        table.add_row(*done[-1])
    console.print(table)
    return done


def speed(console: Console, quick: bool) -> dict[str, Any]:
    """Print the time of a step of the exported learner over that of ``reference.c``."""
    figures: dict[str, Any] = {}
    settings = study.Settings()
    controller = study.controllers(settings)[study.L]
    run = ql.simulate(ql.plants.two_mass_spring(), controller, study.scenario(settings))
    design = c_design(settings)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "servo"
        ql.export.c(controller, folder, name="servo")
        for name, values in (("design", design), ("r", run["r"]), ("y", run["y_measured"])):
            (Path(place) / name).write_bytes(np.ascontiguousarray(values, dtype=float).tobytes())
        table = Table("compiler and flags", "exported [ns]", "by hand [ns]", "ratio (bar 1.1)")
        for flags in (
            ("gcc", "-O2"), ("gcc", "-O3"), ("gcc", "-O3", "-march=native", "-std=gnu11"),
            ("clang", "-O2"), ("clang", "-O3", "-march=native"),
        )[: 1 if quick else None]:  # fmt: skip
            program = Path(place) / "timing"
            sources = (HERE / "exported_speed.c", folder / "src/servo.c")
            include = (f"-I{HERE}", f"-I{folder / 'src'}")
            subprocess.run([*flags, *include, *sources, "-lm", "-o", program], check=True)
            text = subprocess.run([program], cwd=place, capture_output=True, check=True).stdout
            exported, by_hand = map(float, text.split())
            cells = (f"{exported:.0f}", f"{by_hand:.0f}", f"{exported / by_hand:.2f}")
            table.add_row(" ".join(flags), *cells)
            figures[" ".join(flags)] = {
                "exported [ns]": exported, "by hand [ns]": by_hand, "ratio": exported / by_hand,
            }  # fmt: skip
    console.print(table)
    return figures


def long_runs(samples: float, console: Console, quick: bool) -> dict[str, Any]:
    """Print what both precisions do in very many samples, at rest and in motion."""
    observer = ql.ESO.model_free(order=2, b0=1.5, omega_o=30.0, dt=1e-3)
    limits = {"u_min": -20.0, "u_max": 20.0}
    laws = {
        "MF-ESO": ql.ADRC(observer, 3.0, **limits),
        "Kalman, guard": ql.ADRC(
            observer, 3.0, learner=ql.learners.Kalman(), guard=ql.Guard(), **limits
        ),
        "RLS, guard": ql.ADRC(observer, 3.0, learner=ql.learners.RLS(), guard=ql.Guard(), **limits),
        "PID": ql.baselines.PID(20.0, ki=30.0, kd=3.0, tf=0.01, dt=1e-3, **limits),
    }
    parts = ("RMS r - y: first, ninth, last tenth", "mean u of each", "learned", "flags",
             "not finite")  # fmt: skip
    table = Table("controller", "plant", "precision", *parts)
    figures: dict[str, Any] = {"samples": samples}
    for name, controller in list(laws.items())[: 1 if quick else None]:
        with tempfile.TemporaryDirectory() as place:
            programs = {
                precision: long_program(Path(place) / precision, controller, precision)
                for precision in ("double", "single")
            }
            for plant in ("at rest", "in motion"):
                for precision, program in programs.items():
                    command = [program, f"{samples:.0f}", "1" if plant == "in motion" else "0"]
                    done = subprocess.run(command, capture_output=True, check=True, text=True)
                    cells = done.stdout.split("|")
                    table.add_row(name, plant, precision, *cells)
                    figures[f"{name}, {plant}, {precision}"] = dict(
                        zip(parts, map(numbers_of, cells), strict=True)
                    )
    console.print(table)
    return figures


def numbers_of(text: str) -> list[float | str]:
    """Return the words of a text, as numbers where they are some."""
    found: list[float | str] = []
    for word in text.split():
        try:
            found.append(float(word.rstrip(",")))
        except ValueError:
            found.append(word)
    return found


def long_program(folder: Path, controller: Any, precision: str) -> Path:
    """Return the program of the long runs."""
    done = ql.export.c(controller, folder, name="servo", precision=precision, accept=True)
    channels = done.source.channels
    defines = [f"-DHAS_{channel.upper()}" for channel, width in channels if width > 1]
    sources = (HERE / "exported_long.c", folder / "src/servo.c")
    flags = ("gcc", "-O2", f"-I{folder / 'src'}", *defines)
    subprocess.run([*flags, *sources, "-lm", "-o", folder / "long"], check=True)
    return folder / "long"


def main() -> None:
    """Run the parts."""
    parser = parser_of(__doc__)
    parser.add_argument("--samples", type=int, default=100_000, help="samples of each run in C")
    parser.add_argument("--only", default="", help="controllers whose name has this text")
    parser.add_argument("--part", choices=("bits", "speed", "long"), help="one part only")
    parser.add_argument("--results", type=Path, help="file of rows that are ready")
    parser.add_argument("--long", type=float, default=1e8, help="samples of the long runs")
    parser.add_argument("--without-fma", action="store_true", help="compile kernels without FMA")
    options = options_of(parser, samples=300, only="PPI", long=1e4)
    check_present(options, tools=("gcc", "g++", "clang", "gcov"))
    if options.without_fma:
        arguments = [each for each in sys.argv[1:] if each != "--without-fma"]
        with tempfile.TemporaryDirectory() as cache:
            command = [sys.executable, "-c", _WITHOUT_FMA, *arguments]
            environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
            sys.exit(subprocess.run(command, env=environment, check=False).returncode)
    console = Console(width=max(160, int(os.environ.get("COLUMNS", "0"))))
    warnings.simplefilter("ignore")
    figures: dict[str, Any] = {}
    if options.part in (None, "bits"):
        figures["bits"] = bits(options, console)
    if options.part in (None, "speed"):
        figures["speed"] = speed(console, options.quick)
    if options.part in (None, "long"):
        figures["long"] = long_runs(options.long, console, options.quick)
    write(options, figures)


if __name__ == "__main__":
    main()
