"""Frama-C: its run over the files of a proof, and what it says."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

from quell.export.proof.files import FOLDER, PROPERTIES, frama_c_options

INSTALL = "there is no frama-c here (Debian and Ubuntu: apt-get install frama-c-base)"
_PROVED = ("Valid", "Considered valid")  # the second are contracts of the C library
# What functions of the C library change is an assumption, of which the report names the functions.
_ASSUMED = ("assigns clause", "from clause")
# What the contract promises; without these the proof did not look at what it is for.
_PROMISES = ("a_number: ", "within_limits: ")


class Alarm(NamedTuple):
    """A property that is not proved.

    Attributes
    ----------
    file, line, function
        where it stands.
    kind
        such as ``"index_bound"`` or ``"postcondition"``, as Frama-C names it.
    status
        ``"Unknown"``: it may hold; ``"Invalid"``: it does not.
    claim
        what should hold, in ACSL.
    """

    file: str
    line: int
    function: str
    kind: str
    status: str
    claim: str

    @property
    def place(self) -> str:
        """File and line."""
        return f"{self.file}:{self.line}"


class Findings(NamedTuple):
    """What Frama-C has found.

    Attributes
    ----------
    version
        of Frama-C.
    seconds
        that it took.
    alarms
        all that is not proved.
    promises
        number of the contract's promises that are proved.
    functions, statements
        how many were reached and how many there are, as text.
    assumed
        functions of the C library that are known by their contracts alone.
    failure
        why there is no result; empty if there is one.
    """

    version: str = ""
    seconds: float = 0.0
    alarms: tuple[Alarm, ...] = ()
    promises: int = 0
    functions: str = ""
    statements: str = ""
    assumed: tuple[str, ...] = ()
    failure: str = ""


def frama_c(folder: Path, name: str, longest: float) -> Findings:
    """Run Frama-C in ``folder/proof`` for at most ``longest`` seconds."""
    program = shutil.which("frama-c")
    if program is None:
        return Findings(failure=INSTALL)
    place = (folder / FOLDER).resolve()  # Frama-C takes the folder from PWD
    (place / PROPERTIES).unlink(missing_ok=True)
    version = _output(program, "-version")
    begin = time.monotonic()
    try:
        with (place / "eva.log").open("w", encoding="utf-8") as log:
            code = subprocess.run(
                [program, *frama_c_options(name)], cwd=place, stdout=log, stderr=subprocess.STDOUT,
                timeout=longest, check=False, env={**os.environ, "PWD": str(place)},
            ).returncode  # fmt: skip
    except subprocess.TimeoutExpired:
        return Findings(version, longest, failure=f"the analysis did not end in {longest:g} s")
    seconds = time.monotonic() - begin
    text = (place / "eva.log").read_text(encoding="utf-8", errors="replace")
    table = place / PROPERTIES
    if code or not table.exists() or "[eva:summary]" not in text:
        last = text.strip().splitlines()[-1:] or ["no output"]
        return Findings(version, seconds, failure=f"frama-c ended with {code}: {last[0][:200]}")
    return read_findings(version, seconds, text, table.read_text(encoding="utf-8"))


def read_findings(version: str, seconds: float, log: str, table: str) -> Findings:
    """Return what a log and a table of properties say."""
    rows = [line.split("\t") for line in table.splitlines()[1:]]
    alarms = [
        Alarm(Path(file).name, int(line), function, kind, status, text)
        for place, file, line, function, kind, status, text in rows
        if status not in _PROVED and not (place.startswith("FRAMAC_SHARE") and kind in _ASSUMED)
    ]
    promises = sum(
        status == "Valid" and kind == "postcondition" and text.startswith(_PROMISES)
        for *_, kind, status, text in rows
    )
    failure = ""
    errors = re.search(r"by the (Eva analyzer|Frama-C kernel): +([1-9]\d*) error", log)
    functions = _found(r"(\d+) functions analyzed \(out of (\d+)\)", log)
    if errors:
        failure = f"{errors[2]} errors of the {errors[1]}, see eva.log"
    elif "ecursive call" in log:
        failure = "the analysis found a recursive call, see eva.log"
    return Findings(
        version,
        seconds,
        tuple(alarms),
        promises,
        functions,
        _found(r"(\d+) statements reached \(out of (\d+)\)", log),
        tuple(sorted(set(re.findall(r"using specification for function (\w+)", log)))),
        failure,
    )


def _found(pattern: str, text: str) -> str:
    match = re.search(pattern, text)
    return f"{match[1]} of {match[2]}" if match else "unknown"


def _output(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
    return done.stdout.strip()
