"""Compile the loops of a study before it runs, in two processes if there are several."""

from __future__ import annotations

import os
import signal
import warnings
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from threading import Thread
from typing import TypeAlias

from quell.controllers.base import Controller
from quell.kernels.cache import cache_path
from quell.kernels.sized import layout_of
from quell.plants.base import Plant
from quell.simulation.driver import Loop
from quell.simulation.sampled_scenario import SampledScenario
from quell.simulation.scenario import Scenario
from quell.simulation.simulate import simulate

Parts: TypeAlias = tuple[Plant, Controller]


def precompile(loops: Sequence[Parts]) -> int:
    """Compile loops, or load them from the disk cache; return how many were compiled.

    If there are several to compile, a second process takes some of them, and this one loads their
    code from the disk cache then. This one begins at once and takes what takes longest; the second
    one imports quell first and takes what takes least. As always with ``multiprocessing``, that
    process imports the main module: a script needs ``if __name__ == "__main__"``.
    """
    missing = [parts for parts in _distinct(loops) if not _is_compiled(parts)]
    todo = deque(sorted(missing, key=lambda parts: _size(_arguments(parts)), reverse=True))
    with ExitStack() as stack:
        if len(missing) > 1 and cache_path() is not None and (os.cpu_count() or 1) > 1:
            stack.enter_context(_SecondProcess(todo))
        while (parts := _first(todo)) is not None:
            _compile(parts)
    for parts in loops:
        _compile(parts)
    return len(missing)


def _first(todo: deque[Parts]) -> Parts | None:
    try:
        return todo.popleft()
    except IndexError:  # the other process may have taken the last one in this moment
        return None


def _compile(parts: Parts) -> None:
    plant, controller = parts
    simulate(plant, controller, _short(controller))


def _short(controller: Controller) -> Scenario:
    dt = controller.dt
    return Scenario(duration=10 * dt, rest_at=(5 * dt,))


def _distinct(loops: Sequence[Parts]) -> list[Parts]:
    """Return the loops without those whose code is that of an earlier one."""
    found: dict[object, Parts] = {}
    for parts in loops:
        found.setdefault(layout_of(_arguments(parts)), parts)
    return list(found.values())


def _arguments(parts: Parts) -> tuple[object, ...]:
    """Return the parameters and the state of a loop, for whose types it is compiled."""
    plant, controller = parts
    return plant.sampled(controller.dt), controller.parameters, controller.initial_state()


def _size(part: object) -> int:
    """Return the number of values in parameters and state of a loop, with which its code grows."""
    return sum(map(_size, part)) if isinstance(part, tuple) else 1


def _is_compiled(parts: Parts) -> bool:
    plant, controller = parts
    scenario = SampledScenario.of(_short(controller), plant, controller, None)
    loop = Loop(plant, plant.sampled(controller.dt), controller, scenario, interpret=False)
    return loop.is_compiled(scenario.segment(0, 1))


class _SecondProcess:
    """A context in which another process compiles the last of ``todo``, until it is empty."""

    def __init__(self, todo: deque[Parts]) -> None:
        context = get_context("spawn")
        self._todo = todo
        self._connection, self._other_end = context.Pipe()
        self._process = context.Process(target=_serve, args=(self._other_end,), daemon=True)
        self._thread = Thread(target=self._take, daemon=True)

    def __enter__(self) -> None:
        self._process.start()
        self._other_end.close()
        self._thread.start()

    def __exit__(self, *error: object) -> None:
        self._todo.clear()
        if error[0] is not None:
            self._process.terminate()
        self._thread.join()
        self._connection.close()
        self._process.join()

    def _take(self) -> None:
        # This ends when nothing is left to do. What can't be sent to another process, or ends it,
        # this process compiles in the end, and reports why it can't.
        with suppress(Exception):
            while True:
                self._connection.send(self._todo.pop())
                self._connection.recv()


def _serve(connection: Connection) -> None:
    """Compile what comes through the connection, until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process deals with it, and warns
    warnings.simplefilter("ignore")
    with suppress(EOFError):
        while True:
            parts = connection.recv()
            with suppress(Exception):  # the first process meets it, too
                _compile(parts)
            connection.send(None)
    os._exit(0)  # all code is in the cache; Python would take half a second to clear its memory
