"""One loop over NumPy's structured records and over NamedTuples: run, compile, interpreted, step.

    python benchmarks/structured_records.py [--interpreted]

A record has shapes in its Numba type, and is the struct of exported C: could it replace
NamedTuples, with ``kernels/sized.py``, ``specialised`` and packed controllers? The same text of
kernels (two masses, ESO of five states, law, lag filters, the update of ``Kalman`` with P (5, 5), a
bound of f_L as a guard has) is compiled four times:

- NamedTuples of arrays, as quell does it: shapes in types, ``noalias``, kernels linked late;
- records on stock Numba, with the same options of ``njit``;
- the same, and the compiler is told that parameters and state do not overlap (``noalias``, which
  ``njit`` has no option for);
- records with all of quell's passes, which tells what is due to the records and what to the passes.

The text reads each field once, into a variable, because a field of a record costs a view in Python.

Records would be taken if compiled runs are at most 1.05 times as long and interpreted ones, which
tests use, at most 1.25 times. Times are the best of interleaved trials in one process; those of
compilation are the best of fresh processes without a disk cache.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from operator import itemgetter
from types import SimpleNamespace
from typing import Any, NamedTuple

import numba
import numpy as np
from c_reference import best, row, show
from measured import options_of, parser_of, write
from numba.extending import register_jitable

import quell as ql
from quell.controllers.base import control
from quell.controllers.stateful import PackedController, entry_point, step_packed
from quell.experiments import two_mass_spring as study
from quell.kernels import dispatch
from quell.kernels.linking import KERNEL_OPTIONS, OPTIONS, WithoutOverlaps
from quell.kernels.sized import Scalars

NAMED, RECORDS = "NamedTuples", "records, stock Numba"
RECORDS_NOALIAS, RECORDS_LINKED = "records, stock Numba and noalias", "records, quell's passes"
VARIANTS = (NAMED, RECORDS, RECORDS_NOALIAS, RECORDS_LINKED)
SAMPLES, TRIALS = 50_000, 15
INTERPRETED, INTERPRETED_TRIALS = 400, 7
CALLS = 20_000
COMPILATIONS = 3

# ---- The kernels: the same text for NamedTuples and for records ----


def kernels(kernel: Callable[[Any], Any]) -> SimpleNamespace:
    """Return the functions of the loop, each marked with ``kernel``."""

    @kernel
    def observe(eso, z, seen, y, u, f):
        transition, of_u, feed, gain = eso.transition, eso.input, eso.feed, eso.gain
        for i in range(z.size):
            total = 0.0
            for j in range(z.size):
                total += transition[i, j] * z[j]
            seen[i] = total + feed[i] * f + of_u[i] * u
        error = y - seen[0]
        for i in range(z.size):
            z[i] = seen[i] = seen[i] + gain[i] * error

    @kernel
    def lag_push(lag, chain, i, value):
        pole, rise, taps = lag.pole, lag.rise, lag.taps
        carry, after = rise * value, 0.0
        for j in range(taps.size):
            old = chain[i, j]
            new = pole * old + carry
            carry = rise * old
            chain[i, j] = new
            after += taps[j] * new
        return after

    @kernel
    def update_averages(learner, averages, y, error, innovation, target):
        rounding, doubt = 1e-16 * y, 0.1 * target
        averages.noise += learner.forget * (error * error + rounding * rounding - averages.noise)
        square = innovation * innovation + doubt * doubt
        averages.unexplained += learner.forget * (square - averages.unexplained)
        averages.weight += learner.forget * (1.0 - averages.weight)
        averages.time += learner.dt
        unexplained = averages.unexplained + learner.f_noise * averages.noise
        deviation = math.sqrt(learner.lag_time * unexplained / averages.weight)
        return averages.noise / averages.weight, deviation

    @kernel
    def adapt(learner, memory, averages, seen, y, f_plain):
        theta, covariance, gain = memory.theta, memory.covariance, memory.gain
        regressor, mean, variance = memory.filtered, memory.mean, memory.variance
        threshold, walk, forget, dt = learner.threshold, learner.walk, learner.forget, learner.dt
        size = theta.size
        bias = size - 1
        explained = 0.0
        for i in range(size):
            explained += theta[i] * regressor[i]
        innovation = f_plain - explained
        noise, deviation = update_averages(learner, averages, y, y - seen[0], innovation, f_plain)
        if deviation == 0.0 or not math.isfinite(deviation):
            return
        weight = 1.0 / deviation
        for i in range(bias):
            away = regressor[i] - mean[i]
            mean[i] += forget * away
            variance[i] += forget * (away * away - variance[i])
            moves = variance[i] > threshold[i] * noise
            regressor[i] = weight * (regressor[i] - mean[i]) if moves else 0.0
        if averages.time <= 2.0 * learner.lag_time:
            return
        spread = 0.0
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += covariance[i, j] * regressor[j]
            gain[i] = total
            spread += total * regressor[i]
        if spread < 0.0:
            return
        inverse = 1.0 / max(spread + 1.0 / dt, spread / (learner.fastest * dt))
        level = theta[bias]
        for i in range(size):
            share = gain[i] * inverse
            for j in range(size):
                covariance[i, j] -= share * gain[j]
            if i == bias:
                theta[i] = level + share * innovation
                covariance[i, i] += walk[i] * dt
            else:
                change = share * innovation * weight
                theta[i] += change
                level -= change * mean[i]
                if regressor[i] != 0.0:
                    squared = deviation * deviation
                    covariance[i, i] += walk[i] * dt * squared / variance[i]

    @kernel
    def predict(learner, memory, seen):
        theta, scale = memory.theta, learner.scale
        bias = theta.size - 1
        total = theta[bias]
        for i in range(bias):
            total += theta[i] * scale[i] * seen[i]
        return total

    @kernel
    def commit(learner, memory, seen):
        chain, filtered, lag, scale = memory.chain, memory.filtered, learner.lag, learner.scale
        bias = filtered.size - 1
        for i in range(bias):
            filtered[i] = lag_push(lag, chain, i, scale[i] * seen[i])
        filtered[bias] = lag_push(lag, chain, bias, 1.0)

    @kernel
    def bounded(guard, loop, f_plain, f_learned):
        loop.square += guard.forget * (f_plain * f_plain - loop.square)
        loop.peak = max(abs(f_plain), guard.decay * loop.peak)
        most = guard.bound * math.sqrt(loop.square) + 0.1 * loop.peak
        return min(max(f_learned, loop.f_seen - most), loop.f_seen + most)

    @kernel
    def step(design, state, loop, averages, r, y):
        if not math.isfinite(y):
            y = loop.y
        loop.y = y
        seen, z, law, guard = state.seen, state.z, design.law, design.guard
        order = law.size
        loop.f_seen = lag_push(design.learner.lag, state.shadow, 0, loop.f_learned)
        commit(design.learner, state.learner, seen)
        observe(design.eso, z, seen, y, loop.u, loop.f_learned)
        f_plain = seen[order] + loop.f_seen
        adapt(design.learner, state.learner, averages, seen, y, f_plain)
        f_learned = bounded(guard, loop, f_plain, predict(design.learner, state.learner, seen))
        total = law[0] * r
        for i in range(order):
            total -= law[i] * seen[i]
        u = (total - seen[order] - f_learned) / design.b0
        u = min(max(u, design.low), design.high)
        loop.u, loop.f_learned = u, f_learned
        return u

    @kernel
    def closed_loop(design, state, loop, averages, signals, out):
        plant, x, after = design.plant, state.x, state.after
        transition, of_u, of_w = plant.transition, plant.input, plant.disturbance
        output = plant.output
        for k in range(out.size):
            y = x[0] * output[0] + signals[k, 1]
            for i in range(1, x.size):
                y += x[i] * output[i]
            u = step(design, state, loop, averages, signals[k, 0], y)
            out[k] = u
            for i in range(x.size):
                total = of_u[i] * u + of_w[i] * signals[k, 2]
                for j in range(x.size):
                    total += transition[i, j] * x[j]
                after[i] = total
            for i in range(x.size):
                x[i] = after[i]

    return SimpleNamespace(step=step, closed_loop=closed_loop)


# ---- Parameters and state as NamedTuples ----


class Plant(NamedTuple):
    """A sampled plant."""

    transition: Any
    input: Any
    disturbance: Any
    output: Any


class Eso(NamedTuple):
    """The observer."""

    transition: Any
    input: Any
    feed: Any
    gain: Any


class Lag(NamedTuple):
    """The observer's lag."""

    pole: float
    rise: float
    taps: Any


class Learner(NamedTuple):
    """The learner."""

    lag: Lag
    scale: Any
    walk: Any
    threshold: Any
    fastest: float
    f_noise: float
    dt: float
    forget: float
    lag_time: float


class Guard(NamedTuple):
    """The bound of f_L."""

    forget: float
    decay: float
    bound: float


class Design(NamedTuple):
    """All parameters."""

    plant: Plant
    eso: Eso
    law: Any
    learner: Learner
    guard: Guard
    b0: float
    low: float
    high: float


class Loop(Scalars):
    """Scalars of the loop."""

    u: float
    y: float
    f_learned: float
    f_seen: float
    square: float
    peak: float


class Averages(Scalars):
    """Scalars of the learner."""

    noise: float
    unexplained: float
    weight: float
    time: float


class Memory(NamedTuple):
    """State of the learner."""

    theta: Any
    covariance: Any
    chain: Any
    filtered: Any
    mean: Any
    variance: Any
    gain: Any


class State(NamedTuple):
    """All state; the record has ``loop`` and ``averages`` as records inside."""

    x: Any
    after: Any
    z: Any
    seen: Any
    shadow: Any
    learner: Memory
    loop: Any
    averages: Any


def parameters() -> tuple[Design, State]:
    """Return the parameters of the two-mass study's L-ESO, and a state at rest."""
    settings = study.Settings()
    design = study.controllers(settings)[study.L].parameters
    eso, kalman, lag = design.eso, design.learner, design.learner.lag
    plant = ql.plants.two_mass_spring().sampled(settings.dt)
    sampled = Plant(plant.transition, plant.input, plant.disturbance[:, 1].copy(), plant.output)
    learner = Learner(
        Lag(lag.pole, lag.rise, lag.taps),
        *(kalman.scale, kalman.walk, kalman.threshold),
        *(kalman.fastest, kalman.f_noise, kalman.dt, kalman.forget, kalman.lag_time),
    )
    size, stages = kalman.scale.size, lag.taps.size
    memory = Memory(
        *(np.zeros(size), np.diag(kalman.prior**2), np.zeros((size, stages))),
        *(np.zeros(size) for _ in range(4)),
    )
    n = design.law.size
    state = State(
        *(np.zeros(n), np.zeros(n), np.zeros(n + 1), np.zeros(n + 1), np.zeros((1, stages))),
        *(memory, Loop.zeros(), Averages.zeros()),
    )
    guard = Guard(kalman.forget, math.exp(-settings.dt), 3.0)
    observer = Eso(eso.transition, eso.input, eso.feed, eso.gain)
    whole = Design(sampled, observer, design.law, learner, guard, design.b0, -100.0, 100.0)
    return whole, state


# ---- The same as records ----


def record_type(value: Any) -> np.dtype[Any]:
    """Return the type of a record with the fields of a NamedTuple, read as attributes in Python."""
    fields: list[Any] = []
    for name, part in zip(value._fields, value, strict=True):
        if isinstance(part, tuple):
            fields.append((name, record_type(part)))
        elif isinstance(part, np.ndarray):
            is_scalars = part.dtype.names is not None
            fields.append((name, part.dtype) if is_scalars else (name, part.dtype, part.shape))
        else:
            fields.append((name, np.float64))
    # Quicker in Python than np.record; kernels/sized.py does the same.
    names = [field[0] for field in fields]
    members = {name: property(itemgetter(name), _writer(name)) for name in names}
    kind = type(f"{type(value).__name__}Record", (np.void,), members)
    return np.dtype((kind, np.dtype(fields, align=True)))


def _writer(name: str) -> Callable[[Any, float], None]:
    def write(record: Any, value: float) -> None:
        record[name] = value

    return write


def as_record(value: Any) -> Any:
    """Return a NamedTuple's numbers as an array of one record."""
    record = np.zeros(1, record_type(value))
    _fill(record[0], value)
    return record


def _fill(record: Any, value: Any) -> None:
    for name, part in zip(value._fields, value, strict=True):
        if isinstance(part, tuple):
            _fill(record[name], part)
        elif isinstance(part, np.ndarray) and part.dtype.names is not None:
            record[name] = part[0]
        else:
            record[name] = part


# ---- The variants ----

STOCK = {**OPTIONS, "_nrt": False}
_of_named = kernels(dispatch.kernel)
_step, _closed_loop = _of_named.step, _of_named.closed_loop


@dispatch.compiled_loop("design", "signals")
def run_named(design, state, signals, out):
    """Run the loop over NamedTuples."""
    _closed_loop(design, state, state.loop[0], state.averages[0], signals, out)


@control.register(Design)
def step_named(design, state, r, y):
    """Take one sample over NamedTuples; ``step_packed`` calls it."""
    return _step(design, state, state.loop[0], state.averages[0], r, y)


class Variant:
    """One way to write the loop: entry points for Python and for compiled code."""

    def __init__(self, name: str) -> None:
        design, state = parameters()
        if name == NAMED:
            self._named(design, state)
        else:
            self._records(design, state, name)

    def _named(self, design: Design, state: State) -> None:
        self.arguments = design, state

        def compile_run(*arguments: Any) -> Any:
            return dispatch.specialised(run_named, *arguments)

        def compile_step() -> Callable[[float, float], float]:
            packed = PackedController(design, state)
            compiled = entry_point(step_packed.uncached, packed)
            return lambda r, y: compiled(packed, r, y)

        self.compile_run, self.compile_step = compile_run, compile_step
        self.interpreted_run = run_named.py_func
        self.interpreted_step = lambda r, y: step_named(design, state, r, y)
        self.dispatched_step = None

    def _records(self, design: Design, state: State, name: str) -> None:
        options = OPTIONS | (KERNEL_OPTIONS if name == RECORDS_LINKED else {})
        found = kernels(register_jitable(**options))
        step, closed_loop = found.step, found.closed_loop
        passes = {} if name == RECORDS else {"pipeline_class": WithoutOverlaps}

        def run(design, state, signals, out):
            whole = state[0]
            closed_loop(design[0], whole, whole.loop, whole.averages, signals, out)

        def one(design, state, r, y):
            whole = state[0]
            return step(design[0], whole, whole.loop, whole.averages, r, y)

        self.arguments = as_record(design), as_record(state)
        entry = numba.njit(**STOCK, nogil=True, **passes)(run)
        short = numba.njit(**STOCK, **passes)(one)

        def compile_run(*arguments: Any) -> Any:
            return entry.compile(tuple(map(numba.typeof, arguments)))

        def compile_step() -> Callable[[float, float], float]:
            kinds = (*map(numba.typeof, self.arguments), numba.float64, numba.float64)
            compiled, (first, second) = short.compile(kinds), self.arguments
            return lambda r, y: compiled(first, second, r, y)

        first, second = self.arguments
        self.compile_run, self.compile_step = compile_run, compile_step
        self.interpreted_run = run
        self.interpreted_step = lambda r, y: one(first, second, r, y)
        self.dispatched_step = lambda r, y: short(first, second, r, y)


def signals() -> np.ndarray:
    """Return reference, noise and force of each sample."""
    rng = np.random.default_rng(0)
    time_of = np.arange(SAMPLES) * 1e-3
    force = np.where(time_of > 20.0, np.sin(0.5 * time_of), 0.0)
    return np.column_stack([np.sin(time_of), 1e-6 * rng.standard_normal(SAMPLES), force])


def compile_times(name: str) -> dict[str, float]:
    """Return the times to compile loop and step [s], after a compilation of something else."""
    numba.njit(lambda x: x + 1.0)(1.0)
    numba.njit(lambda x: x.sum())(np.ones(2))
    variant, inputs = Variant(name), signals()
    times = {}
    began = time.perf_counter()
    variant.compile_run(*variant.arguments, inputs, np.zeros(SAMPLES))
    times["run"] = time.perf_counter() - began
    began = time.perf_counter()
    variant.compile_step()
    times["step after it"] = time.perf_counter() - began
    return times


def fresh_compile_times(name: str) -> dict[str, float]:
    """Return the least compile times of fresh processes without a disk cache."""
    found = []
    for _ in range(COMPILATIONS):
        with tempfile.TemporaryDirectory() as folder:
            environment = os.environ | {"NUMBA_CACHE_DIR": folder, "QUELL_QUIET": "1"}
            command = [sys.executable, __file__, "--compile", name]
            done = subprocess.run(
                command, env=environment, check=True, capture_output=True, text=True
            )
        found.append(json.loads(done.stdout))
    return {key: min(each[key] for each in found) for key in found[0]}


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--compile", choices=VARIANTS, help="only compile, and print the times")
    parser.add_argument("--interpreted", action="store_true", help="without the compiled runs")
    parser.add_argument(
        "--trials", type=int, default=INTERPRETED_TRIALS, help="of which the best counts"
    )
    options = options_of(parser, interpreted=True, trials=1)
    if options.compile:
        print(json.dumps(compile_times(options.compile)))
        return
    inputs, rows = signals(), []
    few = inputs[:INTERPRETED]
    variants = {name: Variant(name) for name in VARIANTS}
    runs, steps, logs = {}, {}, {}
    for name, variant in variants.items():
        interpreted, compiled = np.zeros(INTERPRETED), np.zeros(SAMPLES)
        variant.interpreted_run(*variant.arguments, few, interpreted)
        logs[name] = interpreted
        if options.interpreted:
            continue
        fresh = Variant(name)
        run = fresh.compile_run(*fresh.arguments, inputs, compiled)
        run(*fresh.arguments, inputs, compiled)
        apart = np.max(np.abs(compiled[:INTERPRETED] - interpreted))
        assert apart < 1e-9, f"{name}: compiled and interpreted differ by {apart}"
        assert np.ptp(compiled) > 0.1, "the loop does nothing"
        runs[name], logs[name], steps[name] = (fresh, run), compiled, fresh.compile_step()
    apart = {name: float(np.max(np.abs(log - logs[NAMED]))) for name, log in logs.items()}
    assert max(apart.values()) < 1e-6, f"the variants differ: {apart}"
    out, short = np.zeros(SAMPLES), np.zeros(INTERPRETED)

    def timed(calls: dict[str, Callable[[], object]], trials: int) -> dict[str, float]:
        return dict(zip(calls, best(*calls.values(), trials=trials), strict=True))

    def compare(what: str, times: dict[str, float], count: int, bar: str) -> None:
        for name in times:
            if name != NAMED:
                ours, theirs = times[name] / count, times[NAMED] / count
                unit = f"{ours * 1e9:.0f} against {theirs * 1e9:.0f} ns"
                if count == 1:
                    unit = f"{ours:.2f} against {theirs:.2f} s"
                rows.append(row(f"{what}: {name}", ours / theirs, bar, unit))

    if not options.interpreted:
        compare(
            "compiled run, per sample",
            timed(
                {
                    name: lambda one=one, run=run: run(*one.arguments, inputs, out)
                    for name, (one, run) in runs.items()
                },
                TRIALS,
            ),
            SAMPLES,
            "≤ 1.05",
        )
    compare(
        "interpreted run, per sample",
        timed(
            {
                name: lambda one=one: one.interpreted_run(*one.arguments, few, short)
                for name, one in variants.items()
                if name in (NAMED, RECORDS)
            },
            options.trials,
        ),
        INTERPRETED,
        "≤ 1.25",
    )

    def repeated(step: Callable[[float, float], float]) -> Callable[[], None]:
        def many() -> None:
            for _ in range(CALLS):
                step(0.5, 0.1)

        return many

    if not options.interpreted:
        calls = {name: repeated(step) for name, step in steps.items()}
        dispatched = repeated(runs[RECORDS][0].dispatched_step)
        calls["records, stock Numba, by its dispatcher"] = dispatched
        compare("one step from Python", timed(calls, options.trials), CALLS, "")
        times = {name: fresh_compile_times(name) for name in VARIANTS}
        for key in times[NAMED]:
            each_time = {name: each[key] for name, each in times.items()}
            compare(f"compilation of {key}", each_time, 1, "")
    for name, distance in apart.items():
        print(f"u apart from that of NamedTuples, {name}: {distance:.1e}")
    shown = show(rows, f"Structured records / NamedTuples, Numba {numba.__version__}")
    write(options, {"u apart": apart, **shown})


if __name__ == "__main__":
    main()
