"""Python models at work, and the one function by which compiled loops call them.

A loop's memory can only hold numbers, so it holds that of its instance. The instance is a copy of the user's model that belongs to this
loop; it is dropped when the array with its number is. Nothing that goes wrong here may leave this file as an exception: the caller is
compiled code, which has no way to pass one on.
"""

from __future__ import annotations

import _thread
import copy
import ctypes
import itertools
import math
import sys
import threading
import warnings
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np

from quell.learners.adapters.worker import Worker
from quell.types import Matrix, Status, Vector

# After so many failures in a row a model is left alone.
_PATIENCE = 3
_LATE, _FAILED = int(Status.LEARNER_LATE), int(Status.LEARNER_FAILED)

# Places in what a loop is answered.
PREDICTION, STATUS, UNTIL, GIVEN_UP = range(4)

INSTANCES: dict[int, Instance] = {}
_NUMBERS = itertools.count(1)


class Instance:
    """One copy of a model, called by one loop.

    Parameters
    ----------
    source
        what is copied, with ``learn`` and ``predict``; it is never changed.
    name
        what it is called in messages.
    budget
        how long the loop waits for an answer [s]; None to call the model in the loop.
    tell
        called with the text of each problem.
    """

    def __init__(
        self, source: Any, name: str, budget: float | None, tell: Callable[[str], None]
    ) -> None:
        self.source, self.name, self.budget, self.tell = source, name, budget, tell
        self.model = copy.deepcopy(source)
        self.failures = 0
        self.told = False
        self.worker = None if budget is None else Worker()

    def ask(self, features: Matrix, targets: Vector, now: Vector) -> tuple[float | None, int]:
        """Let the model learn and predict; return its prediction, None where there is no new one, and status flags."""
        if self.worker is None or self.budget is None:
            return self._judged(self._attempt(features, targets, now))
        value: float | None = None
        if self.worker.busy:
            late = self.worker.answer(0.0)
            if late is None:
                return (
                    None,
                    _LATE,
                )  # what was gathered meanwhile is dropped: a model that is late would only get later
            value, failed = self._judged(late)
            if failed:
                return value, failed
        self.worker.start(lambda: self._attempt(features, targets, now))
        answer = self.worker.answer(self.budget)
        return (value, _LATE) if answer is None else self._judged(answer)

    def copied(self) -> tuple[Any, int]:
        """Return a copy of the model, when it has ended what it is at, and its failures in a row."""
        if self.worker is not None:
            self.worker.rest()
        return copy.deepcopy(self.model), self.failures

    def replaced(self, model: Any, failures: int) -> None:
        """Go on with a copy of ``model``."""
        if self.worker is not None:
            self.worker.rest()
            self.worker.answer(0.0)  # it belongs to the model that goes
        self.model, self.failures = copy.deepcopy(model), failures

    @property
    def given_up(self) -> bool:
        """Whether it has failed too often to be asked again."""
        return self.failures >= _PATIENCE

    def _attempt(self, features: Matrix, targets: Vector, now: Vector) -> tuple[float, str]:
        """Return the prediction, or NaN and what went wrong."""
        try:
            self.model.learn(features, targets)
            return finite_number(self.model.predict(now)), ""
        except KeyboardInterrupt:
            # The loop has to come to the end of its block before it can be interrupted: till then the model keeps out of the way.
            self.failures = _PATIENCE
            threading.Timer(0.05, _thread.interrupt_main).start()
            return math.nan, f"learner {self.name} was interrupted"
        except BaseException as error:
            problem = f"learner {self.name} raised {type(error).__name__}: {error}"
        try:
            self.model = copy.deepcopy(self.source)
        except BaseException as error:
            self.failures = _PATIENCE
            problem += f"; it can't be copied anew ({type(error).__name__}: {error})"
        return math.nan, problem

    def _judged(self, answer: tuple[float, str]) -> tuple[float, int]:
        value, problem = answer
        if not problem:
            self.failures = 0
            return value, 0
        self.failures += 1
        if self.given_up:
            problem += f"; it is left alone after {_PATIENCE} failures in a row, until the controller is reset"
        self.tell(problem)
        if not self.told or self.given_up:
            self.told = True
            _warn(problem)
        return math.nan, _FAILED


def finite_number(value: Any) -> float:
    """Return a prediction as a float.

    Raises
    ------
    ValueError
        where it is not one finite number.
    """
    if not isinstance(value, float):
        array = np.asarray(value)
        if array.size != 1 or array.dtype.kind not in "iuf":
            raise ValueError(f"predicted {_brief(value)}: a prediction must be one finite number")
        value = float(array.reshape(()))
    if not math.isfinite(value):
        raise ValueError(f"predicted {value!r}: a prediction must be one finite number")
    return float(value)


def enter(instance: Instance) -> Vector:
    """Enter an instance into the table; return the array (1,) with its number, whose end is the instance's end."""
    number = next(_NUMBERS)
    INSTANCES[number] = instance
    holder = np.full(1, float(number))
    weakref.finalize(holder, _leave, number)
    return holder


def instance_of(holder: Vector) -> Instance:
    """Return the instance whose number ``holder`` has."""
    return INSTANCES[int(holder[0])]


def _leave(number: int) -> None:
    instance = INSTANCES.pop(number, None)
    if instance is not None and instance.worker is not None:
        instance.worker.end()


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _warn(problem: str) -> None:
    try:
        warnings.warn(problem, RuntimeWarning, stacklevel=2)
    except RuntimeWarning:  # where warnings are errors: it could go nowhere from here
        print(problem, file=sys.stderr)


def _array(address: int, *shape: int) -> Any:
    """Return a view of the float64 numbers at an address."""
    size = math.prod(shape)
    buffer: Any = (ctypes.c_double * size).from_address(address)
    return np.frombuffer(buffer).reshape(shape)


def _serve(
    holder: int, features: int, targets: int, count: int, width: int, now: int, answer: int
) -> None:
    """Answer a loop; all arrays are given by their address, and copied, as a model may keep what it is shown."""
    reply = None
    try:
        reply = _array(answer, 4)
        instance = INSTANCES[int(_array(holder, 1)[0])]
        value, status = instance.ask(
            _array(features, count, width).copy(),
            _array(targets, count).copy(),
            _array(now, width).copy(),
        )
        if value is not None:
            reply[PREDICTION] = value
        reply[STATUS] = status
        reply[GIVEN_UP] = instance.given_up
    except BaseException as error:
        if reply is not None:
            reply[PREDICTION], reply[STATUS], reply[GIVEN_UP] = math.nan, _FAILED, 1.0
        print(f"quell: a learner can't be asked ({type(error).__name__}: {error})", file=sys.stderr)


_POINTER, _COUNT = ctypes.c_void_p, ctypes.c_int64
_SERVE = ctypes.CFUNCTYPE(None, _POINTER, _POINTER, _POINTER, _COUNT, _COUNT, _POINTER, _POINTER)(
    _serve
)


def address() -> int:
    """Return where compiled code finds the function that asks an instance; it is another in each process."""
    return int(ctypes.cast(_SERVE, ctypes.c_void_p).value or 0)
