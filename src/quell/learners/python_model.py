"""``PythonModel``: a learner whose model is any Python object.

Copies of Python models that learn, and the function by which compiled loops call them.

A loop's memory contains only numbers, so it contains the number of its instance. The instance is a
copy of the user's model that belongs to one loop; it is deleted together with the array that holds
its number. No function lets an exception out: its caller is compiled code and can't handle one.

Kernels of a learner whose model is a Python object.

They collect pairs in the compiled loop and call the model every ``period`` samples.
"""

from __future__ import annotations

import _thread
import copy
import ctypes
import itertools
import math
import queue
import sys
import threading
import warnings
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np

from quell import checks
from quell.checks import Described
from quell.features import Features, State
from quell.features.base import checked_design
from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.sized import Buffer
from quell.kernels.user_functions import call
from quell.learners.base import (
    adapt,
    coefficients,
    commit,
    forget,
    learner_flags,
    no_coefficients,
    predict,
    restart,
    write_features,
)
from quell.learners.online import Online, OnlineDesign, OnlineMemory, has_pairs, infer, learn
from quell.observers.eso import ESO
from quell.types import Matrix, Status, Vector

# ---- A separate thread for a model that may take longer than the loop can wait ----


class Worker:
    """A thread that runs one job at a time. It starts with the first job."""

    def __init__(self) -> None:
        self.busy = False  # true while there is a job whose result was not taken
        self._jobs: queue.SimpleQueue[Callable[[], Any] | None] = queue.SimpleQueue()
        self._done = threading.Event()
        self._results: list[Any] = []
        self._thread: threading.Thread | None = None

    def start(self, job: Callable[[], Any]) -> None:
        """Start a job, which must not raise."""
        if self._thread is None:
            # The thread must not refer to the worker: then neither would ever be deleted.
            self._thread = threading.Thread(
                target=_run,
                args=(self._jobs, self._done, self._results),
                name="quell learner",
                daemon=True,
            )
            self._thread.start()
        self._done.clear()
        self.busy = True
        self._jobs.put(job)

    def result(self, timeout: float) -> Any:
        """Return the job's result, or None if there is none within ``timeout`` [s]."""
        if not self.busy or not self._done.wait(timeout):
            return None
        self.busy = False
        return self._results.pop()

    def wait(self) -> None:
        """Wait until no job is running."""
        if self.busy:
            self._done.wait()

    def stop(self) -> None:
        """End the thread after its current job."""
        self._jobs.put(None)


def _run(
    jobs: queue.SimpleQueue[Callable[[], Any] | None], done: threading.Event, results: list[Any]
) -> None:
    while True:
        job = jobs.get()
        if job is None:
            return
        results.append(job())
        del job
        done.set()


# ---- Copies of Python models that learn, and the function by which compiled loops call them ----

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
    except RuntimeWarning:  # warnings may be errors, and compiled code can't handle them
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


# ---- Kernels of a learner whose model is a Python object ----

_FAILED_KERNELS = int(Status.LEARNER_FAILED)


class PairsDesign(NamedTuple):
    """Parameters of a model that only collects its pairs."""

    size: int  # number of pairs
    width: int  # number of features p


class PairsMemory(NamedTuple):
    """State of a model that only collects its pairs."""

    features: Buffer  # (size, p)
    targets: Buffer  # (size,)
    filled: Vector  # (1,): number of pairs


class PythonDesign(NamedTuple):
    """Parameters of a learner whose model is a Python object."""

    online: OnlineDesign  # features, scaling and lag
    period: int  # samples between two calls
    address: int  # address of the function that calls the model


class PythonMemory(NamedTuple):
    """State of a learner whose model is a Python object."""

    online: OnlineMemory
    answer: Vector  # (4,), see ``instances.PREDICTION`` and the other indices
    model: Vector  # (1,): number of the instance that learns


class Pairs:
    """A description of a model that only collects ``size`` pairs."""

    def __init__(self, size: int) -> None:
        self.size = size

    def design(self, features: int, dt: float) -> PairsDesign:
        """Return the parameters for the number of features."""
        return PairsDesign(self.size, features)

    def memory(self, parameters: PairsDesign) -> PairsMemory:
        """Return an empty batch."""
        size = parameters.size
        return PairsMemory(np.zeros((size, parameters.width)), np.zeros(size), np.zeros(1))


@infer.register(PairsDesign)
def _infer(model: PairsDesign, memory: PairsMemory, features: Vector) -> float:
    return 0.0


@learn.register(PairsDesign)
def _learn(model: PairsDesign, memory: PairsMemory, features: Vector, target: float) -> None:
    k = int(memory.filled[0])
    if k == model.size or not is_finite(target) or not _finite(features):
        return
    for j in range(features.size):
        memory.features[k, j] = features[j]
    memory.targets[k] = target
    memory.filled[0] = k + 1.0


@kernel
def _finite(values: Vector) -> bool:
    finite = True
    for i in range(values.size):
        finite = finite and is_finite(values[i])
    return finite


@adapt.register(PythonDesign)
def _adapt(
    learner: PythonDesign,
    memory: PythonMemory,
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    online, answer = memory.online, memory.answer
    if answer[DISABLED] != 0.0:
        answer[PREDICTION] = 0.0
        answer[STATUS] = _FAILED_KERNELS
        return
    adapt(learner.online, online, estimates, y, u_before, f_plain)
    if not has_pairs(learner.online, online):
        answer[STATUS] = 0.0
        return
    answer[COUNTDOWN] -= 1.0
    if answer[COUNTDOWN] > 0.0:
        return
    now, batch = online.features, online.model
    write_features(learner.online.inputs, online, estimates, u_before, now)
    if batch.filled[0] > 0.0 and _finite(now):
        address, filled = learner.address, int(batch.filled[0])
        call(address, memory.model, batch.features, batch.targets, filled, now.size, now, answer)
        batch.filled[0] = 0.0
        answer[COUNTDOWN] = learner.period


@predict.register(PythonDesign)
def _predict(
    learner: PythonDesign, memory: PythonMemory, estimates: Vector, u_before: float
) -> tuple[float, float]:
    scale = memory.online.scale
    return memory.answer[PREDICTION] * scale[scale.size - 1], 0.0


@commit.register(PythonDesign)
def _commit(
    learner: PythonDesign, memory: PythonMemory, estimates: Vector, u: float, f_learned: float
) -> None:
    commit(learner.online, memory.online, estimates, u, f_learned)


@restart.register(PythonDesign)
def _restart(learner: PythonDesign, memory: PythonMemory) -> None:
    restart(learner.online, memory.online)
    memory.online.model.filled[0] = 0.0
    memory.answer[PREDICTION] = memory.answer[COUNTDOWN] = 0.0


@forget.register(PythonDesign)
def _forget(learner: PythonDesign, memory: PythonMemory) -> None:
    forget(learner.online, memory.online)
    restart(learner, memory)
    now, batch = memory.online.features, memory.online.model
    # Without pairs the call means that the model is to start again.
    call(
        *(learner.address, memory.model, batch.features, batch.targets, 0),
        *(now.size, now, memory.answer),
    )


@learner_flags.register(PythonDesign)
def _trouble(learner: PythonDesign, memory: PythonMemory) -> int:
    return int(memory.answer[STATUS])


coefficients.register(PythonDesign)(no_coefficients)


# ---- A learner whose model is any Python object ----


class Options(TypedDict, total=False):
    """Options of all learners whose model is a Python object; see ``PythonModel``."""

    features: Features | None
    period: int
    budget: float | None
    frequency: float | None
    scale: Any


def check_methods(name: str, value: Any, methods: tuple[str, ...], rule: str) -> None:
    """Raise a ``ValueError`` with ``rule`` unless the argument ``name`` has these methods."""
    found = all(callable(getattr(value, method, None)) for method in methods)
    if isinstance(value, type) or not found:
        raise ValueError(f"{name} = {value!r}: {rule}")


@dataclass(frozen=True)
class Snapshot:
    """A copy of a model that learns, for a controller's ``state``."""

    model: Any
    failures: int


class PythonModel(Described):
    """A learner whose model is a Python object.

    The loop stays compiled. Every ``period`` samples it calls the model with the pairs collected
    since the last call and with the newest features, and holds the prediction until the next call.
    Pairs are made as for ``Online``: the features are delayed by the observer's lag, and features
    and target are scaled to about [−1, 1].

    Each controller state has its own deep copy of the model, so the object given here never
    changes. A model that draws random numbers should have its own generator with a seed; else two
    runs differ.

    If a model raises, or predicts something other than a finite number, its answer is dropped: the
    step reports ``Status.LEARNER_FAILED``, a ``RuntimeWarning`` and ``last_problem`` describe the
    problem, and a fresh copy continues. After three failures in a row the model is disabled, with a
    prediction of zero, until the controller is reset. ``design`` raises ``ValueError`` if a copy
    of the model fails to learn and predict in a trial with a few pairs.

    Parameters
    ----------
    model
        an object with ``learn(features, targets)``, of shapes (m, p) and (m,), m from 1 to
        ``period``, and ``predict(features)``, which returns a number for features of shape (p,).
    features : Features, optional
        blocks of features; the estimated state by default.
    period : int, optional
        samples between two calls, 10 by default. A prediction is up to one period old: ``period ·
        dt`` should be well below the observer's lag, which is about ``(n + 1) / omega_o``.
    budget : float, optional
        longest time that the loop waits for an answer [s]. By default the model is called in the
        loop's thread, which gives the same bits every time: right for simulation. With a budget it
        runs in its own thread. A late answer is taken at the first call after it has come; until
        then the last prediction is held, new pairs are dropped, and steps report
        ``Status.LEARNER_LATE``.
    frequency : float, optional
        a frequency of the plant [rad/s], for the automatic scaling; ``omega_c`` of the controller
        by default.
    scale : array, optional
        what x_1 … x_n, u and f are divided by, (n + 2,); found automatically by default.
    """

    external_fields = ("model",)  # the field of the memory that refers to the model

    def __init__(self, model: Any, **options: Unpack[Options]) -> None:
        rule = "must be an object with learn(features, targets) and predict(features)"
        check_methods("model", model, ("learn", "predict"), rule)
        self._set_up(type(model).__name__, model, **options)

    def described(self) -> dict[str, Any]:
        """Return what ``repr`` prints: the model, its features, and when it is called."""
        found = {"model": self._source, "features": self._online.features, "period": self.period}
        more = {"budget": self.budget, "frequency": self.frequency, "scale": self.scale}
        return found | {name: value for name, value in more.items() if value is not None}

    def _set_up(
        self,
        name: str,
        model: Any,
        features: Features | None = None,
        period: int = 10,
        budget: float | None = None,
        frequency: float | None = None,
        scale: Any = None,
    ) -> None:
        self.name, self.frequency, self.scale = name, frequency, scale
        self.period = checks.whole("period", period, 1)
        self.budget = checks.optional(checks.positive, "budget", budget, "s")
        self._online = Online(
            Pairs(self.period),
            State() if features is None else features,
            frequency=frequency,
            scale=scale,
            bias_bandwidth=0.0,
        )
        try:
            self._source = copy.deepcopy(model)
        except Exception as error:
            raise ValueError(
                f"{name}: must be something copy.deepcopy can copy "
                f"({type(error).__name__}: {error})"
            ) from error
        self.last_problem = ""
        """The text of the last problem that a loop had with the model; empty if there was none."""
        self._tried_widths: set[int] = set()

    def design(self, observer: ESO, omega_c: float) -> PythonDesign:
        """Return the parameters for an observer and the controller's bandwidth [rad/s].

        The model is tried on a copy first.
        """
        checked_design(self._online.features, observer.order)
        self._try(self._online.features.names(observer.order))
        online = self._online.design(observer, omega_c)
        return PythonDesign(online, self.period, callback_address())

    def memory(self, parameters: PythonDesign) -> PythonMemory:
        """Return the state before anything is learned, with its own copy of the model."""
        instance = Instance(self._source, self.name, self.budget, self._note)
        return PythonMemory(self._online.memory(parameters.online), np.zeros(4), register(instance))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names: the model has no coefficients with a meaning for the user."""
        return ()

    def trained(self, memory: PythonMemory) -> Any:
        """Return a copy of the model in a state: ``learner.trained(run.final_state.learner)``.

        It learned in scaled units: features and target were divided by ``memory.online.scale``.
        """
        return self._unwrapped(instance_of(memory.model).copy_model()[0])

    def snapshot(self, memory: PythonMemory) -> dict[str, Any]:
        """Return a copy of the model that learns, by the name of its field in the memory.

        It is an object of this process; quell never pickles or unpickles it.
        """
        return {"model": Snapshot(*instance_of(memory.model).copy_model())}

    def recall(self, memory: PythonMemory, snapshots: Mapping[str, Any]) -> None:
        """Continue with copies of what ``snapshot`` returned."""
        snapshot = snapshots["model"]
        if not isinstance(snapshot, Snapshot):
            raise ValueError(
                f"state of {self.name}: must be what controller.state gave, in this process, "
                f"got {type(snapshot).__name__}"
            )
        instance_of(memory.model).replace_model(snapshot.model, snapshot.failures)

    def _unwrapped(self, model: Any) -> Any:
        """Return the user's model from the object that learns."""
        return model

    def _note(self, problem: str) -> None:
        self.last_problem = problem

    def _try(self, names: tuple[str, ...]) -> None:
        """Let a copy of the model learn one pair, then a period's, and predict after each."""
        width = len(names)
        if width in self._tried_widths:
            return
        wave = np.sin(1.0 + np.arange((self.period + 1) * width)).reshape(self.period + 1, width)
        step = "learn"
        try:
            model = copy.deepcopy(self._source)
            for rows in (wave[:1], wave[1:]):
                step = "learn"
                model.learn(rows.copy(), 0.5 * rows[:, 0])
                step = "predict"
                finite_number(model.predict(wave[0].copy()))
        except ImportError:
            raise
        except Exception as error:
            raise ValueError(
                f"{self.name}: {step} fails on a trial with {type(error).__name__}: {error}. "
                f"It is shown {width} features ({', '.join(names)}) and must learn and predict one "
                "number: fit it to that, or choose other features"
            ) from error
        self._tried_widths.add(width)
