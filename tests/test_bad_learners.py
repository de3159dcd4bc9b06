"""Learners, models and features of the user's own that do not do as they should: named, or held by the guard."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest

import quell as ql
from quell.features.base import Features, unit, write
from quell.guard import Reason
from quell.kernels.sized import Scalars
from quell.learners.base import adapt, coefficients, commit, predict, restart
from quell.learners.online import infer, learn
from quell.types import Status

from .cases import cases
from .contracts.python_models import CHAIN, OBSERVER, Broken, law


class Memory(NamedTuple):
    """One number, in an array."""

    weight: Any


class Counts(Scalars):
    """A record of which a saved state would lose a field."""

    level: float
    samples: int


class Lists(NamedTuple):
    """What a memory can't be made of."""

    weight: Any
    history: Any


def quiet(model: Any, memory: Any, features: Any) -> float:
    """Predict what was learned."""
    return memory.weight[0]


def passive(model: Any, memory: Any, features: Any, target: float) -> None:
    """Learn nothing."""


def model_with(
    infers: Callable[..., Any] | None = quiet,
    learns: Callable[..., Any] | None = passive,
    memory: Any = None,
    design: Any = None,
) -> Any:
    """A model called Mine, with parameters of a type of its own."""

    class MineDesign(NamedTuple):
        width: int

    class Mine:
        def design(self, features: int, dt: float) -> Any:
            return MineDesign(features) if design is None else design()

        def memory(self, parameters: Any) -> Any:
            return Memory(np.zeros(1)) if memory is None else memory()

    if infers is not None:
        infer.register(MineDesign)(infers)
    if learns is not None:
        learn.register(MineDesign)(learns)
    return Mine()


def raises(*arguments: Any) -> Any:
    """Fail."""
    raise KeyError("nothing here")


MODELS: dict[str, tuple[Callable[[], Any], str]] = {
    "a vector": (
        lambda: model_with(lambda m, s, x: 2.0 * x),
        r"Mine: infer returns ndarray of shape \(3,\): must return one number",
    ),
    "a tuple": (
        lambda: model_with(lambda m, s, x: (1.0, 2.0)),
        r"Mine: infer returns tuple of shape \(2,\): must return one number",
    ),
    "nothing": (
        lambda: model_with(lambda m, s, x: None),
        "Mine: infer returns NoneType: must return one number",
    ),
    "text": (
        lambda: model_with(lambda m, s, x: "1.0"),
        "Mine: infer returns str: must return one number",
    ),
    "infer raises": (
        lambda: model_with(raises),
        r"Mine: infer fails with KeyError: 'nothing here'; it is shown 3 features",
    ),
    "learn raises": (lambda: model_with(quiet, raises), "Mine: learn fails with KeyError"),
    "too many features": (
        lambda: model_with(lambda m, s, x: x[7]),
        r"Mine: infer fails with IndexError.*of shape \(3,\)",
    ),
    "arguments": (
        lambda: model_with(lambda m, s: 1.0),
        "Mine: infer fails with TypeError.*arguments",
    ),
    "no infer": (
        lambda: model_with(None),
        r"Mine: nothing is registered for infer .*@infer.register\(MineDesign\)",
    ),
    "no learn": (
        lambda: model_with(quiet, None),
        r"Mine: nothing is registered for learn .*@learn.register\(MineDesign\)",
    ),
    "design raises": (
        lambda: model_with(design=raises),
        r"Mine.design\(3, 0.005\) fails with KeyError",
    ),
    "design": (
        lambda: model_with(design=lambda: {"rate": 1.0}),
        "Mine.design.* returns dict: must return a NamedTuple",
    ),
    "memory raises": (lambda: model_with(memory=raises), r"Mine.memory\(...\) fails with KeyError"),
    "a dictionary": (
        lambda: model_with(memory=lambda: {"weight": 0.0}),
        "Mine.memory returns dict: must return a NamedTuple of arrays",
    ),
    "lists": (
        lambda: model_with(memory=lambda: Lists(np.zeros(1), [1.0])),
        "Mine.memory has history, list: .* must be arrays",
    ),
    "a number": (
        lambda: model_with(memory=lambda: Memory(0.0)),
        "Mine.memory has weight, float: .* must be arrays",
    ),
    "objects": (
        lambda: model_with(memory=lambda: Memory(np.array([None]))),
        "Mine.memory has weight, array of object",
    ),
}


@cases("name", MODELS)
def test_a_model_that_does_not_fit_is_named(name: str) -> None:
    """With its class and the rule, before anything is compiled."""
    make, message = MODELS[name]
    with pytest.raises(ValueError, match=message):
        law(ql.learners.Online(make()))


def test_a_model_that_divides_by_zero_on_the_trial_is_let_through() -> None:
    """Compiled, that gives inf, which is the guard's business."""
    learner = ql.learners.Online(model_with(lambda m, s, x: 1.0 / s.weight[0].item()))
    assert law(learner).learner is learner


def test_the_trial_leaves_no_trace() -> None:
    """The model learns from the beginning."""

    def count(model: Any, memory: Any, features: Any, target: float) -> None:
        memory.weight[0] += 1.0

    controller = law(ql.learners.Online(model_with(quiet, count)))
    assert controller.state["learner.model.weight"][0] == 0.0


def takes_memory(model: Any, memory: Any, features: Any, target: float) -> None:
    """Make a new array."""
    error = np.zeros(3)
    error[0] = target
    memory.weight[0] += error[1]


def assigns_a_slice(model: Any, memory: Any, features: Any, target: float) -> None:
    """Assign an array to a slice."""
    memory.weight[:] = features[:1]


def looks_up(model: Any, memory: Any, features: Any, target: float) -> None:
    """Use what Numba does not know."""
    memory.weight[0] = float(str(target).strip("x").format(target))


@pytest.mark.trial
@pytest.mark.compiled
@pytest.mark.parametrize(
    ("learns", "message"),
    [
        (
            takes_memory,
            r"^Mine.learn \(for MineDesign\) allocates memory \(.*zeros.*use loops over numbers and arrays that are there",
        ),
        (
            assigns_a_slice,
            r"^Mine.learn \(for MineDesign\) allocates memory .*slices that are assigned to",
        ),
        (looks_up, r"^Mine.learn \(for MineDesign\) (can not be compiled|allocates)"),
    ],
)
def test_what_compiled_code_can_not_do_is_named(learns: Callable[..., Any], message: str) -> None:
    """Where it is compiled, for the driver and for ``step``, in one line instead of Numba's hundred.

    The driver takes longest to compile, and is tried for one of them.
    """
    controller = law(ql.learners.Online(model_with(quiet, learns)))
    scenario = ql.Scenario(1.0, 0.1)
    driver = [lambda: ql.simulate(CHAIN, controller, scenario)] if learns is takes_memory else []
    for compiles in (*driver, controller.prepare):
        with pytest.raises(ValueError, match=message) as caught:
            compiles()
        assert "\n" not in str(caught.value)
        assert caught.value.__suppress_context__
    ql.simulate(CHAIN, controller, scenario, interpret=True)


def block_with(
    writes: Callable[..., Any] | None,
    names: Any = ("a", "b"),
    units: Callable[..., Any] | None = None,
    design: Any = None,
) -> Any:
    """A block of features called Own."""

    class OwnDesign(NamedTuple):
        width: int

    class Own(Features):
        def design(self, order: int) -> Any:
            return OwnDesign(2) if design is None else design()

        def names(self, order: int) -> Any:
            return names

    def ones(features: Any, scale: Any, out: Any) -> None:
        out[0] = out[1] = 1.0

    if writes is not None:
        write.register(OwnDesign)(writes)
    unit.register(OwnDesign)(ones if units is None else units)
    return Own()


def both(features: Any, x: Any, u: float, out: Any) -> None:
    """Write two features."""
    out[0], out[1] = x[0], x[1]


def one(features: Any, x: Any, u: float, out: Any) -> None:
    """Write but one."""
    out[0] = x[0]


def three(features: Any, x: Any, u: float, out: Any) -> None:
    """Write one too many."""
    out[0] = out[1] = out[2] = x[0]


@cases(
    "around",
    [
        lambda block: ql.learners.Online(model_with(), block),
        lambda block: ql.learners.RLS(ql.features.Bias() + block),
    ],
)
@cases(
    ("make", "message"),
    [
        (
            lambda: block_with(None),
            r"Own: nothing is registered for write .*@write.register\(OwnDesign\)",
        ),
        (lambda: block_with(raises), "Own: write fails with KeyError"),
        (
            lambda: block_with(one),
            r"Own: write does not write features \[1\]; .*room for 2 features",
        ),
        (lambda: block_with(three), "Own: write fails with IndexError"),
        (lambda: block_with(both, units=raises), "Own: unit fails with KeyError"),
        (
            lambda: block_with(both, names="ab"),
            "Own.names.* must return a tuple with a name for each",
        ),
        (lambda: block_with(both, design=raises), r"Own.design\(2\) fails with KeyError"),
        (
            lambda: block_with(both, design=list),
            "Own.design.* returns list: must return a NamedTuple",
        ),
    ],
)
def test_features_that_do_not_fit_are_named(make: Any, message: str, around: Any) -> None:
    """With their class and the rule, for either kind of learner."""
    with pytest.raises(ValueError, match=message):
        law(around(make()))


def test_features_of_ones_own_that_fit_are_taken() -> None:
    """And learned from."""
    run = ql.simulate(
        CHAIN,
        law(ql.learners.RLS(block_with(both))),
        ql.Scenario(ql.signals.Sinusoid(), 0.5),
        interpret=True,  # compiled features of one's own run in test_features
    )
    assert run.features == ("a", "b")


def learner_with(
    missing: tuple[str, ...] = (),
    says: Any = (0.0, 0.0),
    width: int = 1,
    memory: Any = None,
    **other: Callable[..., Any],
) -> Any:
    """A learner called Whole, without the functions that are ``missing``, or with ``other`` ones."""

    class WholeDesign(NamedTuple):
        width: int

    class Whole:
        def design(self, observer: Any, omega_c: float) -> Any:
            return other["design"]() if "design" in other else WholeDesign(1)

        def memory(self, parameters: Any) -> Any:
            return Memory(np.zeros(1)) if memory is None else memory()

        def feature_names(self, order: int) -> tuple[str, ...]:
            return other["names"]() if "names" in other else ("a",) * width

    def nothing(learner: Any, memory: Any, *others: Any) -> None: ...

    def theta(learner: Any, memory: Any, theta: Any) -> None:
        theta[0] = 0.0

    functions = {
        adapt: nothing,
        commit: nothing,
        restart: nothing,
        predict: lambda *all: says,
        coefficients: theta,
    }
    for function, implementation in functions.items():
        name = function.__name__  # type: ignore[attr-defined]
        if name not in missing:
            function.register(WholeDesign)(other.get(name, implementation))
    return Whole()


@cases(
    ("make", "message"),
    [
        (
            lambda: learner_with(("adapt", "restart")),
            r"Whole: nothing is registered for adapt, restart .*@adapt.register\(WholeDesign\)",
        ),
        (
            lambda: learner_with(says=1.0),
            r"Whole: predict returns 1.0: must return \(constant, slope\)",
        ),
        (
            lambda: learner_with(says=(1.0, np.zeros(2))),
            r"Whole: predict, slope, returns ndarray of shape \(2,\): must return one number",
        ),
        (
            lambda: learner_with(width=0),
            "Whole: coefficients fails with IndexError.*it has 0 names",
        ),
        *(
            (
                lambda says=says: learner_with(says=says),
                r"Whole: predict returns \(.*\): must return \(constant, slope\), two numbers",
            )
            for says in ((1.0,), (1.0, 2.0, 3.0))
        ),
        (
            lambda: learner_with(says=("1", 0.0)),
            "Whole: predict, constant, returns str: must return one number",
        ),
        *(
            (
                lambda name=name: learner_with(**{name: raises}),
                f"Whole: {name} fails with KeyError: 'nothing here'; {rule}",
            )
            for name, rule in (
                *dict.fromkeys(("adapt", "predict", "commit", "restart"), "docs/extend").items(),
                ("coefficients", "it has 1 names"),
            )
        ),
        (
            lambda: learner_with(design=raises),
            r"Whole.design\(observer, 4\) fails with KeyError.*design takes \(observer, omega_c\)",
        ),
        (
            lambda: learner_with(design=lambda: {"rate": 1.0}),
            r"Whole.design\(observer, 4\) returns dict: must return a NamedTuple",
        ),
        (
            lambda: learner_with(memory=raises),
            r"Whole.memory\(...\) fails with KeyError.*memory takes \(parameters\)",
        ),
        (
            lambda: learner_with(names=raises),
            r"Whole.feature_names\(2\) fails with KeyError.*feature_names takes the plant's order",
        ),
        *(
            (
                lambda names=names: learner_with(names=lambda: names),
                r"Whole.feature_names\(2\) returns .*: must return a tuple with a name for each",
            )
            for names in (["a"], ("a", 1), "a")
        ),
        (lambda: learner_with(memory=lambda: Memory([0.0])), "Whole.memory has weight, list"),
        (
            lambda: learner_with(memory=lambda: Memory(np.zeros(1, dtype=int))),
            "Whole.memory has weight, array of int64: .* float64",
        ),
        (
            lambda: learner_with(memory=lambda: Memory(Counts.zeros())),
            "Whole.memory has weight, array of .*Counts.*: .* float64",
        ),
    ],
)
def test_a_learner_that_does_not_fit_is_named(make: Any, message: str) -> None:
    """With its class and the rule."""
    with pytest.raises(ValueError, match=message):
        law(make())


def test_a_learner_is_tried_on_what_a_loop_shows_it() -> None:
    """Estimates (n + 1,), numbers, and room for each coefficient; its memory may be nested."""
    shown: dict[str, tuple[Any, ...]] = {}

    def keeps(name: str, says: Any = None) -> Callable[..., Any]:
        def keep(learner: Any, memory: Any, *arguments: Any) -> Any:
            shown[name] = arguments
            return says

        return keep

    learner = learner_with(
        width=4,
        memory=lambda: Lists(np.zeros(1), Memory(np.zeros(2))),
        adapt=keeps("adapt"),
        predict=keeps("predict", (0.0, 0.0)),
        commit=keeps("commit"),
        coefficients=keeps("coefficients"),
        restart=keeps("restart"),
    )
    law(learner)
    sizes = {name: [np.size(each) for each in arguments] for name, arguments in shown.items()}
    assert sizes == {
        "adapt": [3, 1, 1, 1],
        "predict": [3, 1],
        "commit": [3, 1, 1],
        "coefficients": [4],
        "restart": [],
    }


class ShareDesign(NamedTuple):
    """Parameters of a learner that says a share of what another says."""

    share: float
    inner: Any


class ShareMemory(NamedTuple):
    """The state of the other, and the number of samples."""

    inner: Any
    samples: Any


class Share:
    """A learner around another one."""

    def __init__(self, inner: Any, share: float) -> None:
        self.inner, self.share = inner, share

    def design(self, observer: Any, omega_c: float) -> ShareDesign:
        """Return the parameters of both."""
        return ShareDesign(self.share, self.inner.design(observer, omega_c))

    def memory(self, parameters: ShareDesign) -> ShareMemory:
        """Return the state of both."""
        return ShareMemory(self.inner.memory(parameters.inner), np.zeros(1))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return the names of the other."""
        names: tuple[str, ...] = self.inner.feature_names(order)
        return names


@adapt.register(ShareDesign)
def _adapt_share(
    learner: ShareDesign, memory: ShareMemory, seen: Any, y: float, u: float, f_plain: float
) -> None:
    memory.samples[0] += 1.0
    adapt(learner.inner, memory.inner, seen, y, u, f_plain)


@predict.register(ShareDesign)
def _predict_share(
    learner: ShareDesign, memory: ShareMemory, seen: Any, u: float
) -> tuple[float, float]:
    constant, slope = predict(learner.inner, memory.inner, seen, u)
    return learner.share * constant, learner.share * slope


@commit.register(ShareDesign)
def _commit_share(
    learner: ShareDesign, memory: ShareMemory, seen: Any, u: float, f_learned: float
) -> None:
    commit(learner.inner, memory.inner, seen, u, f_learned)


@restart.register(ShareDesign)
def _restart_share(learner: ShareDesign, memory: ShareMemory) -> None:
    restart(learner.inner, memory.inner)


@coefficients.register(ShareDesign)
def _coefficients_share(learner: ShareDesign, memory: ShareMemory, theta: Any) -> None:
    coefficients(learner.inner, memory.inner, theta)


BUILT_IN: dict[str, Callable[[], Any]] = {
    "Kalman": ql.learners.Kalman,
    "Harmonic": ql.learners.Harmonic,
    "RLS": ql.learners.RLS,
    "Repetitive": lambda: ql.learners.Repetitive(period=2.0),
}


@pytest.mark.trial
@pytest.mark.parametrize("name", BUILT_IN)
def test_a_learner_around_one_of_quell_is_that_learner(name: str) -> None:
    """With all of its output the controls are those of the other to the bit; with a half they are not, and a saved state continues.

    The memory contains that of the other, which has records of floats beside its arrays.
    """
    rng = np.random.default_rng(3)
    y = np.cumsum(rng.standard_normal(900)) * 1e-2

    def controls(learner: Any, samples: slice = slice(None), state: Any = None) -> list[float]:
        controller = law(learner)
        if state is not None:
            controller.state = state
        found = [controller.step(1.0, value) for value in y[samples]]
        last.append(controller.state)
        return found

    last: list[Any] = []
    alone = controls(BUILT_IN[name]())
    assert controls(Share(BUILT_IN[name](), 1.0)) == alone
    half = controls(Share(BUILT_IN[name](), 0.5))
    assert half != alone
    assert last[-1]["learner.samples"] == [899.0]  # the observer starts at the first y
    controls(Share(BUILT_IN[name](), 0.5), slice(450))
    assert controls(Share(BUILT_IN[name](), 0.5), slice(450, None), last[-1]) == half[450:]


class ExplodesDesign(NamedTuple):
    """Parameters of a model that explodes after so many pairs."""

    well: float
    then: float


class Explodes:
    """A model that says nothing, and then something terrible."""

    def __init__(self, then: float) -> None:
        self.then = then

    def design(self, features: int, dt: float) -> ExplodesDesign:
        """Return the parameters."""
        return ExplodesDesign(2.0 / dt, self.then)

    def memory(self, parameters: ExplodesDesign) -> Memory:
        """Return the state."""
        return Memory(np.zeros(1))


@infer.register(ExplodesDesign)
def _infer(model: ExplodesDesign, memory: Memory, features: Any) -> float:
    return model.then if memory.weight[0] > model.well else 0.0


@learn.register(ExplodesDesign)
def _learn(model: ExplodesDesign, memory: Memory, features: Any, target: float) -> None:
    memory.weight[0] += 1.0


SCENARIO = ql.Scenario(
    ql.signals.Sinusoid(omega=1.5),
    duration=4.0,
    disturbances=(),
    noise=ql.signals.BandLimitedNoise(1e-12, 0.01),
)


@cache
def plain_run() -> ql.Trajectory:
    """The run without learner."""
    return ql.simulate(CHAIN, law(None), SCENARIO)


@pytest.mark.parametrize("then", [math.inf, -math.inf, math.nan, 1e300, -1e12, 1e5])
def test_a_model_that_explodes_is_cut_off(then: float) -> None:
    """The loop is as good as without learner, and the run says why."""
    run = ql.simulate(CHAIN, law(ql.learners.Online(Explodes(then)), guard=ql.Guard()), SCENARIO)
    plain = plain_run()
    late = run.t > 3.0
    assert (
        np.sqrt(np.mean((run["y"] - run["r"])[late] ** 2))
        <= 1.001 * np.sqrt(np.mean((plain["y"] - plain["r"])[late] ** 2)) + 1e-9
    )
    reasons = set(run["reason"][late].astype(int))
    assert (Status.LEARNER_CUT in run.status) == (not math.isfinite(then))
    assert (Reason.EXPLODED if math.isfinite(then) else Reason.NOT_FINITE) in reasons
    assert not run.status & (Status.OVERFLOWED | Status.DIVERGED)


@pytest.mark.parametrize("then", [ValueError("no more"), math.nan, 1e200])
def test_a_python_model_that_breaks_in_a_guarded_loop_leaves_a_plain_one(then: Any) -> None:
    """What raises or is no number is reported; what is only huge is cut off.

    As Python: compiled, such a model breaks in a loop without guard (``test_adapter_faults``).
    """
    guarded = law(ql.learners.PythonModel(Broken(60, then)), guard=ql.Guard())
    if isinstance(then, float) and math.isfinite(then):
        run = ql.simulate(CHAIN, guarded, SCENARIO, interpret=True)
        assert Reason.EXPLODED in set(run["reason"].astype(int))
    else:
        with pytest.warns(RuntimeWarning, match="learner Broken raised"):
            run = ql.simulate(CHAIN, guarded, SCENARIO, interpret=True)
        assert Status.LEARNER_FAILED in run.status
    plain = plain_run()
    assert np.max(np.abs(run["y"] - run["r"])) <= 1.05 * np.max(np.abs(plain["y"] - plain["r"]))
    assert not run.diverged
    assert OBSERVER.dt == run.dt
