"""Every option of every command changes something, or is refused."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quell.cli.app import app
from tests.commands import in_this_process

# Options that allow something, and change nothing where it does not happen.
PERMISSIONS = {"--trust", "--overwrite", "--yes", "--max-size"}
SETUP = """dt = 0.05
plant = { kind = "linear", num = [2.0], den = [1.0, 1.0] }
observer = { kind = "model-free", order = 1, b0 = 2.0, omega_o = 8.0 }
controller = { omega_c = 2.0, u_min = -50.0, u_max = 50.0 }
scenario = { duration = 4.0, reference = { kind = "step" }, disturbances = [{ kind = "step", at = 2.0 }] }
[tune]
compare = []
structure = "pi"
[rig]
device = "twin:"
[sweep]
draws = 3
metrics = ["iae"]
parameters = { "observer.b0" = { low = 1.5, high = 2.5 } }
"""
PROXY = """dt = 0.05
observer = { kind = "model-free", order = 1, b0 = 2.0, omega_o = 8.0 }
controller = { kind = "compensator", u_min = -5.0, u_max = 5.0 }
rig = { device = "twin:torsional" }
"""
_FIGURES, _SETUP = ("--no-figures",), ("setup.toml",)
# What each command does its work with, where that takes long; its arguments are the output then.
WORK = {
    "reproduce two-mass": ("quell.experiments.two_mass_spring.run",),
    "reproduce torsional": ("quell.experiments.torsional.run",),
    "reproduce acc": ("quell.experiments.acc.study.run",),
    "stress": ("quell.experiments.stress.study.run", "quell.experiments.stress.general.run"),
    "rig": ("quell.realtime.rig.Rig",),
    "proxy": ("quell.realtime.rig.Rig",),
    "studio": ("quell.studio.server.serve",),
    "run-rig": ("quell.realtime.run_rig",),
    "sweep": ("quell.sweeping.sweep",),
    "compare": (
        "quell.experiments.compare.two_mass",
        "quell.experiments.compare.of_setup",
        "quell.experiments.over_seeds.of_setups",
    ),
    "identify": ("quell.identification.identify",),
    "tune": (
        "quell.tuning.tune",
        "quell.tuning.plants.record_model",
        "quell.commissioning.experiment",
    ),
    "b0": (
        "quell.identification.identify_b0",
        "quell.identification.identify_b0_by",
        "quell.identification.identify_b0_matrix",
    ),
}
BASES: dict[str, tuple[str, ...]] = {
    "reproduce two-mass": _FIGURES,
    "reproduce torsional": _FIGURES,
    "reproduce acc": _FIGURES,
    "stress": _FIGURES,
    "compare": ("--controllers", "pid", *_FIGURES),
    "identify": ("record.csv", *_FIGURES),
    "tune": (*_SETUP, *_FIGURES),
    "b0": ("record.csv", "--order", "1"),
    "excite": ("out.csv", "--duration", "20"),
    "rank": ("log.csv", "log-2.csv"),
    "watch": ("record.csv", "--window", "10", "--order", "1"),
    "rig": ("--device", "udp://127.0.0.1:0"),
    "proxy": ("proxy.toml", "--host", "udp://127.0.0.1:0"),
    "setup": _SETUP,
    "run": (*_SETUP, *_FIGURES),
    "run-rig": (*_SETUP, *_FIGURES),
    "replay": ("recording.csv", *_SETUP, *_FIGURES),
    "sweep": (*_SETUP, *_FIGURES),
    "export": (*_SETUP, "--out", "c"),
    "studio": (*_SETUP, "--no-browser"),
    "docs": ("zeros",),
    "doctor": (),
    "completion": ("bash",),
    "help": ("exit-codes",),
}
_RECORD = ("record.csv", *_FIGURES)
_TWIN = (
    "--device",
    "twin:torsional",
    "--dt",
    "0.001",
    "--u-min=-1",
    "--u-max=1",
    "--yes",
    *_FIGURES,
)
_TWIN = (*_TWIN, "--y-min=-9", "--y-max=9")
_EXPORT = (*_SETUP, "--out", "c")
_FMU = (*_SETUP, "--to", "fmu", "--out", "c.fmu")
_PLANT = ("--num", "2", "--den", "1,1", "--dt", "0.05", *_FIGURES)
_BENCHMARK = ("--controllers", "pid", *_FIGURES)
_OF_SETUP = (*_SETUP, *_FIGURES)
_TWO_SETUPS = (*_SETUP, "other.toml", *_FIGURES)
Case = tuple[str, ...] | tuple[tuple[str, ...], tuple[str, ...]]
# For each option what is added to the command's base; or a base and a call of its own.
CASES: dict[str, dict[str, Case]] = {
    "reproduce two-mass": {"--dt": ("--dt", "0.002"), "--seed": ("--seed", "1"), "--omega-o": ("--omega-o", "9"), "--reset": ("--no-reset",), "--seeds": ("--seeds", "2")},
    "reproduce torsional": {"--dt": ("--dt", "0.002"), "--seed": ("--seed", "1")},
    "reproduce acc": {"--samples": ("--samples", "plants.csv"), "--count": ("--count", "4"), "--spread": ("--spread", "2"), "--seed": ("--seed", "1"), "--box": ("--box",)},
    "stress": {"--runs": ("--runs", "12"), "--honest": ("--honest", "3"), "--seed": ("--seed", "1"), "--guard": ("--no-guard",), "--loops": ("--loops", "all")},
    "compare": {
        "SETUPS": (_BENCHMARK, _OF_SETUP), "--seeds": (_TWO_SETUPS, (*_TWO_SETUPS, "--seeds", "3")), "--criterion": (_TWO_SETUPS, (*_TWO_SETUPS, "--criterion", "iae")), "--controllers": (_BENCHMARK, ("--controllers", "lqg", *_FIGURES)), "--m-s": (_OF_SETUP, (*_OF_SETUP, "--m-s", "1.7")), "--m-t": (_OF_SETUP, (*_OF_SETUP, "--m-t", "1.7")),
        "--m-ks": (_OF_SETUP, (*_OF_SETUP, "--m-ks", "9")), "--load-at": (_OF_SETUP, (*_OF_SETUP, "--load-at", "3")),
        **{f"--{name}": (_BENCHMARK, (*_BENCHMARK, f"--{name}", value)) for name, value in {"m1": "1.1", "m2": "1.1", "k": "1.1", "dt": "0.01", "u-max": "9", "seed": "1"}.items()},
    },
    "identify": {
        "DATA": ("record.csv",), "--order": ("--order", "2"), "--delay": ("--delay", "0.05"), "--dt": ("--dt", "0.04"), "--horizon": ("--horizon", "5"),
        "--validate": ("--validate", "other.csv"), "--alternatives": (("real",), ("--no-alternatives",)), "--columns": ("--columns", "t,y,u"), "--time-unit": ("--time-unit", "ms"),
        "--zeros": ("--zeros", "1"), "--integrators": ("--integrators", "1"), "--friction": ("--friction",), "--rest": ("--rest",), "--max-delay": ("--max-delay", "0.2"), "--held-out": ("--held-out", "0.2"), "--frequencies": ("--frequencies",),
    },
    "tune": {
        "SETUP": (_PLANT, _OF_SETUP), "--num": (_PLANT, (*_PLANT, "--num", "3")), "--den": (_PLANT, (*_PLANT, "--den", "1,2")), "--dt": (_PLANT, (*_PLANT, "--dt", "0.06")),
        "--delay": ("--delay", "0.1"), "--structure": ("--structure", "pid"), "--order": ("--order", "1"), "--objective": ("--objective", "load"),
        "--m-s": ("--m-s", "1.7"), "--m-t": ("--m-t", "1.7"), "--m-ks": ("--m-ks", "9"), "--damping": ("--damping", "0.7"), "--noise": ("--noise", "0.01"), "--resolution": ("--resolution", "0.01"), "--feedforward": ("--feedforward",), "--trials": ("--trials", "3"), "--out": ("--out", "taken.json"), "--save-record": ("--save-record", "new.csv"),
        "--model-order": (_RECORD, (*_RECORD, "--model-order", "2")), "--u-min": ("--u-min=-3",), "--u-max": ("--u-max", "3"),
        "--u-rest": ("--u-rest", "1"), "--y-rest": (_PLANT, (*_PLANT, "--u-rest", "1", "--y-rest", "2")), "--device": (_OF_SETUP, _TWIN),
        **{f"--{name}": (_RECORD, (*_RECORD, f"--{name}", *value)) for name, value in {
            "columns": ("t,y,u",), "time-unit": ("ms",), "zeros": ("1",), "integrators": ("1",), "friction": (), "rest": (), "max-delay": ("0.2",), "held-out": ("0.2",)}.items()},
        **{f"--{name}": (_TWIN, (*_TWIN, f"--{name}={value}")) for name, value in {"y-min": "-8", "y-max": "8", "seconds": "20", "excite": "relay"}.items()},
    },
    "b0": {
        "RECORD": ("--columns", "t,y,u"), "--loop": (("record.csv",), ("record.csv", "--loop", "setup.toml")), "--order": ("--order", "2"), "--dt": ("--dt", "0.04"), "--max-delay": ("--max-delay", "0.3"),
        "--phase-margin": (("real",), ("--phase-margin", "50")), "--ratio": (("real",), ("--ratio", "7")), "--columns": ("--columns", "t,y,u"), "--time-unit": ("--time-unit", "ms"),
        "--by": ("--by", "y"), "--bins": (("record.csv", "--order", "1", "--by", "y"), ("record.csv", "--order", "1", "--by", "y", "--bins", "3")),
        "--axes": (("two.csv", "--order", "1", "--axes", "y,q", "--actuators", "u,v"), ("two.csv", "--order", "1", "--axes", "q,y", "--actuators", "u,v")),
        "--actuators": (("two.csv", "--order", "1", "--axes", "y,q", "--actuators", "u,v"), ("two.csv", "--order", "1", "--axes", "y,q", "--actuators", "v")),
    },
    "excite": {
        "OUT": ("other.csv",), "--kind": ("--kind", "multisine"), "--low": ("--low", "2"), "--high": ("--high", "30"), "--duration": ("--duration", "40"), "--dt": ("--dt", "0.002"),
        "--u-min": ("--u-min=-2",), "--u-max": ("--u-max", "2"), "--seed": ("--seed", "1"), "--actuators": ("--actuators", "2"),
    },
    "rank": {
        "LOGS": ("b=log-2.csv@0:20",), "--criterion": ("--criterion", "effort"), "--confidence": ("--confidence", "0.5"), "--dt": (("log.csv", "log-2.csv"), ("log.csv", "log-2.csv", "--columns", "u,y,r", "--dt", "0.04")),
        "--columns": ("--columns", "t,y,u,r"), "--time-unit": ("--time-unit", "ms"),
    },
    "watch": {
        "RECORDS": ("other.csv",), "--state": ("--state", "new.json"), "--window": ("--window", "15"), "--order": ("--order", "2"), "--band": ("--band", "2"), "--alpha": ("--alpha", "0.1"), "--dt": ("--dt", "0.04"),
        "--columns": ("--columns", "t,y,u"), "--time-unit": ("--time-unit", "ms"),
    },
    "rig": {
        "--device": (("--device", "udp://127.0.0.1:0"), ("--device", "udp://127.0.0.2:0")), "--plant": ("--plant", "two-mass"), "--dt": ("--dt", "0.002"), "--watchdog": ("--watchdog", "9"),
        "--u-max": ("--u-max", "3"), "--rest": ("--no-rest",), "--wait": ("--wait", "0.001"), "--channel": ("--channel", "0.5"), "--seconds": ("--seconds", "2"), "--log": ("--log", "log.csv"), "--priority": ("--priority", "0"), "--cpu": ("--cpu", "0"),
    },
    "proxy": {
        "SETUP": ("slow.toml", "--host", "udp://127.0.0.1:0"), "--host": (("proxy.toml", "--host", "udp://127.0.0.1:0"), ("proxy.toml", "--host", "udp://127.0.0.2:0")), "--device": ("--device", "twin:two-mass"),
        "--seconds": ("--seconds", "2"), "--log": ("--log", "log.csv"), "--priority": ("--priority", "0"), "--cpu": ("--cpu", "0"),
    },
    "setup": {"FILES": ("other.toml",), "--schema": (_SETUP, ("--schema",))},
    "run": {"SETUP": ("--no-figures",), "--example": (("--example",), _SETUP), "--save": ("--save", "run.nc")},
    "run-rig": {
        "SETUP": (_OF_SETUP, ("other.toml", *_FIGURES)), "--example": ("--example",), "--device": ("--device", "twin:torsional"), "--seconds": ("--seconds", "2"), "--omega-c": ("--omega-c", "3"),
        "--omega-o": ("--omega-o", "9"), "--spin": ("--spin", "0.001"), "--priority": ("--priority", "0"), "--mcap": ("--mcap", "new.mcap"), "--csv": ("--csv", "new.csv"), "--memory": ("--memory", "servo.qllm"),
        "--live": ("--live", "0"), "--live-origin": ("--live-origin", "https://a.org"), "--watch": ("--watch", "new.json"), "--save": ("--save", "taken.nc"),
    },
    "replay": {"RECORD": ("other.csv",), "--setup": ("--setup", "other.toml"), "--save": ("--save", "taken.nc")},
    "sweep": {
        "SETUP": (_OF_SETUP, ("other.toml", *_FIGURES)), "--folder": ("--folder", "elsewhere"), "--dask": ("--dask", "tcp://127.0.0.1:1"), "--workers": ("--workers", "1"),
        "--repeat": ("--repeat", "0"), "--worst": (("real",), ("--worst", "1", "--repeat", "0")), "--save": ("--save", "run.nc"),
    },
    "export": {
        "SETUP": ("other.toml",), "--to": ("--to", "fmu"), "--out": ("--out", "d"), "--name": ("--name", "servo"), "--precision": ("--precision", "single"), "--what": ("--what", "loop"), "--fmi": (_FMU, (*_FMU, "--fmi", "2.0")),
        "--resolution": ("--resolution", "0.01"), "--memory": ("--memory", "servo.qllm"), "--accept": ("--accept",),
        "--prove": ("--prove",), "--spread": ((*_EXPORT, "--prove"), (*_EXPORT, "--prove", "--spread", "0.2")),
    },
    "studio": {"SETUP": (("--no-browser",), ("setup.toml", "--no-browser")), "--port": ("--port", "0"), "--browser": (_SETUP, (*_SETUP, "--no-browser"))},
    "docs": {"WORDS": ("notch",), "--browser": ("--browser",)}, "doctor": {}, "completion": {"SHELL": (("bash",), ("fish",))}, "help": {"TOPIC": (("exit-codes",), ("run",))},
}  # fmt: skip


def commands(group: Any = app, path: tuple[str, ...] = ()) -> Iterator[tuple[str, list[str]]]:
    """Yield the commands, as users write them, with the first name of each option."""
    for name in group:
        if name.startswith("-"):
            continue
        if group[name].default_command is None:
            yield from commands(group[name], (*path, name))
            continue
        found = group[name].assemble_argument_collection()
        names = [argument.names[0] for argument in found if argument.parse and argument.names]
        yield " ".join((*path, name)), [each for each in names if each != "*"]


OPTIONS = dict(commands())
OUTPUTS = {"--json", "--figures"}
PAIRS = [
    (command, option)
    for command, options in OPTIONS.items()
    for option in options
    if option not in PERMISSIONS | OUTPUTS
]


class ReachedError(ValueError):
    """The command has come to its work, with these arguments."""


def _told(*arguments: Any, **options: Any) -> Any:
    options = {name: value for name, value in options.items() if name not in ("progress", "ready")}
    raise ReachedError(f"{arguments!r} {options!r}")


class _Server:
    """A stand-in for the rig's server, whose ``run`` tells all."""

    def __init__(self, *arguments: Any, listener: Any = None, **options: Any) -> None:
        self.given = arguments, getattr(listener, "url", "").rpartition(":")[0], options
        self.signal_counts = None  # one measurement and one control signal

    def __enter__(self) -> _Server:
        return self

    def __exit__(self, *_: Any) -> None:
        pass

    def prepare(self) -> None:
        """Compile nothing."""

    def run(self, *arguments: Any, **options: Any) -> None:
        """Tell what the rig was made of, and how it is run."""
        _told(*self.given, *arguments, **options)


def _opened(tables: Any, port: int, ready: Callable[[str], None], trust: bool) -> None:
    ready("URL")
    _told(tables, port)


def _write_inputs() -> None:
    """Write what the commands read."""
    rng = np.random.default_rng(3)
    Path("setup.toml").write_text(SETUP, encoding="utf-8")
    Path("other.toml").write_text(SETUP.replace("b0 = 2.0", "b0 = 2.5"), encoding="utf-8")
    Path("proxy.toml").write_text(PROXY, encoding="utf-8")
    Path("slow.toml").write_text(PROXY.replace("omega_o = 8.0", "omega_o = 4.0"), encoding="utf-8")
    t, u = 0.05 * np.arange(600), np.repeat(np.sign(rng.normal(size=60)), 10)
    y = np.zeros(600)
    for k in range(599):
        y[k + 1] = np.exp(-0.05) * y[k] + 2.0 * (1.0 - np.exp(-0.05)) * u[k]
    for name in ("record.csv", "other.csv"):
        table = np.column_stack([t, u, y + 1e-3 * rng.normal(size=600)])
        np.savetxt(name, table, delimiter=",", header="t,u,y", comments="")
        log = name.replace("record", "log").replace("other", "log-2")
        table = np.column_stack([table, np.repeat(rng.normal(size=60), 10)])
        np.savetxt(log, table, delimiter=",", header="t,u,y,r", comments="")
    two = np.column_stack([t, u, y, rng.normal(size=600), rng.normal(size=600)])
    np.savetxt("two.csv", two, delimiter=",", header="t,u,y,v,q", comments="")
    for name in ("taken.json", "taken.nc"):
        Path(name).write_text("{}", encoding="utf-8")
    Path("plants.csv").write_text("m1,m2,k_lin,k_nonlin,lambda,tau\n1,1,1,0,0,0.01\n")


@pytest.fixture
def outcome(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    """Return a function that says what a call does: exit code, text and files."""

    def of(command: str, *arguments: str, real: bool = False) -> tuple[int, str]:
        folder = tmp_path / str(len([*tmp_path.iterdir()]))
        folder.mkdir()
        with monkeypatch.context() as patch:
            patch.chdir(folder)
            _write_inputs()
            before = {path.name for path in folder.iterdir()}
            for target in () if real else WORK.get(command, ()):
                module, _, name = target.rpartition(".")
                stand_in = {"Rig": _Server, "serve": _opened}.get(name, partial(_told, target))
                patch.setattr(importlib.import_module(module), name, stand_in)
            patch.setattr("quell.cli.reproduce.compile_loops", lambda *_: None)
            patch.setattr("webbrowser.open", lambda url: print("opened", url))
            shown = in_this_process((*command.split(), *arguments), patch, capsys)
            new = sorted(path for path in folder.rglob("*") if path.is_file())
            files = {
                str(path.relative_to(folder)): path.read_bytes()[:20_000]
                for path in new
                if path.name not in before
            }
        return shown.code, shown.out + shown.err + repr(files)

    return of


def test_every_option_has_a_case() -> None:
    """Of commands that are found, as all commands are; and no case is of an option that is gone."""
    for command, options in OPTIONS.items():
        needed = {each for each in options if (command, each) in PAIRS}
        named = {each if each.startswith("-") else each.upper() for each in CASES[command]}
        positional = {f"--{each.lower()}" for each in named if not each.startswith("-")}
        covered = {each for each in named if each.startswith("-")} | positional
        assert {
            f"--{each.lower()}" if not each.startswith("-") else each for each in needed
        } <= covered
        assert covered <= {f"--{each.lstrip('-').lower()}" for each in options}, command


@pytest.mark.trial
@pytest.mark.filterwarnings("ignore::UserWarning")  # of a dt that contradicts the times
@pytest.mark.parametrize(
    ("command", "option"),
    [(command, option) for command in CASES for option in CASES[command]],
)
def test_an_option_changes_something_or_is_refused(
    outcome: Callable[..., tuple[int, str]], command: str, option: str
) -> None:
    """The arguments of the work, the text or the files; a refusal names the option."""
    case: Any = CASES[command][option]
    first: tuple[str, ...]
    first, other = BASES[command], (*BASES[command], *case) if isinstance(case[0], str) else ()
    real = False
    if not isinstance(case[0], str):
        first, other = case
        if first == ("real",):
            real, first, other = True, BASES[command], (*BASES[command], *other)
    run = partial(outcome, command, real=real)
    code, told = run(*other)
    if code == 2 and option in told:
        return
    assert (code, told) != run(*first), f"{command} {option} changes nothing"


@pytest.mark.parametrize(
    ("command", "option"),
    [(command, each) for command, found in OPTIONS.items() for each in found if each in OUTPUTS],
)
def test_no_output_replaces_a_file(
    outcome: Callable[..., tuple[int, str]], command: str, option: str
) -> None:
    """Named files are looked at before the work; so the option has an effect."""
    base = [each for each in BASES[command] if each != "--no-figures"]
    more = (
        ()
        if option == "--figures" or command in ("b0", "rank", "watch", "docs", "doctor", "help")
        else _FIGURES
    )
    taken = "taken.nc" if option == "--save" else "taken.json"
    code, told = outcome(command, *base, *more, option, taken)
    assert code != 0
    assert taken in told
