"""Copies of Python models that learn, and the function by which compiled loops call them.

A loop's memory contains only numbers, so it contains the number of its instance. The instance is a
copy of the user's model that belongs to one loop; it is deleted together with the array that holds
its number. No exception may leave this file: the caller is compiled code and cannot handle one.
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

# Failures in a row after which a model is disabled; chosen by hand.
_MAX_FAILURES = 3
# Delay after which an interrupt is passed on to the main thread [s]: the compiled loop has to
# return from the model first, which takes more than 50 ms on a busy machine; chosen by hand.
_INTERRUPT_DELAY = 0.25
_LATE, _FAILED = int(Status.LEARNER_LATE), int(Status.LEARNER_FAILED)

# Indices of the array in which a loop gets its answer: last prediction, scaled; status flags;
# samples until the next call; 1 once the model is disabled.
PREDICTION, STATUS, COUNTDOWN, DISABLED = range(4)

INSTANCES: dict[int, Instance] = {}
_NUMBERS = itertools.count(1)


class Instance:
    """One copy of the model ``source``, called by one loop.

    The loop waits for an answer for ``budget`` [s] at most; with None the model is called in the
    loop's thread. ``report`` is called with the text of each problem, in which ``name`` stands for
    the model.
    """

    def __init__(
        self, source: Any, name: str, budget: float | None, report: Callable[[str], None]
    ) -> None:
        self.source, self.name, self.budget, self.report = source, name, budget, report
        self.model = copy.deepcopy(source)
        self.failures = 0
        self.starts_again = False  # whether the next job begins with a new copy of ``source``
        self.warned = False
        self.worker = None if budget is None else Worker()

    def update(self, features: Matrix, targets: Vector, now: Vector) -> tuple[float | None, int]:
        """Let the model learn, and predict from the features ``now``.

        Return the prediction, or None if there is no new one, and status flags.
        """
        if self.worker is None or self.budget is None:
            return self._checked(self._call(features, targets, now))
        value: float | None = None
        if self.worker.busy:
            late = self.worker.result(0.0)
            if late is None:  # the new pairs are dropped: with them the model would be later still
                return None, _LATE
            value, failed = self._checked(late)
            if failed:
                return value, failed
        self.worker.start(lambda: self._call(features, targets, now))
        answer = self.worker.result(self.budget)
        return (value, _LATE) if answer is None else self._checked(answer)

    def copy_model(self) -> tuple[Any, int]:
        """Return a copy of the model, after its current job, and its failures in a row."""
        if self.worker is not None:
            self.worker.wait()
        return copy.deepcopy(self.model), self.failures

    def replace_model(self, model: Any, failures: int) -> None:
        """Continue with a copy of ``model``."""
        if self.worker is not None:
            self.worker.wait()
            self.worker.result(0.0)  # discard the result of the old model
        self.model, self.failures = copy.deepcopy(model), failures
        self.starts_again = False

    @property
    def disabled(self) -> bool:
        """True if the model has failed too often to be called again."""
        return self.failures >= _MAX_FAILURES

    def _call(self, features: Matrix, targets: Vector, now: Vector) -> tuple[float, str]:
        """Return the prediction and an empty text, or NaN and a description of the problem."""
        try:
            if self.starts_again:
                self.starts_again = False
                self.model = copy.deepcopy(self.source)
            self.model.learn(features, targets)
            return finite_number(self.model.predict(now)), ""
        except KeyboardInterrupt:
            # The loop can be interrupted only at the end of its block: disable the model until
            # then.
            self.failures = _MAX_FAILURES
            threading.Timer(_INTERRUPT_DELAY, _thread.interrupt_main).start()
            return math.nan, f"learner {self.name} was interrupted"
        except BaseException as error:
            problem = f"learner {self.name} raised {type(error).__name__}: {error}"
        try:
            self.model = copy.deepcopy(self.source)
        except BaseException as error:
            self.failures = _MAX_FAILURES
            problem += f"; it cannot be copied again ({type(error).__name__}: {error})"
        return math.nan, problem

    def _checked(self, answer: tuple[float, str]) -> tuple[float, int]:
        """Return prediction and status flags; report the problem, if any."""
        value, problem = answer
        if not problem:
            self.failures = 0
            return value, 0
        self.failures += 1
        if self.disabled:
            problem += (
                f"; it is disabled after {_MAX_FAILURES} failures in a row, "
                "until the controller is reset"
            )
        self.report(problem)
        if not self.warned or self.disabled:
            self.warned = True
            _warn(problem)
        return math.nan, _FAILED


def finite_number(value: Any) -> float:
    """Return a prediction as a float, or raise a ``ValueError`` if it is not one finite number."""
    if not isinstance(value, float):
        array = np.asarray(value)
        if array.size != 1 or array.dtype.kind not in "iuf":
            text = repr(value)
            text = text if len(text) <= 60 else f"{text[:57]}..."
            raise ValueError(f"predicted {text}: a prediction must be one finite number")
        value = float(array.reshape(()))
    if not math.isfinite(value):
        raise ValueError(f"predicted {value!r}: a prediction must be one finite number")
    return float(value)


def register(instance: Instance) -> Vector:
    """Return an array (1,) with a number for the instance; they are deleted together."""
    number = next(_NUMBERS)
    INSTANCES[number] = instance
    holder = np.full(1, float(number))
    weakref.finalize(holder, _unregister, number)
    return holder


def instance_of(holder: Vector) -> Instance:
    """Return the instance whose number is in ``holder``."""
    return INSTANCES[int(holder[0])]


def _unregister(number: int) -> None:
    instance = INSTANCES.pop(number, None)
    if instance is not None and instance.worker is not None:
        instance.worker.stop()


def _warn(problem: str) -> None:
    try:
        warnings.warn(problem, RuntimeWarning, stacklevel=2)
    except RuntimeWarning:  # warnings are errors, and no exception may leave this file
        print(problem, file=sys.stderr)


def _array(address: int, *shape: int) -> Any:
    """Return a view of the float64 numbers at an address."""
    size = math.prod(shape)
    buffer: Any = (ctypes.c_double * size).from_address(address)
    return np.frombuffer(buffer).reshape(shape)


def _call_instance(
    holder: int, features: int, targets: int, count: int, width: int, now: int, answer: int
) -> None:
    """Call the instance of a loop with copies of the arrays at these addresses.

    Without pairs, ``count = 0``, it starts again at the next call.
    """
    reply = None
    try:
        reply = _array(answer, 4)
        instance = INSTANCES[int(_array(holder, 1)[0])]
        if count == 0:
            instance.starts_again = True
            return
        value, status = instance.update(
            _array(features, count, width).copy(),
            _array(targets, count).copy(),
            _array(now, width).copy(),
        )
        if value is not None:
            reply[PREDICTION] = value
        reply[STATUS] = status
        reply[DISABLED] = instance.disabled
    except BaseException as error:
        if reply is not None:
            reply[PREDICTION], reply[STATUS], reply[DISABLED] = math.nan, _FAILED, 1.0
        print(f"quell: cannot call a learner ({type(error).__name__}: {error})", file=sys.stderr)


_POINTER, _COUNT = ctypes.c_void_p, ctypes.c_int64
_CALLBACK = ctypes.CFUNCTYPE(
    None, _POINTER, _POINTER, _POINTER, _COUNT, _COUNT, _POINTER, _POINTER
)(_call_instance)


def callback_address() -> int:
    """Return the address at which compiled code calls an instance; it differs between processes."""
    return int(ctypes.cast(_CALLBACK, ctypes.c_void_p).value or 0)
