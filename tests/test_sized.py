"""Compiled code that knows shapes and constants of its arguments."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import quell as ql
from quell.kernels.dispatch import (
    call_specialised,
    compiled,
    compiled_loop,
    interpreted,
    overlap,
    specialised,
)
from quell.kernels.sized import Constant, ConstantFlag, Flag, Size, SizedArray, layout_of, type_of
from quell.simulation.driver import run_block

from .cases import cases

pytestmark = pytest.mark.compiled


class Filter(NamedTuple):
    """Parameters: an array, constants and a number."""

    gains: np.ndarray
    order: Size
    negative: Flag
    offset: float
    shift: int


FILTER = Filter(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), 2, True, 0.5, 7)


@compiled
def output(design: Filter) -> float:
    """Use all fields."""
    total = design.offset + design.shift
    for i in range(design.order):
        for j in range(design.gains.shape[1]):
            total += (i + 1) * design.gains[i, j]
    return -total if design.negative else total


@pytest.mark.trial
@cases(
    "design",
    [
        FILTER,
        FILTER._replace(order=1),
        FILTER._replace(negative=False, shift=-(2**40)),
        FILTER._replace(gains=np.arange(24.0).reshape(4, 6)[::2, ::-3]),
        FILTER._replace(gains=np.asfortranarray(FILTER.gains)),
        FILTER._replace(gains=np.arange(600.0).reshape(2, 300)),
        FILTER._replace(gains=np.zeros((2, 0))),
    ],
)
def test_compiled_and_interpreted_code_agree(design: Filter) -> None:
    """Of any shape, contiguous or not, small or large."""
    assert call_specialised(output, design) == interpreted(output)(design)


@pytest.mark.trial
def test_other_values_are_not_compiled_for_but_other_shapes_and_constants_are() -> None:
    """Only fields that are annotated as constants are."""
    same = FILTER._replace(gains=FILTER.gains + 1.0, offset=2.0, shift=3)
    assert specialised(output, same) is specialised(output, FILTER)
    others = [
        FILTER._replace(gains=np.zeros((2, 5))),
        FILTER._replace(order=1),
        FILTER._replace(negative=False),
    ]
    assert len({id(specialised(output, each)) for each in (FILTER, *others)}) == 4


def test_only_small_arrays_in_tuples_have_known_shapes() -> None:
    """A buffer of another length is not compiled for."""
    small, large = np.zeros(16), np.zeros(17 * 16)
    kinds = {type(type_of(array)) for array in (small, large)}
    assert not kinds & {SizedArray}
    assert type_of(FILTER._replace(gains=large)) == type_of(FILTER._replace(gains=np.zeros(1000)))
    assert type_of(FILTER._replace(gains=small)) != type_of(FILTER._replace(gains=np.zeros(15)))
    assert layout_of(large) == layout_of(np.zeros(1000)) == layout_of(small)
    parts = type_of(FILTER).types
    assert [type(part) for part in parts[:3]] == [SizedArray, Constant, ConstantFlag]


class Memory(NamedTuple):
    """A state."""

    x: np.ndarray
    copy: np.ndarray


@compiled_loop("gain")
def shift(gain: np.ndarray, memory: Memory) -> None:
    """Write a value that the next iteration reads, if the arrays overlap."""
    for i in range(memory.x.size):
        memory.copy[i] = gain[i] * memory.x[i]


def test_overlapping_arrays_have_code_of_their_own() -> None:
    """It gives what the interpreted function gives."""
    for make in (lambda a: Memory(a[:4], a[4:]), lambda a: Memory(a[:4], a[1:5])):
        found = []
        for run in (call_specialised, lambda function, *args: interpreted(function)(*args)):
            values = np.arange(1.0, 9.0)
            run(shift, np.full(4, 3.0), make(values))
            found.append(values)
        np.testing.assert_array_equal(*found)
    assert len(shift.signatures) == len(shift.with_overlaps.signatures) == 1


def test_overlaps_are_found_where_something_is_written() -> None:
    """Also in memory that another object owns; parameters may share theirs."""
    a, b = np.zeros(8), np.zeros(8)
    assert not overlap([a], [b[:4], b[4:]])
    assert overlap([a], [b[:5], b[4:]])
    assert overlap([a], [b, b])
    assert overlap([a[2:3]], [b, a])
    assert overlap([a[6:], b], [a[:7]])
    assert not overlap([a, a[2:]], [b])
    buffer = bytearray(64)
    assert overlap([np.frombuffer(buffer)], [b, np.frombuffer(buffer)[7:]])
    assert not overlap([np.frombuffer(buffer)[:7]], [b, np.frombuffer(buffer)[7:]])


@pytest.mark.trial
def test_new_parameters_of_a_loop_are_not_compiled_for() -> None:
    """Neither by a simulation nor by a step; a loop of another order is."""

    def run(k: float, omega: float) -> tuple[int, Any]:
        controller = ql.ADRC(ql.ESO.model_free(4, k, 4.0 * omega, 1e-2), omega)
        plant = ql.plants.two_mass_spring(k=k)  # a loop that other tests compile
        ql.simulate(plant, controller, ql.Scenario(1.0, duration=0.05))
        controller.step(1.0, 0.0)
        return len(run_block.signatures), controller._step

    first, step = run(1.0, 2.0)
    assert run(0.5, 3.0) == (first, step)
    smaller = ql.ADRC(ql.ESO.model_free(2, 1.0, 8.0, 1e-2), 2.0)
    smaller.step(1.0, 0.0)
    assert smaller._step != step


@pytest.mark.trial
def test_loops_are_compiled_once_for_all_that_share_code(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A second process takes some of several; the second study finds all in the disk cache, and so does its first step."""
    script = """
from numba.core.event import install_recorder
import quell as ql
from quell.kernels.dispatch import compilations
from quell.simulation.driver import run_block
from quell.simulation.simulate import precompile

if __name__ == "__main__":
    plant = ql.plants.LinearPlant.of(([1.0], [1.0, 1.0]))
    pids = [ql.baselines.PID(gain, dt=0.01) for gain in (1.0, 2.0)]
    loops = [(plant, pid) for pid in pids]
    loops.append((plant, ql.baselines.PID(1.0, 1.0, 0.1, tf=0.05, dt=0.01)))
    print(precompile(loops), len(run_block.signatures), compilations(run_block) <= 2, end=" ")
    with install_recorder("numba:compile") as recorder:
        u = pids[0].step(1.0, 0.0)
    print(u, "compiled" if recorder.buffer else "loaded")
"""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    file = tmp_path / "study.py"
    file.write_text(script)

    def study() -> str:
        command = [sys.executable, str(file)]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    assert [study(), study()] == ["2 2 True 1.0 compiled", "0 2 True 1.0 loaded"]
