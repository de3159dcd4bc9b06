"""What several test files use."""

from __future__ import annotations

import gc
import importlib
import math
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

# The workers share the cores, and in small matrices the threads of BLAS mostly wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Tests read the standard error: no announcements of long compilations.
os.environ["QUELL_QUIET"] = "1"

import numpy as np
import pytest
from hypothesis import settings
from numba.core import event

import quell as ql
from quell.kernels import dispatch
from quell.simulation.driver import Loop

from . import budget
from .scheduling import FromBothEnds, compiled_first

# pytest rewrites the assertions of each file, half of the time that collection takes: keep the result
# in __pycache__, also where Python is told to write none.
sys.dont_write_bytecode = False

# The same examples in every run, and no stop-watch: the machines that test are shared.
settings.register_profile("quell", deadline=None, derandomize=True)
settings.load_profile("quell")

# Numba makes millions of objects that live long: look for garbage among them less often, and never
# again among those of a compilation.
gc.set_threshold(50_000, 20, 20)


class _FrozenCode(event.Listener):
    """What Numba tells of its compilations."""

    def on_start(self, event: Any) -> None:
        """Do nothing."""

    def on_end(self, event: Any) -> None:
        """Spare the garbage collector all that is here."""
        gc.freeze()


event.register("numba:compile", _FrozenCode())
# A real-time loop collects garbage at its start and calls this at its end: the next one need not go
# through all that was imported, which takes half a second.
gc.unfreeze = lambda: None


# What test files make while they are collected is not worth a compilation.
dispatch.interpret_all = True


_ONLY_TRIALS = re.compile(r"^pytestmark = (\[\s*)?pytest\.mark\.trial", re.M)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not even import the files that have only trials, in a run without trials."""
    if collection_path.suffix != ".py" or config.option.markexpr != "not trial":
        return None
    if any(collection_path.name in each for each in config.args):
        return None  # a file that is named is shown with all its tests deselected
    return True if _ONLY_TRIALS.search(collection_path.read_text(encoding="utf-8")) else None


def pytest_collectstart(collector: pytest.Collector) -> None:
    """Let every second worker import the test files from the last one on, before it collects them.

    pytest rewrites the assertions of a file at the first import, and keeps the result in __pycache__:
    two workers that begin at both ends have half of this to do each, which is all of it otherwise.
    """
    config = collector.config
    number = getattr(config, "workerinput", {}).get("workerid", "gw0").removeprefix("gw")
    if collector.path != budget.HERE or int(number) % 2 == 0 or not budget.is_whole(config):
        return
    for path in sorted(budget.HERE.rglob("test_*.py"), reverse=True):
        if not pytest_ignore_collect(path, config):
            name = ".".join(path.relative_to(budget.HERE.parent).with_suffix("").parts)
            with suppress(Exception, pytest.skip.Exception):  # the collection will say so
                importlib.import_module(name)


def pytest_collection_finish() -> None:
    """Spare the garbage collector all that was imported."""
    gc.freeze()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of these tests."""
    budget.add_options(parser)


def pytest_report_header(config: pytest.Config) -> str | None:
    """Say how long the tests take."""
    return budget.announcement(config)


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Start no more workers than there are files to run, and no more than four."""
    files = [each for each in config.args if each.partition("::")[0].endswith(".py")]
    return min(os.cpu_count() or 1, 4, len(files) or 4)


def pytest_configure(config: pytest.Config) -> None:
    """Declare the markers, and let tests keep their budget."""
    config.pluginmanager.register(budget.Budget(config))
    config.addinivalue_line(
        "markers", "compiled: what it runs is compiled; all other tests run it as plain Python"
    )
    config.addinivalue_line(
        "markers",
        "trial(cases='...'): it takes more than half a second, or these cases of it do (a regular "
        "expression); pytest -m '' runs trials, too, and so does .ci/run, in parts",
    )
    config.addinivalue_line(
        "markers", "lost: it has runs that fail, diverge or run away, of which quell warns"
    )


# To compile a loop takes as long as 20 000 to 60 000 samples of it take as Python.
_MOST_SAMPLES = 30_000
_run = Loop.run


def _run_short(loop: Loop, *arguments: Any) -> int:
    """Run a segment; say so where a test that is not compiled runs too many samples."""
    if dispatch.interpret_all and loop.done >= _MOST_SAMPLES:
        pytest.fail(f"more than {_MOST_SAMPLES} samples as plain Python: mark the test compiled")
    return _run(loop, *arguments)


Loop.run = _run_short  # type: ignore[method-assign]


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Choose a part, compiled files first; let runs diverge where that is the subject."""
    budget.choose(config, items)
    compiled_first(items)
    for item in items:
        if item.get_closest_marker("lost") is not None:
            item.add_marker(
                pytest.mark.filterwarnings(r"ignore:.*(diverged|went beyond|ran away|runs failed)")
            )


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> FromBothEnds | None:
    """Let some of the workers compile, where workers run whole files."""
    return FromBothEnds(config, log) if config.option.dist == "loadfile" else None


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let entry points run as plain Python, unless the test is marked ``compiled``."""
    dispatch.interpret_all = item.get_closest_marker("compiled") is None


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator that is the same in every test."""
    return np.random.default_rng(20240901)


@pytest.fixture
def two_mass_scenario() -> ql.Scenario:
    """The paper's scenario, shortened: 20 s of training, a step from rest, a force on m2 from 35 s."""
    return ql.Scenario(
        reference=ql.signals.Sinusoid().until(20.0, then=ql.signals.Step(at=20.0)),
        disturbances=(0.0, ql.signals.Sinusoid(omega=0.1 * math.pi, start=35.0)),
        noise=ql.signals.BandLimitedNoise(power=1e-12, sample_time=0.01),
        duration=45.0,
        rest_at=(20.0,),
    )


@pytest.fixture
def bench() -> Iterator[Callable[..., Any]]:
    """Make benches (``tests.rig_bench.Bench``); at the end all that is open is closed."""
    from .rig_bench import Bench

    with ExitStack() as stack:
        yield lambda *where, **settings: Bench(stack, *where, **settings)


@pytest.fixture
def quell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., Any]:
    """Run the command in this process, in a folder of its own; return what it did (``Shown``)."""
    from .commands import in_this_process

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    return lambda *arguments: in_this_process(arguments, monkeypatch, capsys)


@pytest.fixture
def no_fmu_left(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Iterator[None]:
    """Check that the test leaves no instance of an FMU and no unpacked folder behind."""
    from quell.plants.fmu import INSTANCES

    folder = tmp_path_factory.mktemp("unpacked")
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield
    gc.collect()
    assert not INSTANCES
    assert not [*folder.glob("quell-fmu-*")]


@pytest.fixture
def compiled_functions(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return the list of what is compiled from users' functions while the test runs."""
    from quell.kernels import user_functions

    compiled: list[Any] = []
    compile_cfunc = user_functions.compile_cfunc

    def counted(*arguments: Any) -> Any:
        compiled.append(arguments)
        return compile_cfunc(*arguments)

    monkeypatch.setattr(user_functions, "compile_cfunc", counted)
    return compiled
