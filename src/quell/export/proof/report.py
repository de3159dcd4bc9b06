"""The proof of an exported controller, and what it says to a safety engineer."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from quell.export.c_files import CSource
from quell.export.proof.files import FOLDER, RETURN_U
from quell.export.proof.frama_c import Alarm, Findings, frama_c
from quell.export.proof.structure import Structure, structure
from quell.files import written_atomically

REPORT = "REPORT.md"
# Controllers with large learners took some minutes.
_LONGEST = 3600.0
# What an alarm of each kind would mean; Frama-C's names.
_MEANINGS = {
    "postcondition": "u may leave its limits or may be no number",
    "index_bound": "a place outside of an array may be read or written",
    "mem_access": "memory outside of an object may be read or written",
    "initialization": "a variable may be read before it is set",
    "signed_overflow": "a sum or product of integers may overflow",
    "float_to_int": "a number too large for an integer may be converted to one",
    "is_nan_or_infinite": "a number that is not finite may be converted to an integer",
    "division_by_zero": "an integer may be divided by zero",
    "shift": "a shift may have a count out of range",
    "precondition": "a function may be called with an argument that it does not allow",
}
_OPEN = """An open property need not be an error: the analysis computes with sets that contain more
than can happen. Somebody must look at it before anybody relies on the proof.

"""
_LIMITS = """
  It is at least the lower and at most the upper limit of u in the parameters in use, also after
  these have changed."""
_ENDS = "Each counts an integer to an end that does not change meanwhile, so it ends."


@dataclass(frozen=True)
class Proof:
    """What was proved of an exported controller.

    Attributes
    ----------
    folder
        the exported folder; the files of the proof are in ``proof``.
    name
        of the controller.
    findings
        what Frama-C has found; its ``failure`` says why there is no result, if there is none.
    structure
        what the text of the code shows.
    promised
        number of promises in the contract.
    promising
        the functions that return u.
    digest
        SHA-256 of header and source, one after the other: the proof is for these files alone.
    sizes
        stack and code of each function, in Markdown; empty if nobody has measured them.
    """

    folder: Path
    name: str
    findings: Findings
    structure: Structure
    promised: int
    promising: tuple[str, ...]
    digest: str
    sizes: str = ""

    @property
    def proved(self) -> bool:
        """Whether everything is proved."""
        return not self.open

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """What Frama-C could not prove."""
        return self.findings.alarms

    @property
    def open(self) -> tuple[str, ...]:
        """What is not proved, a sentence each."""
        found = self.findings
        if found.failure:
            return (found.failure, *self.structure.problems)
        lines = [
            f"{alarm.place}, in {alarm.function}: {_meaning(alarm)} ({alarm.claim})"
            for alarm in found.alarms
        ]
        if found.promises < self.promised:
            lines.append(f"{found.promises} of {self.promised} promises on u are proved")
        return (*lines, *self.structure.problems)

    @property
    def summary(self) -> str:
        """The result in a line."""
        if self.findings.failure:
            return f"NOT proved: {self.findings.failure}"
        where = f"Frama-C {self.findings.version}, {self.findings.seconds:.0f} s"
        if not self.proved:
            return f"NOT proved: {len(self.open)} properties are open ({where})"
        return f"Proved: no undefined behaviour, u is always a number within its limits ({where})"

    @property
    def text(self) -> str:
        """The report in Markdown."""
        library = self.findings.assumed
        lines = "".join(f"- NOT proved: {each}\n" for each in self.open)
        return _filled("REPORT.md", {
            "name": self.name,
            "summary": self.summary,
            "digest": self.digest,
            "results": "" if self.findings.failure else self._results(),
            "open": f"## What is open\n\n{lines}\n{_OPEN}" if lines else "",
            "library": ", ".join(f"`{each}`" for each in library) or "none",
            "sizes": f"## Stack and code\n\n{self.sizes}\n" if self.sizes else "",
        })  # fmt: skip

    def _results(self) -> str:
        found, promising = self.findings, self.promising
        return _filled("results.md", {
            "name": self.name,
            "head": "What is proved" if self.proved else "What holds but for the open properties",
            "functions": " or ".join(f"`{self.name}_{each}`" for each in promising),
            "limits": _LIMITS if self.promised > len(promising) else " There are no limits of u.",
            "loops": self._loops(),
            "called": ", ".join(f"`{each}`" for each in sorted(self.structure.library)) or "none",
            "version": found.version,
            "seconds": f"{found.seconds:.1f}",
            "reached": f"{found.functions} functions and {found.statements} statements",
        })  # fmt: skip

    def _loops(self) -> str:
        passes = self.structure.passes.get(f"{self.name}_step")
        if passes is not None:
            start = self.structure.passes.get(f"{self.name}_start")
            more = "" if start is None else f", `{self.name}_start` {start}"
            return f"{_ENDS}\n  A step has {passes} passes of loops at most{more}."
        places = "".join(f"\n  - line {each}" for each in self.structure.by_data)
        return (
            f"{_ENDS}\n  NOT counted: the passes of a step, as these ends depend on data:{places}"
        )


def _filled(name: str, values: dict[str, str]) -> str:
    text = (resources.files(__package__) / "templates" / name).read_text("utf-8")
    return re.sub(r"@(\w+)@", lambda found: values[found[1]], text)


def _meaning(alarm: Alarm) -> str:
    known = _MEANINGS.get(alarm.kind, f"'{alarm.kind}' is not excluded")
    return known if alarm.status == "Unknown" else f"{known}, status {alarm.status}"


def prove(folder: Path, source: CSource, *, longest: float = _LONGEST, sizes: str = "") -> Proof:
    """Run the proof whose files are in ``folder/proof``, and write its report there.

    Parameters
    ----------
    folder
        of the exported controller.
    source
        its C code.
    longest
        time after which the analysis is ended, and nothing is proved [s].
    sizes
        stack and code of each function for the report, in Markdown.
    """
    contract = (folder / FOLDER / f"{source.name}_contract.h").read_text(encoding="utf-8")
    found = frama_c(folder, source.name, longest)
    header, code = ((folder / "src" / f"{source.name}{end}").read_bytes() for end in (".h", ".c"))
    read, digest = (
        structure(code.decode("utf-8"), f"{source.name}_step"),
        hashlib.sha256(header + code).hexdigest(),
    )
    promising = tuple(each for each in RETURN_U if each in source.operations)
    promised = contract.count("ensures ")
    proof = Proof(folder, source.name, found, read, promised, promising, digest, sizes)
    with written_atomically(folder / FOLDER / REPORT, overwrite=True) as part:
        part.write_text(proof.text, encoding="utf-8")
    return proof
