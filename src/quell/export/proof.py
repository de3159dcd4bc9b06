"""A proof for an exported controller: what its C code can never do, whatever it is given.

* The first part writes a program that calls all functions in any order with any numbers, a contract
  for them in ACSL, and a script.
* The second runs Frama-C and reads what it has proved.
* The last says the result in words, with what the text of the code shows (``export/c_structure``).
"""

from __future__ import annotations

import hashlib
import math
import os
import re
import shlex
import shutil
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quell.export import separate
from quell.export.c_files import CSource
from quell.export.c_structure import Structure, structure
from quell.export.controller_source import at_path, limits_path, parts_of
from quell.export.translate.text import Literals
from quell.files import written_atomically

# ---- The files of a proof ----

FOLDER = "proof"
"""The folder of these files."""
PROPERTIES, SEPARATE = "properties.csv", "separate.csv"
"""The files with all that Frama-C has looked at, for the state as it is and for separate arrays."""
_LOGS = {PROPERTIES: "eva.log", SEPARATE: "separate.log"}

# One set of intervals at each place of the code, and short loops pass by pass: so arrays that they
# fill are known to be filled. Level 1 took four times as long and proved no more. Results that are
# infinite or no number are no alarm by themselves.
_OPTIONS = (
    *("-eva", "-eva-precision", "0", "-eva-auto-loop-unroll", "64"),
    *("-warn-special-float", "none", "-machdep", "gcc_x86_64"),
)

CALLS = {
    "step": "any_real, any_realDERIVATIVES",
    "step_counts": "any_count, any_countDERIVATIVES",
    "applied": "any_real",
    "track": "any_real, any_real, any_realDERIVATIVES",
    "hand_over": "",
    "set_held": "any_int != 0",
    "start": "any_real, any_real, any_real",
    "reset": "",
    "status": "",
    "get_estimate": "",
    "stopping_point": "",
    "save": "image",
    "load": "image, (size_t)any_int, any_int != 0",
}
"""Arguments of the functions, each call with other numbers; without ``init`` and ``retune``."""
_CALLS_OF_SEVERAL = CALLS | {
    "step": "r, yDERIVATIVES, u",
    "applied": "given",
    "track": "r, y, givenDERIVATIVES",
    "set_held": "any_int, any_int != 0",
    "start": "y, given, r",
    "stopping_point": "r",
}
RETURN_U = {"step": "REAL r, REAL y", "step_counts": "int32_t r, int32_t count",
             "track": "REAL r, REAL y, REAL u"}  # fmt: skip
"""Functions that return one u, and their arguments but for derivatives of the reference."""


def _returning_u(source: CSource) -> dict[str, str]:
    """Return the functions that return or write u, and their arguments behind the state."""
    real = source.real
    if source.sizes is not None:
        n, p, m = source.sizes
        more = "".join(f", const {real} {each}[{n}]" for each in source.further)
        return {"step": f"const {real} r[{n}], const {real} y[{p}]{more}, {real} u[{m}]"}
    more = "".join(f", {real} {each}" for each in source.further)
    return {
        operation: f"{given}{more}".replace("REAL", real)
        for operation, given in RETURN_U.items()
        if operation in source.operations
    }


def frama_c_options(name: str, table: str = PROPERTIES) -> tuple[str, ...]:
    """Return the arguments of frama-c for one of the tables, in the folder of the proof."""
    sources = (f"../src/{name}.c", f"{name}_proof.c")
    more = f",-include,{name}_{separate.HEADER}" if table == SEPARATE else ""
    return (*_OPTIONS, f"-cpp-extra-args=-I../src{more}", *sources, "-then", "-report-csv", table)


def proof_files(controller: Any, source: CSource) -> dict[str, str]:
    """Return the text of the files of a proof by path.

    Raises
    ------
    ValueError
        for a controller that calls functions of the user in C: nothing is known of them.
    """
    if source.externals:
        names = ", ".join(source.externals)
        raise ValueError(
            f"proof = True: the controller calls {names}, which is in C and which the proof can't "
            "see; leave the proof out, or the c_function: then its translation is proved, too"
        )
    name, path = source.name, limits_path(controller)
    options, own = (shlex.join(frama_c_options(name, each)) for each in (PROPERTIES, SEPARATE))
    texts = {"name": name, "options": options, "separate": own,
             "limits": " within its limits" if path else ""}  # fmt: skip
    return {
        f"{FOLDER}/{name}_contract.h": _contract(source, path),
        f"{FOLDER}/{name}_proof.c": _program(controller, source, path),
        f"{FOLDER}/{name}_{separate.HEADER}": separate.separated(source).header,
        f"{FOLDER}/{name}_exported.h": source.header,
        f"{FOLDER}/prove.sh": _filled("prove.sh", texts),
    }


def _contract(source: CSource, path: str) -> str:
    """Return the declarations of the functions that return u, with what they promise."""
    name, upper = source.name, source.name.upper()
    limits, places = f"state->parameters->{path}", [("\\result", "")]
    valid, kind = "\\valid(state) && \\valid_read(state->parameters)", source.real
    if source.sizes is not None:
        n, p, m = source.sizes
        places, kind = [(f"u[{k}]", f"[{k}]") for k in range(m)], "void"
        given = [("r", n), ("y", p), *((each, n) for each in source.further)]
        valid += "".join(f" && \\valid_read({each} + (0 .. {size - 1}))" for each, size in given)
        valid += f" && \\valid(u + (0 .. {m - 1}))"
    promises = []
    for u, k in places:
        promises.append(f"ensures a_number: \\is_finite({u});")
        if path:
            promises.append(f"ensures within_limits: {limits}.low{k} <= {u} <= {limits}.high{k};")
    lines = [
        f"/* What {name} promises, in ACSL: u is a number within the limits, for any arguments.",
        " *",
        " * A program with this header in place of the other one can be checked against it. */",
        f"#ifndef {upper}_CONTRACT_H",
        f"#define {upper}_CONTRACT_H",
        "",
        f'#include "{name}.h"',
    ]
    for operation, arguments in _returning_u(source).items():
        lines += [
            "",
            f"/*@ requires a_state: {valid};",
            *(f"    {each}" for each in promises),
            "*/",
            f"{kind} {name}_{operation}({name}_state *state, {arguments});",
        ]
    return "\n".join([*lines, "", "#endif", ""])


def _program(controller: Any, source: CSource, path: str) -> str:
    """Return the program that calls all functions in any order, with any numbers."""
    name, real, several = source.name, source.real, source.sizes is not None
    more = "".join(f", {each if several else 'any_real'}" for each in source.further)
    size = f"{name.upper()}_MEMORY_SIZE"
    cases: list[str] = []
    for i, (operation, given) in enumerate((_CALLS_OF_SEVERAL if several else CALLS).items()):
        if operation in source.operations:
            arguments = "".join(f", {each}" for each in [given] if each)
            call = f"{name}_{operation}(state{arguments.replace('DERIVATIVES', more)});"
            cases.append(f"        case {i}:")
            if operation == "load":
                cases += ["            for (int k = 0; k < SIZE; k++) {".replace("SIZE", size),
                          "                image[k] = any_byte;", "            }"]  # fmt: skip
            cases += [f"            {call}", "            break;"]
    counts = "step_counts" in source.operations
    narrower = narrower_limits(controller, path, source.precision)
    retuning = [
        f"    narrower = {name}_default_parameters;",
        *(f"    narrower.{path}.high{place} = {limit};" for place, limit in narrower),
        "    while (any_int) {",
        f"        {name}_retune(&controller, &narrower);",
        "        operate(&controller);",
        f"        {name}_retune(&controller, &{name}_default_parameters);",
        "        operate(&controller);",
        "    }",
    ]
    signals: list[tuple[str, int]] = []
    if source.sizes is not None:
        n, p, m = source.sizes
        signals = [("r", n), ("y", p), ("given", m), *((each, n) for each in source.further)]
    drawn = [f"        for (int k = 0; k < {size}; k++) {{\n            {each}[k] = any_real;\n"
             "        }" for each, size in signals]  # fmt: skip
    return "\n".join([
        f"/* All that a program can do with {name}: every function, in any order, for ever, with",
        " * any numbers, also infinities and NaN. Each read of a volatile variable is another. */",
        f'#include "{name}_contract.h"',
        "",
        f"static volatile {real} any_real;",
        "static volatile int any_int;",
        *(["static volatile int32_t any_count;"] if counts else []),
        "static volatile unsigned char any_byte;",
        f"static unsigned char image[{size}];",
        f"static {name}_state controller;",
        f"static {name}_parameters narrower;",
        *(f"static {real} {each}[{size}];" for each, size in signals),
        *([f"static {real} u[{source.sizes[2]}];"] if source.sizes is not None else []),
        "",
        f"static void operate({name}_state *state)",
        "{",
        "    while (any_int) {",
        *drawn,
        "        switch (any_int) {",
        *cases,
        "        default:",
        "            break;",
        "        }",
        "    }",
        "}",
        "",
        "int main(void)",
        "{",
        "#ifdef SEPARATE_ARRAYS",
        "    separate_arrays(&controller);",
        "#endif",
        f"    {name}_init(&controller);",
        "    operate(&controller);",
        *retuning,
        "    return 0;",
        "}",
        "",
    ])  # fmt: skip


def narrower_limits(controller: Any, path: str, precision: str) -> list[tuple[str, str]]:
    """Return place and value of upper limits below those of the controller, as C code."""
    if not path:
        return []
    limits = at_path(parts_of(controller, precision).parameters, path)
    write, several = Literals(precision == "single").write_real, np.ndim(limits.low) > 0
    found = []
    lows, highs = np.atleast_1d(limits.low).tolist(), np.atleast_1d(limits.high).tolist()
    for k, (low, high) in enumerate(zip(lows, highs, strict=True)):
        if math.isfinite(low) and math.isfinite(high):
            new = 0.5 * low + 0.5 * high
        elif math.isfinite(low):
            new = low + 1.0 + abs(low)
        else:
            new = high - 1.0 - abs(high) if math.isfinite(high) else 1.0
        found.append((f"[{k}]" if several else "", write(new)))
    return found


# ---- Frama-C ----

INSTALL = "there is no frama-c here (Debian and Ubuntu: apt-get install frama-c-base)"
_PROVED = ("Valid", "Considered valid")  # the second are contracts of the C library
# What functions of the C library change is an assumption, of which the report names the functions.
_ASSUMED = ("assigns clause", "from clause")
# A function of the second run's header that nothing calls is dead.
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
    """Run Frama-C in ``folder/proof``, twice, for at most ``longest`` seconds in all."""
    first = _run(folder, name, longest, PROPERTIES)
    if first.failure:
        return first
    second = _run(folder, name, max(longest - first.seconds, 1.0), SEPARATE)
    own = tuple(each for each in second.alarms if each not in first.alarms)
    return first._replace(
        seconds=first.seconds + second.seconds,
        alarms=(*first.alarms, *own),
        promises=min(first.promises, second.promises),
        failure=f"with separate arrays {second.failure}" if second.failure else "",
    )


def _run(folder: Path, name: str, longest: float, table: str) -> Findings:
    """Run Frama-C for one of the tables."""
    program = shutil.which("frama-c")
    if program is None:
        return Findings(failure=INSTALL)
    place = (folder / FOLDER).resolve()  # Frama-C takes the folder from PWD
    found, log = place / table, place / _LOGS[table]
    found.unlink(missing_ok=True)
    version = _output(program, "-version")
    begin = time.monotonic()
    try:
        with log.open("w", encoding="utf-8") as file:
            code = subprocess.run(
                [program, *frama_c_options(name, table)], cwd=place, stdout=file,
                stderr=subprocess.STDOUT, timeout=longest, check=False,
                env={**os.environ, "PWD": str(place)},
            ).returncode  # fmt: skip
    except subprocess.TimeoutExpired:
        return Findings(version, longest, failure=f"the analysis did not end in {longest:g} s")
    seconds = time.monotonic() - begin
    text = log.read_text(encoding="utf-8", errors="replace")
    if code or not found.exists() or "[eva:summary]" not in text:
        last = text.strip().splitlines()[-1:] or ["no output"]
        return Findings(version, seconds, failure=f"frama-c ended with {code}: {last[0][:200]}")
    return read_findings(version, seconds, text, found.read_text(encoding="utf-8"))


def read_findings(version: str, seconds: float, log: str, table: str) -> Findings:
    """Return what a log and a table of properties say."""
    rows = [line.split("\t") for line in table.splitlines()[1:]]
    alarms = [
        Alarm(Path(file).name, int(line), function, kind, status, text)
        for place, file, line, function, kind, status, text in rows
        if status not in _PROVED
        and not (place.startswith("FRAMAC_SHARE") and kind in _ASSUMED)
        and not (status == "Dead" and file.endswith(f"_{separate.HEADER}"))
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


# ---- The proof of an exported controller, and what it says to a safety engineer ----

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
    limited
        whether u has limits.
    left
        what the text says of arrays of the state that are not separate objects; empty if all are.
    loop
        what is certain of the stability of a loop with it, a sentence each (``export.stability``).
    """

    folder: Path
    name: str
    findings: Findings
    structure: Structure
    promised: int
    promising: tuple[str, ...]
    digest: str
    sizes: str = ""
    limited: bool = False
    left: str = ""
    loop: tuple[str, ...] = ()

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
        within = " within its limits" if self.limited else ""
        return f"Proved: no undefined behaviour, u is always a number{within} ({where})"

    @property
    def text(self) -> str:
        """The report in Markdown."""
        library = self.findings.assumed
        lines = "".join(f"- NOT proved: {each}\n" for each in self.open)
        loop = "".join(f"- {each}.\n" for each in self.loop)
        return _filled("REPORT.md", {
            "name": self.name,
            "summary": self.summary,
            "digest": self.digest,
            "results": "" if self.findings.failure else self._results(),
            "open": f"## What is open\n\n{lines}\n{_OPEN}" if lines else "",
            "library": ", ".join(f"`{each}`" for each in library) or "none",
            "loop": f"## The loop\n\n{loop}\n" if loop else "",
            "sizes": f"## Stack and code\n\n{self.sizes}\n" if self.sizes else "",
        })  # fmt: skip

    def _results(self) -> str:
        found, promising = self.findings, self.promising
        return _filled("results.md", {
            "name": self.name,
            "left": self.left,
            "head": "What is proved" if self.proved else "What holds but for the open properties",
            "functions": " or ".join(f"`{self.name}_{each}`" for each in promising),
            "limits": _LIMITS if self.limited else " There are no limits of u.",
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


def prove(
    folder: Path,
    source: CSource,
    *,
    longest: float = _LONGEST,
    sizes: str = "",
    loop: Sequence[str] = (),
) -> Proof:
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
    loop
        what is certain of the stability of a loop, a sentence each.
    """
    contract = (folder / FOLDER / f"{source.name}_contract.h").read_text(encoding="utf-8")
    header, code = ((folder / "src" / f"{source.name}{end}").read_bytes() for end in (".h", ".c"))
    found = frama_c(folder, source.name, longest)
    if header != source.header.encode("utf-8"):
        found = found._replace(failure="the header is not the one that was exported; export again")
    read, digest = (
        structure(code.decode("utf-8"), f"{source.name}_step"),
        hashlib.sha256(header + code).hexdigest(),
    )
    promising = tuple(_returning_u(source))
    promised = contract.count("ensures ")
    limited = "within_limits" in contract
    names = ", ".join(f"`{each}`" for each in separate.separated(source).left)
    left = f" These arrays are left in their struct, so the text alone is read: {names}." * bool(
        names
    )
    proof = Proof(
        *(folder, source.name, found, read, promised, promising, digest, sizes, limited, left),
        tuple(loop),
    )
    with written_atomically(folder / FOLDER / REPORT, overwrite=True) as part:
        part.write_text(proof.text, encoding="utf-8")
    return proof


__all__ = ["Alarm", "Proof", "proof_files", "prove"]
