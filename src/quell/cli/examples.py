"""Command lines to copy, and the page of each command: the begin and the end of its help."""

from __future__ import annotations

from typing import NamedTuple


class Usage(NamedTuple):
    """The first lines and the last line of the help of a command."""

    lines: tuple[str, str]  #: command lines to copy
    page: str  #: of the documentation

    def text(self, command: str) -> str:
        """Return the first lines of the help."""
        return "\n".join([f"Usage: quell {command} [OPTIONS] [ARGS]", "", *self._indented])

    @property
    def _indented(self) -> list[str]:
        return [f"    {line}" for line in self.lines]

    @property
    def end(self) -> str:
        """The last line of the help."""
        return f"More: quell docs {self.page}. Exit codes: quell help exit-codes."


USAGES = {
    "stress": Usage(("quell stress", "quell stress --runs 60 --json trial.json"), "stress"),
    "compare": Usage(
        ("quell compare setup.toml", "quell compare a.toml b.toml --seeds 10"), "compare"
    ),
    "identify": Usage(
        ("quell identify record.csv --json model.json", "quell identify record.csv --frequencies"),
        "identification",
    ),
    "tune": Usage(
        (
            "quell tune --num 1 --den 1,3,3,1 --dt 0.02 --out tuned.toml",
            "quell tune record.csv --u-min=-10 --u-max 10 --out tuned.toml",
        ),
        "tuning",
    ),
    "b0": Usage(
        (
            "quell b0 record.csv --order 2",
            "quell b0 record.csv --order 2 --axes q1,q2 --actuators tau1,tau2",
        ),
        "b0",
    ),
    "excite": Usage(
        (
            "quell excite u.csv --duration 20",
            "quell excite u.csv --kind prbs --low 0.2 --high 20 --duration 60 --u-min=-2 --u-max 2",
        ),
        "identification_records",
    ),
    "rank": Usage(
        ("quell rank A=a.csv B=b.csv", "quell rank a.csv b.csv --criterion effort"), "monitoring"
    ),
    "watch": Usage(
        (
            "quell watch day.csv --order 2",
            "quell watch monday.mcap tuesday.mcap --state watch.json",
        ),
        "monitoring",
    ),
    "rig": Usage(
        (
            "quell rig --device udp://127.0.0.1:5005",
            "quell rig --plant setup.toml --dt 0.001 --device udp://127.0.0.1:5005",
        ),
        "rig",
    ),
    "proxy": Usage(
        (
            "quell proxy setup.toml --host udp://127.0.0.1:5006",
            "quell proxy setup.toml --host udp://127.0.0.1:5006 --log proxy.csv",
        ),
        "drive",
    ),
    "setup": Usage(("quell setup setup.toml", "quell setup --schema"), "setup"),
    "run": Usage(("quell run --example", "quell run setup.toml --save run.nc"), "setup"),
    "run-rig": Usage(
        ("quell run-rig --example", "quell run-rig setup.toml --seconds 10 --mcap run.mcap"), "rig"
    ),
    "replay": Usage(
        ("quell replay run.mcap setup.toml", "quell replay run.csv setup.toml --save replay.nc"),
        "recording_replay",
    ),
    "sweep": Usage(("quell sweep setup.toml", "quell sweep setup.toml --workers 2"), "scale"),
    "export": Usage(
        (
            "quell export setup.toml --out folder",
            "quell export setup.toml --to fmu --what loop --out loop.fmu",
        ),
        "target",
    ),
    "studio": Usage(("quell studio", "quell studio setup.toml --no-browser"), "studio"),
    "docs": Usage(("quell docs encoder on the load", "quell docs questions"), "questions"),
    "doctor": Usage(("quell doctor", "quell doctor --json doctor.json"), "commands"),
    "completion": Usage(("quell completion bash", "quell completion fish"), "commands"),
    "help": Usage(("quell help exit-codes", "quell help tune"), "commands"),
    "reproduce two-mass": Usage(
        ("quell reproduce two-mass", "quell reproduce two-mass --seeds 10 --json results.json"),
        "paper",
    ),
    "reproduce torsional": Usage(
        ("quell reproduce torsional", "quell reproduce torsional --json results.json"), "torsional"
    ),
    "reproduce acc": Usage(("quell reproduce acc", "quell reproduce acc --count 100"), "acc"),
}
