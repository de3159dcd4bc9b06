"""Wrong versions of exported C, drawn by chance: does a test find them, or the proof.

    python benchmarks/mutated_exports.py [--count 60] [--seed 1] [--without-proof]

Changes of one place are drawn from the C code of several controllers, as many of each kind:

* *limit*: a comparison with a limit of u is turned round or dropped, a limit is taken for the
  other, the smaller of two numbers for the larger;
* *rate*: the same of a limit of the change of u;
* *NaN*: a test whether a number is finite or usable is always true, always false, or loses a part;
* *index*: a loop has a pass more or less, a place in an array is the next one;
* *copy*: a number too many or too few is written into an image or read from it, or one place off;
* *image*: a part of the check of an image is left out, or always refuses;
* *fields*: two numbers that follow one another are exchanged in an image, an assignment, or a call;
* *reset*: what a reset, a start or a handover sets stays as it was.

Each is given to judges in order of their cost, until one finds it: the golden vectors of
``test_NAME.c`` with the sanitizers of gcc; the hostile program (``hostile_exports.py``), which
finds reports and a bad u; the bits of all u and flags in that program, which must be those of the
unchanged code (which repeats the kernels: ``exported.py``); and Frama-C (``quell export --prove``).
A change that the compiler refuses is drawn again. What nobody finds, the proof included, ends the
script with 1, unless ``SAME`` says why it changes nothing.
"""

from __future__ import annotations

import dataclasses
import random
import re
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from hostile_exports import SANITIZERS, built, traced
from measured import check_present, options_of, parser_of, write
from proofs import write_proof
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.export.library import Exported
from quell.export.proof import prove

LIMITS = {"u_min": -2.0, "u_max": 3.0, "rate_limit": 60.0}
# Changes that make no difference, and the reason.
SAME = {
    "if (is_usable(unlimited)) { -> if (true || (is_usable(unlimited))) {": "between limits of u "
    "every finite u is usable, and no usable y or r makes one that is not finite",
    "if (is_usable(unlimited)) { -> if (false && (is_usable(unlimited))) {": "the line behind it "
    "accepts every finite u, as the limits are finite",
    "state->loop.has_reference = false; -> ;": "the loop is cleared two lines above; only the "
    "compensator of a u that is given has true there",
    "return fabs(a) <= DBL_MAX; -> return true || (fabs(a) <= DBL_MAX);": "limits of u are finite",
}


class Mutant(NamedTuple):
    """A change of a line of exported code, or of two that follow one another."""

    controller: str
    kind: str
    line: int
    before: str
    after: str
    block: str  # the lines behind it, as far as the function goes

    @property
    def next_line(self) -> str:
        """The line behind it."""
        return self.block.partition("\n")[0]

    @property
    def change(self) -> str:
        """What becomes what, in one line."""
        return " ".join(f"{self.before} -> {self.after}".split())

    @property
    def name(self) -> str:
        """The change in one line, with its place."""
        return f"{self.controller}, line {self.line}: {self.change}"


def controllers() -> dict[str, Any]:
    """Return controllers with limits, most of whose kinds of checks differ."""
    observer = ql.ESO.model_free(order=2, b0=1.5, omega_o=12.0, dt=0.01)
    pid = ql.baselines.PID(4.0, 2.0, 1.0, tf=0.05, dt=0.01, **LIMITS)
    move = ql.controllers.ProfileGenerator(0.5, 2.0, 5.0)
    return {
        "ADRC": ql.ADRC(observer, 1.5, **LIMITS),
        "PID behind a shaper": ql.controllers.Prefiltered(pid, ql.baselines.ZV(3.0)),
        "moves": ql.controllers.Prefiltered(
            ql.ADRC(observer, 1.5, feedforward=True, **LIMITS), move
        ),
        "Kalman, Guard": ql.ADRC(
            observer, 1.5, learner=ql.learners.Kalman(), guard=ql.Guard(), **LIMITS
        ),
    }


_NEXT = {"<": ">", ">": "<", "<=": ">=", ">=": "<="}
_NAN = re.compile(r"is_usable|is_finite|is_usable_control|(\w+(?:->\w+)?) == \1\b|_MAX")
_OTHERS = (("low", "high"), ("high", "low"), ("minimum(", "maximum("), ("maximum(", "minimum("),
           ("least_change", "most_change"), ("most_change", "least_change"))  # fmt: skip
_CHECKING = re.compile(r"memory_fits|\w+_load")
_RESETTING = re.compile(r"\w*(?:reset|restart|start|start_\w+|init|set_rest|at_rest|hand_over)\w*")
_STATEMENT = re.compile(r"\s+(?!return\b|const\b|break\b)[\w(][\w\[\]>.\-]*(?: [-+*/]?= |\()[^;]*;")
_HEAD = re.compile(r"\S.*?\b(\w+)\([^;]*$")
_ASSIGNMENT = re.compile(r"(\s+)([\w\[\]>.\-]+)( = )([^;]+)(;)")
_WRITTEN = re.compile(r"(\s+memory_put(?:_all)?\(image, \d+, )(.+?)((?:, \d+)?\);)")


def changes(line: str, function: str = "") -> Iterator[tuple[str, str]]:
    """Yield kind and text of all changes of a line of C code in a function."""
    code = line.partition("/*")[0]
    if re.search(r"\blimits(?:->|\.)|\bminimum\(|\bmaximum\(", code):
        kind = "rate" if "_change" in code else "limit"
        for found in re.finditer(r" (<=?|>=?) ", code):
            yield kind, f"{line[: found.start(1)]}{_NEXT[found[1]]}{line[found.end(1) :]}"
        for one, other in _OTHERS:
            if re.search(rf"\b{re.escape(one)}", code):
                yield kind, line.replace(one, other, 1)
        if re.fullmatch(r"\s+\w+ = [^;]*;\s*", code):
            yield kind, re.sub(r"\S.*", ";", line, count=1)
        if kind == "rate":
            yield kind, re.sub(r"\blimits->\w+_change", r"10.0 * \g<0>", line, count=1)
    if _NAN.search(code) and not _CHECKING.fullmatch(function):
        test = re.fullmatch(r"(\s*(?:\} else )?if )\((.*)\)( \{.*)", line)
        if test:
            yield "NaN", f"{test[1]}(true || ({test[2]})){test[3]}"
            yield "NaN", f"{test[1]}(false && ({test[2]})){test[3]}"
        value = re.fullmatch(r"(\s*return )(.*)(;.*)", line)
        if value and re.search(r"<=|>=|==|is_", value[2]) and "?" not in value[2]:
            yield "NaN", f"{value[1]}true || ({value[2]}){value[3]}"
        for found in re.finditer(r"(?<=\()[^()&|?]+ && |(\w+) == \1 && ", code):
            yield "NaN", f"{line[: found.start()]}{line[found.end() :]}"
        for found in re.finditer(r"(?:= |return )([^;?]+) \? ", code):
            yield "NaN", f"{line[: found.start(1)]}(true || ({found[1]})){line[found.end(1) :]}"
    if _CHECKING.fullmatch(function):
        test = re.fullmatch(r"(\s*if )\((.*)\)( \{.*)", line)
        if test:
            yield "image", f"{test[1]}(false && ({test[2]})){test[3]}"
        for found in re.finditer(
            r"(?:length|memory_get_\w+\([^()]*\)) != (?:\w+\(\w+\)|\w+)|x [<>]= \w+", code
        ):
            known = "true" if found[0].startswith("x ") else "false"
            yield "image", f"{line[: found.start()]}{known}{line[found.end() :]}"
        if "return" in code:
            for one, other in (("false", "true"), ("true", "false")):
                if one in code:
                    yield "image", line.replace(one, other)
    if "image" in code and "memory_" in code:
        for found in re.finditer(r"(?<=image, )\d+(?=[,)])|(?<=, )\d+(?=\);)", code):
            for number in (int(found[0]) + 1, int(found[0]) - 1):
                if number >= 0:
                    yield "copy", f"{line[: found.start()]}{number}{line[found.end() :]}"
    if _RESETTING.fullmatch(function) and _STATEMENT.fullmatch(code.rstrip()):
        yield "reset", re.sub(r"\S.*", ";", line, count=1)
    if "memory_" not in code:
        for found in re.finditer(r"(?<=[(,] |.\()(r|y|u)(, )(r|y|u)(?=[,)])", code):
            if function and _STATEMENT.match(line):
                exchanged = f"{found[3]}{found[2]}{found[1]}"
                yield "fields", f"{line[: found.start()]}{exchanged}{line[found.end() :]}"
    loop = re.match(r"\s*for \(int (\w+) = .*; \1 (<|>) ([^;]+); ", code)
    if loop:
        for more in (" + 1", " - 1"):
            yield "index", f"{line[: loop.end(3)]}{more}{line[loop.end(3) :]}"
    declares = re.match(r"\s*(?:const |static )*(?:double|float|int|servo_\w+)\b.*[;{(,]?$", code)
    if not (declares and "=" not in code):
        for found in re.finditer(r"(?<=[\w\]])\[([^\[\]]+)\]", code):
            yield "index", f"{line[: found.end(1)]} + 1{line[found.end(1) :]}"


def exchanges(line: str, following: str) -> Iterator[str]:
    """Yield the texts of two lines in which what they write, or where to, is exchanged."""
    one, other = _WRITTEN.fullmatch(line), _WRITTEN.fullmatch(following)
    if one and other and one[3] == other[3] and one[2] != other[2]:
        yield f"{one[1]}{other[2]}{one[3]}\n{other[1]}{one[2]}{other[3]}"
    one, other = _ASSIGNMENT.fullmatch(line), _ASSIGNMENT.fullmatch(following)
    if one and other and one[1] == other[1] and one[4] != other[4]:
        yield "\n".join("".join((here[1], there[2], *here.groups()[2:])) for here, there in
                        ((one, other), (other, one)))  # fmt: skip


def all_mutants(name: str, text: str) -> Iterator[Mutant]:
    """Yield all changes of the code of a controller."""
    function, lines = "", text.splitlines()
    for number, line in enumerate(lines, 1):
        head = _HEAD.fullmatch(line)
        function = head[1] if head else "" if line == "}" else function
        if not line.startswith("    ") or line.endswith((",", ")")):  # the head of a function
            continue
        for kind, after in changes(line, function):
            block = "\n".join(lines[number:]).partition("\n}\n")[0]
            yield Mutant(name, kind, number, line.strip(), after.strip(), block)
        for after in exchanges(line, lines[number]):
            before = f"{line}\n{lines[number]}"
            block = "\n".join(lines[number + 1 :]).partition("\n}\n")[0]
            yield Mutant(name, "fields", number, before.strip(), after.strip(), block)


def drawn(code: dict[str, str], count: int, chance: random.Random) -> list[Mutant]:
    """Return mutants of the sources, equally many of each kind, from all controllers."""
    found: dict[str, dict[str, list[Mutant]]] = {}
    for name, text in code.items():
        for mutant in all_mutants(name, text):
            found.setdefault(mutant.kind, {}).setdefault(name, []).append(mutant)
    chosen: list[Mutant] = []
    kinds = sorted(found)
    while len(chosen) < count and found:
        kind = kinds[len(chosen) % len(kinds)]
        pools = found[kind]
        name = chance.choice(sorted(pools))
        chosen.append(pools[name].pop(chance.randrange(len(pools[name]))))
        if not pools[name]:
            del pools[name]
        if not pools:
            del found[kind]
            kinds.remove(kind)
    return chosen


def changed(text: str, mutant: Mutant) -> str:
    """Return the text of a source with one place changed."""
    lines = text.splitlines(keepends=True)
    at, count = mutant.line - 1, mutant.before.count("\n") + 1
    old = "".join(lines[at : at + count])
    assert old.strip() == mutant.before
    lines[at : at + count] = [old.replace(mutant.before, mutant.after)]
    return "".join(lines)


def ends_well(command: list[str]) -> bool:
    """Return whether a program ends with 0 within two minutes."""
    try:
        return not subprocess.run(command, capture_output=True, check=False, timeout=120).returncode
    except subprocess.TimeoutExpired:
        return False


def judge(
    done: Exported, controller: Any, mutant: Mutant, right: str, calls: float, proves: bool
) -> str:
    """Return who finds a mutant; "compiler" where it is no program.

    ``right`` is the hash that the hostile program gives for the unchanged code.
    """
    with tempfile.TemporaryDirectory() as place:
        folder, source = Path(place), done.source
        wrong = dataclasses.replace(source, source=changed(source.source, mutant))
        name = source.name
        for end, text in ((".c", wrong.source), (".h", source.header)):
            (folder / f"{name}{end}").write_text(text, encoding="utf-8")
        vectors = done.folder / f"test_{name}.c"
        command = [*SANITIZERS["address"], "-std=c99", "-O1", "-ffp-contract=off", f"-I{folder}"]
        command += [str(vectors), f"{name}.c", "-o", "golden", "-lm"]
        if subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode:
            return "compiler"
        if not ends_well([str(folder / "golden")]):
            return "golden vectors"
        program = built(folder, controller, wrong)
        try:
            *found, trace = traced(program, calls, 600.0)
        except subprocess.TimeoutExpired:
            return "hostile calls"
        if found != ["0", "0", "0"]:
            return "hostile calls"
        if trace != right:
            return "bits"
    if not proves:
        return "NOBODY"
    file = done.folder / "src" / f"{name}.c"
    try:
        file.write_text(wrong.source, encoding="utf-8")
        return "NOBODY" if prove(done.folder, wrong).proved else "proof"
    finally:
        file.write_text(source.source, encoding="utf-8")


def why_same(mutant: Mutant) -> str:
    """Return why a mutant changes nothing; nothing if that is not known."""
    if mutant.next_line.strip() == "}" and mutant.before.startswith("if"):
        return "the branch is empty"
    if "predicted[i]" in mutant.block and mutant.after.endswith("- 1; i++) {"):
        return "f, the last state of the model, stays, and is there already"
    without = re.sub(r"(\w+(?:->\w+)?) == \1 && (?=\1 >)", "", mutant.before)
    if mutant.after == without:
        return "a comparison with a number is false for NaN, too; the test is there for Eva"
    return SAME.get(mutant.change, "")


def right_trace(controller: Any, done: Exported, calls: float) -> str:
    """Return the hash of the unchanged code in its hostile program."""
    with tempfile.TemporaryDirectory() as place:
        return traced(built(Path(place), controller, done.source), calls)[3]


def main() -> None:
    """Draw mutants, judge them and print a table."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--without-proof", action="store_true", help="the tests alone")
    parser.add_argument("--calls", type=float, default=1e6, help="of the hostile program")
    parser.add_argument("--only", default="", help="controllers whose name contains this")
    options = options_of(parser, count=1, calls=1e5, only="PID", without_proof=True)
    check_present(options, ["gcc"] if options.without_proof else ["gcc", "frama-c"])
    warnings.simplefilter("ignore")
    chance, table = random.Random(options.seed), Table("kind", "change", "found by", "time [s]")
    missed, found = 0, Counter[str]()
    with tempfile.TemporaryDirectory() as place:
        made = {
            name: (
                controller,
                ql.export.c(controller, Path(place) / f"c{i}", name="servo", proof=False),
            )
            for i, (name, controller) in enumerate(controllers().items())
            if options.only in name
        }
        for controller, done in made.values():  # the files of the proof, without a proof
            write_proof(done.folder, controller, done.source)
        right = {name: right_trace(*each, options.calls) for name, each in made.items()}
        code = {name: done.source.source for name, (_, done) in made.items()}
        judged = 0
        for mutant in drawn(code, 3 * options.count, chance):
            if judged == options.count:
                break
            begin = time.monotonic()
            controller, done = made[mutant.controller]
            trace, proves = right[mutant.controller], not options.without_proof
            by = judge(done, controller, mutant, trace, options.calls, proves)
            if by == "compiler":
                continue
            judged += 1
            if by == "NOBODY" and (reason := why_same(mutant)):
                by = f"nobody: {reason}"
            missed += by == "NOBODY"
            found[by.partition(":")[0]] += 1
            seconds = f"{time.monotonic() - begin:.0f}"
            print(f"{mutant.kind} | {mutant.name} | {by} | {seconds}", flush=True)
            table.add_row(mutant.kind, mutant.name, by, seconds)
    Console(width=170).print(table)
    print(f"{judged - missed} of {judged} are found")
    figures = {"judged": judged, "found": judged - missed, "found by": found, "missed": missed}
    write(options, figures)
    sys.exit(1 if missed and not options.without_proof else 0)


if __name__ == "__main__":
    main()
