"""Memory images of everything there is: bit for bit in Python and in C, in both precisions."""

from __future__ import annotations

import ctypes
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.controllers import in_single_precision
from quell.controllers.memory import CHECK, HEADER, check_of
from quell.export import c_source
from tests.cases import cases
from tests.in_c import InC, needs_gcc

from .examples import LEARNERS, OBSERVERS, PYTHON_LEARNERS
from .test_controllers import CONTROLLERS

_LIMITS = {"u_min": -5.0, "u_max": 5.0}
_CHAIN = OBSERVERS["model-free, order 2, current"]
CASES = {
    **CONTROLLERS,
    **{
        f"observer: {name}": ql.ADRC(OBSERVERS[name], 1.5, **_LIMITS)
        for name in ("cascade", "nonlinear", "delay", "model-based, order 3, with a zero")
    },
    **{
        f"learner: {name}": ql.ADRC(
            _CHAIN, 1.5, learner=LEARNERS[name], guard=ql.Guard(), **_LIMITS
        )
        for name in LEARNERS
        if name not in {*PYTHON_LEARNERS, "NoLearner"}
    },
}
_SAMPLES = 120


class Signals:
    """r and y of a loop that moves, with noise."""

    def __init__(self) -> None:
        self.random, self.k = np.random.default_rng(1), 0

    def __next__(self) -> tuple[float, float]:
        self.k += 1
        noise = 1e-3 * self.random.standard_normal()
        return float(np.sin(0.1 * self.k)), float(0.3 * np.sin(0.1 * self.k - 0.5) + noise)


def made(name: str, single: bool) -> Any:
    """A controller that has seen nothing, in a precision."""
    controller = CASES[name]
    controller.reset()
    return in_single_precision(controller) if single else controller


def loaded(in_c: InC, image: bytes, resume: bool = True) -> bool:
    """Load an image in C."""
    load = getattr(in_c.library, f"{in_c.name}_load")
    load.restype = ctypes.c_bool
    return bool(load(in_c.state, image, ctypes.c_size_t(len(image)), resume))


def saved(in_c: InC, size: int) -> bytes:
    """Save an image in C."""
    image = ctypes.create_string_buffer(size)
    getattr(in_c.library, f"{in_c.name}_save")(in_c.state, image)
    return image.raw


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize("single", [False, True], ids=["double", "single"])
@pytest.mark.parametrize("name", CASES)
def test_python_and_c_continue_each_others_loops(tmp_path: Path, name: str, single: bool) -> None:
    """Python → C → Python: the same images, and the same u afterwards, bit by bit."""
    controller, signals = made(name, single), Signals()
    source = c_source(controller, "servo")
    in_c, more = InC(source, tmp_path), [0.1] * source.derivatives
    again = made(name, single)
    for k in range(_SAMPLES):
        if k in (0, 1, 2, 5, 12, 30, 60):  # no time is bad to save
            again.restore(controller.memory(), running=True)
            assert again.memory() == controller.memory()
        controller.step(*next(signals), *more)
    image = controller.memory()
    assert loaded(in_c, image)
    assert saved(in_c, len(image)) == image
    for _ in range(_SAMPLES):
        r, y = next(signals)
        assert controller.step(r, y, *more) == in_c.run("step", r, y, *more)
    image = saved(in_c, len(image))
    again.restore(image, running=True)
    assert again.memory() == image
    for _ in range(_SAMPLES // 4):
        r, y = next(signals)
        assert again.step(r, y, *more) == in_c.run("step", r, y, *more)


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize(
    "name", [f"learner: {each}" for each in ("Kalman", "RLS", "Harmonic", "Repetitive", "MLP")]
)
def test_what_was_learned_begins_from_rest(tmp_path: Path, name: str) -> None:
    """As an image without resume, and as an export of the controller: both are the same in C and Python."""
    controller, signals = made(name, False), Signals()
    for _ in range(_SAMPLES):
        controller.step(*next(signals))
    image = controller.memory()
    rested = made(name, False)
    rested.restore(image)
    plain, learned = (
        InC(c_source(each, "servo"), tmp_path) for each in (made(name, False), rested)
    )
    assert loaded(plain, image, resume=False)
    for _ in range(_SAMPLES // 2):
        r, y = next(signals)
        found = rested.step(r, y), plain.run("step", r, y), learned.run("step", r, y)
        assert found[0] == found[1] == found[2]


@cases("name", PYTHON_LEARNERS)
def test_a_learner_in_python_has_no_image_and_says_what_to_do(name: str) -> None:
    """Nothing is pickled."""
    controller = ql.ADRC(_CHAIN, 1.5, learner=PYTHON_LEARNERS[name])
    for attempt in (controller.memory, lambda: controller.restore(b"QLLM")):
        with pytest.raises(ValueError, match="save that object by its own library"):
            attempt()


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize("single", [False, True], ids=["double", "single"])
def test_damaged_images_are_refused_and_change_nothing(tmp_path: Path, single: bool) -> None:
    """Each bit of the image, each length, any bytes; in C and in Python. benchmarks/memory_images.py has 10⁶."""
    controller, signals = made("learner: Kalman", single), Signals()
    in_c = InC(c_source(controller, "servo"), tmp_path)
    for _ in range(_SAMPLES):
        controller.step(*next(signals))
    image = controller.memory()
    assert loaded(in_c, image)
    random = np.random.default_rng(2)
    for k in range(8 * len(image)):
        damaged = bytearray(image)
        damaged[k // 8] ^= 1 << k % 8
        assert not loaded(in_c, bytes(damaged))
    wrong = [image[:size] for size in range(len(image))] + [image + bytes(4)]
    wrong += [random.bytes(len(image)) for _ in range(100)]
    wrong += [image[:start] + bytes(64) + image[start + 64 :] for start in range(0, len(image), 8)]
    for each in wrong:
        if each != image:
            assert not loaded(in_c, each)
            with pytest.raises(ValueError, match="image"):
                controller.restore(each)
    assert saved(in_c, len(image)) == controller.memory() == image


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize("single", [False, True], ids=["double", "single"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused_behind_a_right_check(
    tmp_path: Path, single: bool, value: float
) -> None:
    """At each place of the image."""
    controller = made("learner: RLS", single)
    in_c, image = InC(c_source(controller, "servo"), tmp_path), controller.memory()
    size = 4 if single else 8
    bits = struct.pack("<f" if single else "<d", value)
    for at in range(HEADER.size, len(image) - CHECK.size, size):
        head = image[:at] + bits + image[at + size : -CHECK.size]
        forged = head + CHECK.pack(check_of(head))
        assert not loaded(in_c, forged)
        with pytest.raises(ValueError, match="not finite"):
            controller.restore(forged)
    assert saved(in_c, len(image)) == controller.memory() == image


CHANGES = [
    pytest.param({"omega_c": 2.0}, True, id="omega_c"),
    pytest.param({"omega_o": 15.0}, True, id="omega_o"),
    pytest.param({"u_max": 2.0}, True, id="limits"),
    pytest.param({"guard": ql.Guard(bound=2.0)}, True, id="guard"),
    pytest.param({"b0": 1.6}, False, id="b0"),
    pytest.param({"dt": 0.02}, False, id="dt"),
    pytest.param({"learner": ql.learners.RLS(ql.features.State())}, False, id="features"),
    pytest.param({"learner": ql.learners.Kalman()}, False, id="kind"),
    pytest.param({"guard": None}, False, id="no guard"),
]


@cases(("change", "fits"), CHANGES)
def test_an_image_fits_where_its_numbers_mean_the_same(change: dict[str, Any], fits: bool) -> None:
    """Gains may change between two starts; b0, dt and what is learned may not. A running loop needs all."""

    def controller(**other: Any) -> ql.ADRC:
        given = {"b0": 1.5, "omega_o": 12.0, "dt": 0.01, "omega_c": 1.5, "guard": ql.Guard()}
        given |= {"learner": ql.learners.RLS(), "u_max": 3.0} | other
        observer = ql.ESO.model_free(2, given["b0"], given["omega_o"], given["dt"])
        options = {name: given[name] for name in ("learner", "guard", "u_max")}
        return ql.ADRC(observer, given["omega_c"], u_min=-3.0, **options)

    first, second, signals = controller(), controller(**change), Signals()
    for _ in range(_SAMPLES):
        first.step(*next(signals))
    before = second.memory()
    if not fits:
        with pytest.raises(ValueError, match="image is of another controller"):
            second.restore(first.memory())
        assert second.memory() == before
        return
    second.restore(first.memory())
    assert second.estimate.theta.keys() == first.estimate.theta.keys()
    bias = first._state.learner.loop[0].bias
    for feature, value in second.estimate.theta.items():
        constant = bias if feature == "bias" else 0.0
        assert value == pytest.approx(first.estimate.theta[feature] - constant, abs=1e-12)
    if change.keys() == {"u_max"}:
        second.restore(first.memory(), running=True)
    else:
        with pytest.raises(ValueError, match="other parameters"):
            second.restore(first.memory(), running=True)


@pytest.mark.trial
@needs_gcc
def test_an_image_that_was_forged_in_manual_operation_is_refused(tmp_path: Path) -> None:
    """The u of manual operation has no limits; between two samples there is none."""
    controller = made("ADRC", False)
    controller.step(1.0, 0.0)
    controller._state.loop[0].manual = 1.0
    image = controller.memory()
    controller._state.loop[0].manual = 0.0
    with pytest.raises(ValueError, match="in the middle of a sample"):
        controller.restore(image)
    assert not loaded(InC(c_source(controller, "servo"), tmp_path), image)
