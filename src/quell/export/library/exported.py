"""``c``: a controller as a library in C, with test and description.

The files around an exported controller: project files, description and example.

Code, constants, state and stack of an exported controller and its functions, as gcc tells.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from quell import checks
from quell.controllers.base import check_controller
from quell.export.c_files import CSource
from quell.export.controller_source import c_source, in_double_precision, is_in_single, limits_path
from quell.export.library.precision import Comparison, checked_comparison
from quell.export.library.vectors import (
    TOLERANCE_REASON,
    Vectors,
    filled,
    golden_vectors,
    test_program,
)
from quell.export.loop_stability import Stability, stability
from quell.export.proof import Proof, proof_files, prove
from quell.export.translate.text import checked_name
from quell.files import check_folder, write_folder
from quell.hints import explained
from quell.simulation.scenario import Scenario

# ---- The files around an exported controller ----

# Calls of the functions, and when they belong there; s is &state.
_OPERATIONS = {
    "init": ("init(s)", "once, before all others"),
    "start": ("start(s, y, u, r)", "the plant rests at y under u; long: before the timer starts"),
    "step": ("step(s, r, yDERIVATIVES)", "each sample; returns u"),
    "step_counts": (
        "step_counts(s, r, countDERIVATIVES)",
        "instead of the step, with r and y as encoder counts; without rounding of the position",
    ),
    "applied": ("applied(s, u)", "after the step, if another u was applied"),
    "track": ("track(s, r, y, uDERIVATIVES)", "instead of the step in manual operation, under u"),
    "hand_over": (
        "hand_over(s)",
        "once, before the first step after manual operation; false before the first sample",
    ),
    "set_held": (
        "set_held(s, held)",
        "when a brake closes or opens: while it is held u does not act, and nothing winds up",
    ),
    "retune": ("retune(s, &parameters)", "between two samples: other parameters, without a jump"),
    "save": ("save(s, image)", "any time: all that the controller knows, as bytes"),
    "load": (
        "load(s, image, length, resume)",
        "after the init: what was saved; false, and nothing changed, if it does not fit",
    ),
    "reset": ("reset(s)", "from rest at the next sample; what was learned is kept"),
    "stopping_point": (
        "stopping_point(s)",
        "after the step: where the move can stop soonest; as r of the next steps it stops there",
    ),
    "status": ("status(s)", "after the step: flags, see the enum in the header"),
    "get_estimate": ("get_estimate(s)", "after the step: what the controller knows, for telemetry"),
}
_TEXTS = ("CMakeLists.txt", "README.md")
_RETUNING = """## Other limits

Parameters are constants. To change a limit while running, change a copy:

```c
static NAME_parameters derated;

derated = NAME_default_parameters;
derated.PATH.high = ONE;
NAME_retune(&state, &derated); /* the copy must stay in memory, unchanged while it is in use */
```
"""
_EXTERNALS = """## Your functions

The controller calls functions that you have to link: FUNCTIONS. `src/NAME.c` declares them.

"""
_DOUBLE = """- `double` must have 8 bytes; where it has 4 (AVR) the file refuses to compile. A
  processor without a unit for double (Cortex-M4F) needs about twenty times as long as for single
  precision.

"""

_ONE_WORD = (
    "volatile float reference; "
    "/* the main loop writes it; one word, so that no half of it is read */"
)
_FED_FORWARD = """The controller feeds PRIMES of the reference forward, so they are arguments of
`NAME_step`. They belong to the same move as r: take all of them from one formula (`next_reference`
below), never from differences of r. At rest they are zero.
"""
_MOVES = """`r` is a target: the controller moves its reference there within limits of speed,
acceleration and jerk, as quickly as they allow; a law with feedforward has the derivatives of the
move. A new target may come in any sample, also during a move. `r_shaped` of `NAME_get_estimate` is
the reference; it equals `r` when the move has ended. To stop as soon as the limits allow, call
`NAME_stopping_point` once and hand its number over as `r` from the next step on. Other limits act
at once, by `NAME_retune`: `prefilter.v_max`, `prefilter.a_max` and `prefilter.j_max` of the
parameters, all above zero.

"""


def library_files(controller: Any, source: CSource, vectors: Vectors) -> dict[str, str]:
    """Return the text of all files of the library by path.

    Parameters
    ----------
    controller
        the exported controller.
    source
        its C code.
    vectors
        a run of it.
    """
    path, several = limits_path(controller), source.sizes is not None
    limit = f"{path}.high{'[0]' if several else ''}" if path else ""
    values = _values(source, controller.dt, limit)
    described = in_double_precision(controller)
    values |= (_texts_of_several if several else _texts_of_one)(described, source)
    kind = "_axes" if several else ""
    values["loop"] = filled(f"loop{kind}.md", values).rstrip("\n")
    name = source.name
    return {
        f"src/{name}.h": source.header,
        f"src/{name}.c": source.source,
        f"test_{name}.c": test_program(source, vectors),
        f"examples/{name}/{name}.ino": filled(f"example{kind}.ino", values),
        **{each: filled(each, values) for each in _TEXTS},
        **{each: filled(each, values) for each in FILES},
        "keywords.txt": _keywords(source),
    }


def _texts_of_one(controller: Any, source: CSource) -> dict[str, str]:
    """Return the texts of a controller of one u and y."""
    return {
        "title": f"Controller {type(controller).__name__}",
        **_with_signals(_reference_texts(source), source),
        "operations": _operation_rows(source, _OPERATIONS),
    }


def _operation_rows(source: CSource, operations: dict[str, tuple[str, str]]) -> str:
    """Return the rows of the table of the functions that a controller has."""
    given = "".join(f", {each}" for each in source.further)
    return "\n".join(
        f"| `{source.name}_{call.replace('DERIVATIVES', given)}` | {when} |"
        for operation, (call, when) in operations.items()
        if operation in source.operations
    )


def _values(source: CSource, dt: float, limit: str) -> dict[str, object]:
    """Return values of the templates; ``limit`` is the member of the parameters that is changed."""
    name, single = source.name, source.precision == "single"
    one = "1.0f" if single else "1.0"
    retuning = _RETUNING.replace("PATH.high", limit).replace("ONE", one) if limit else ""
    functions = ", ".join(f"`{each}`" for each in source.externals)
    externals = _EXTERNALS.replace("FUNCTIONS", functions) if functions else ""
    return {
        "name": name,
        "NAME": name.upper(),
        "precision": source.precision,
        "real": source.real,
        "one": one,
        "zero": "0.0f" if single else "0.0",
        "dt": repr(float(dt)),
        "fast_math": ", and so do the compensated sums" if single else "",
        "double": "" if single else _DOUBLE,
        "retuning": retuning.replace("NAME", name),
        "externals": externals.replace("NAME", name),
        "external_note": " # and your functions" if functions else "",
        "link": " YOUR_FILES" if functions else "",
        "tolerance_reason": TOLERANCE_REASON,
        "package_note": package_note(source),
    }


# What is otherwise for several axes.
_OPERATIONS_OF_AXES = _OPERATIONS | {
    "start": ("start(s, y, u, r)", "the machine rests at y under u; long: before the timer starts"),
    "step": ("step(s, r, yDERIVATIVES, u)", "each sample; writes u"),
    "set_held": (
        "set_held(s, axis, held)",
        "when a brake of an axis closes or opens: while it is held nothing winds up",
    ),
}


_OPERATIONS_OF_FEEDBACK = _OPERATIONS_OF_AXES | {
    "start": ("start(s, y, u, r)", "the plant rests at y under u"),
    "retune": ("retune(s, &parameters)", "between two samples: other limits"),
    "reset": ("reset(s)", "from rest at the next sample"),
}


def _texts_of_several(controller: Any, source: CSource) -> dict[str, str]:
    """Return the texts of several axes, and of state feedback."""
    upper, (n, p, m) = source.name.upper(), source.sizes or (1, 1, 1)
    arrays = "".join(f", {each}[{upper}_AXES]" for each in source.further)
    primes = ", ".join("r" + "'" * (i + 1) for i in range(source.derivatives))
    if source.axes:
        names = ", ".join(f"{i} `{name}`" for i, name in enumerate(controller.names))
        title, sizes = f"Controller of {p} axes with {m} actuators", ("AXES", "AXES")
        about = f"The places of the axes in `r`, `y` and `v`: {names}."
        if controller.takes_u_0:
            sizes = ("ACTUATORS", "AXES")
            about = f"`r` are the u_0 of other controllers, with the places of `u`. {about}"
    else:
        title, sizes = (
            f"State feedback of {p} outputs with {m} actuators",
            ("REFERENCES", "MEASUREMENTS"),
        )
        about = f"`r` has a number for each of the {n} controlled outputs, in their order."
    return {
        "title": title,
        "operations": _operation_rows(
            source, _OPERATIONS_OF_AXES if source.axes else _OPERATIONS_OF_FEEDBACK
        ),
        "places": f"{about} `r`, `y` and `u` must be different arrays.",
        "r_size": f"{upper}_{sizes[0]}",
        "y_size": f"{upper}_{sizes[1]}",
        "further": "".join(f", {each}" for each in source.further),
        "local_further": arrays,
        "declared_further": arrays.replace(", ", f", {source.real} "),
        "about_further": f" /* with {primes} of the same move */" if primes else "",
    }


def _reference_texts(source: CSource) -> dict[str, str]:
    """Return the parts of the examples that make the reference of a sample."""
    count, real = source.derivatives, source.real
    zero = "0.0f" if source.precision == "single" else "0.0"
    if not count:
        moves = "stopping_point" in source.operations
        target = " /* target of the moves */" if moves else ""
        return {
            "about_reference": _MOVES.replace("NAME", source.name) if moves else "",
            "declared_reference": _ONE_WORD,
            "defined_reference": f"static {real} reference = {zero};{target}",
            "next_reference": "",
            "reference": "reference",
            "derivatives": "",
        }
    primes = ", ".join("r" + "'" * (i + 1) for i in range(count))
    about = _FED_FORWARD.replace("NAME", source.name).replace("PRIMES", primes)
    names = f"{real} r[{count + 1}]"
    return {
        "about_reference": about,
        "declared_reference": f"extern void next_reference({names}); /* r, {primes} */",
        "defined_reference": (
            f"/* Set r, {primes} of a sample: replace it by your move, with its derivatives. */\n"
            f"static void next_reference({names})\n{{\n"
            f"    for (int i = 0; i <= {count}; i++)\n        r[i] = {zero};\n}}"
        ),
        "next_reference": f"    {names};\n\n    next_reference(r);\n",
        "reference": "r[0]",
        "derivatives": "".join(f", r[{i + 1}]" for i in range(count)),
    }


def _with_signals(texts: dict[str, str], source: CSource) -> dict[str, str]:
    """Return the texts with the signals of a schedule, as further variables of the examples."""
    names, zero = source.further[source.derivatives :], "0.0"
    zero += "f" if source.precision == "single" else ""
    what = "/* a signal that the gains follow: write it before each step */"
    found = dict(texts)
    for name in names:
        found["declared_reference"] += f"\nvolatile {source.real} {name}; {what}"
        found["defined_reference"] += f"\nstatic {source.real} {name} = {zero}; {what}"
        found["derivatives"] += f", {name}"
    return found


# ---- Code, constants, state and stack of an exported controller and its functions ----

# Compilers for targets, of which the first that is here measures; then that of this machine.
_ARM = ("-mthumb", "-mfloat-abi=hard")
_TARGETS = {
    "single": ("Cortex-M4F", ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", *_ARM)),
    "double": ("Cortex-M7", ("-mcpu=cortex-m7", "-mfpu=fpv5-d16", *_ARM)),
}
_CROSS = "arm-none-eabi-"
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off")
"""Flags with which the golden vectors hold bit for bit."""
# A compiler that takes longer hangs: the largest learners take some seconds.
_LONGEST = 120.0
# gcc 10 and later write the calls of functions, with the stack of each.
_CALLS = "-fcallgraph-info=su"


class Sizes(NamedTuple):
    """Bytes that a controller takes on a processor.

    Attributes
    ----------
    processor, compiler
        for which, and by which compiler (with ``-O2``).
    code, constants
        of all functions, without the C library.
    state, parameters
        of one ``NAME_state``, and of one ``NAME_parameters``, which is part of the constants.
    stack
        of ``NAME_step`` and all it calls, without the C library; None if the compiler can't tell.
    """

    processor: str
    compiler: str
    code: int
    constants: int
    state: int
    parameters: int
    stack: int | None


class FunctionSize(NamedTuple):
    """What a public function of an exported controller takes on a processor.

    Attributes
    ----------
    name
        of the function.
    stack
        bytes at most, with all it calls, without the C library; None if the compiler can't tell.
    instructions
        of its code and that of all functions it calls, each counted once; not how many run.
    """

    name: str
    stack: int | None
    instructions: int


class NoCompilerError(ValueError):
    """There is no C compiler for what is asked, or it fails."""


def measured_sizes(name: str, header: str, source: str, precision: str) -> Sizes:
    """Return the sizes of a controller, whose files are given as texts.

    Raises
    ------
    NoCompilerError
        if there is no gcc; and if it fails, with its first message.
    """
    processor, prefix, flags = _compiler(precision)
    with tempfile.TemporaryDirectory(prefix="quell-sizes-") as folder:
        place = Path(folder)
        (place / f"{name}.h").write_text(header, encoding="utf-8")
        (place / f"{name}.c").write_text(source, encoding="utf-8")
        structs = f'#include "{name}.h"\nchar of_state[sizeof({name}_state)];\n'
        structs += f"char of_parameters[sizeof({name}_parameters)];\n"
        (place / "structs.c").write_text(structs, encoding="utf-8")
        _run(place, f"{prefix}gcc", *FLAGS, *flags, _CALLS, "-c", f"{name}.c", "structs.c")
        sections = _run(place, f"{prefix}size", "-A", f"{name}.o")
        symbols = _run(place, f"{prefix}nm", "-S", "structs.o")
        calls = place / f"{name}.ci"
        stack = stack_of(f"{name}_step", calls.read_text(encoding="utf-8"))
    return Sizes(
        processor,
        f"{prefix}gcc",
        _sum(sections, ".text"),
        _sum(sections, ".rodata"),
        _size_of("of_state", symbols),
        _size_of("of_parameters", symbols),
        stack,
    )


def function_sizes(
    name: str, header: str, source: str, precision: str, operations: Iterable[str]
) -> tuple[str, tuple[FunctionSize, ...]]:
    """Return a text that names processor and compiler, and what each public function takes.

    Arguments and errors are those of ``measured_sizes``; ``operations`` are the names of the
    functions without prefix.
    """
    processor, prefix, flags = _compiler(precision)
    if shutil.which(f"{prefix}objdump") is None:
        raise NoCompilerError(f"there is no {prefix}objdump here")
    with tempfile.TemporaryDirectory(prefix="quell-sizes-") as folder:
        place = Path(folder)
        (place / f"{name}.h").write_text(header, encoding="utf-8")
        (place / f"{name}.c").write_text(source, encoding="utf-8")
        _run(place, f"{prefix}gcc", *FLAGS, *flags, _CALLS, "-c", f"{name}.c")
        code = _run(place, f"{prefix}objdump", "-d", "--no-show-raw-insn", f"{name}.o")
        calls = (place / f"{name}.ci").read_text(encoding="utf-8")
    counts = _instructions(code)
    edges = _edges(calls)
    found = []
    for function in (f"{name}_{each}" for each in operations):
        reached, waiting = {function}, [function]
        while waiting:
            more = edges.get(waiting.pop(), set()) - reached
            reached |= more
            waiting += more
        total = sum(counts.get(each, 0) for each in reached)
        found.append(FunctionSize(function, stack_of(function, calls), total))
    return f"{processor}, {prefix}gcc {' '.join(FLAGS[1:])}", tuple(found)


def _instructions(code: str) -> dict[str, int]:
    """Return the number of instructions of each function in a listing of objdump."""
    counts: dict[str, int] = {}
    function = ""
    for line in code.splitlines():
        head = re.fullmatch(r"[0-9a-f]+ <([\w.]+)>:", line)
        if head:
            function = head[1]
        elif re.match(r"\s+[0-9a-f]+:\t", line) and not re.search(r"\t\.(word|short|byte)", line):
            counts[function] = counts.get(function, 0) + 1
    return counts


def _compiler(precision: str) -> tuple[str, str, tuple[str, ...]]:
    """Return the processor, the prefix of the compiler's programs, and its flags."""
    processor, flags = _TARGETS[precision]
    for found in ((processor, _CROSS, flags), (platform.machine(), "", ())):
        if all(shutil.which(found[1] + program) for program in ("gcc", "size", "nm")):
            return found
    raise NoCompilerError("there is no gcc here")


def _run(folder: Path, *command: str) -> str:
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=_LONGEST, check=False
    )
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "error" in line]
        raise NoCompilerError(f"{command[0]} fails: {(lines or [done.stderr.strip()])[0]}")
    return done.stdout


def _sum(sections: str, kind: str) -> int:
    pattern = rf"^{re.escape(kind)}\S*\s+(\d+)"
    return sum(int(size) for size in re.findall(pattern, sections, re.MULTILINE))


def _size_of(symbol: str, symbols: str) -> int:
    found = re.search(rf"^\S+ (\S+) \w {symbol}$", symbols, re.MULTILINE)
    if found is None:
        raise NoCompilerError("the output of nm is not known")
    return int(found[1], 16)


def stack_of(function: str, calls: str) -> int | None:
    """Return the stack of a function and the deepest of its calls, from the graph of gcc.

    ``calls`` is the content of the ``.ci`` file, in the format VCG. Functions of other files count
    as zero. None if the graph lacks the function.
    """
    own = {
        found[1].rpartition(":")[2]: int(found[2])
        for found in re.finditer(
            r'node: \{ title: "([^"]+)" label: "[^"]*?(\d+) bytes', calls.replace("\\n", " ")
        )
    }
    edges = _edges(calls)

    def depth(name: str) -> int:
        return own.get(name, 0) + max((depth(each) for each in edges.get(name, ())), default=0)

    return depth(function) if function in own else None


def _edges(calls: str) -> dict[str, set[str]]:
    """Return the functions that each function calls, from the graph of gcc."""
    edges: dict[str, set[str]] = {}
    for found in re.finditer(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', calls):
        caller, called = (found[i].rpartition(":")[2] for i in (1, 2))
        edges.setdefault(caller, set()).add(called)
    return edges


# ---- c ----


@dataclass(frozen=True)
class Exported:
    """A controller that was exported to C."""

    folder: Path  #: the folder
    files: tuple[Path, ...]  #: all files in it
    source: CSource  #: texts of header and source
    comparison: Comparison | None  #: single to double precision, if they were compared
    proof: Proof | None = None  #: what was proved, if it was asked for
    stability: Stability | None = None  #: of the loop, if a proof and a plant were given

    def sizes(self) -> Sizes:
        """Return the bytes of code, state and stack, as gcc tells: for ARM if it can.

        Raises
        ------
        NoCompilerError
            if there is no gcc.
        """
        source = self.source
        return measured_sizes(source.name, source.header, source.source, source.precision)


@explained('quell.export.c(controller, "folder")')
def c(
    controller: Any,
    folder: str | os.PathLike[str],
    *,
    name: str = "controller",
    precision: str = "double",
    plant: Any = None,
    scenario: Scenario | None = None,
    resolution: float | None = None,
    accept: bool = False,
    proof: bool = False,
    spread: float = 0.0,
    overwrite: bool = False,
) -> Exported:
    """Write a controller as a library in C99, translated from the kernels that simulate it.

    The folder is a project for CMake, a library for Arduino and PlatformIO, and a component for
    ESP-IDF (docs/ecosystems): ``src/NAME.h`` and ``src/NAME.c``, a test with golden vectors
    ``test_NAME.c``, and ``README.md``. Without contraction to FMA the code gives, in double
    precision, the bits of the interpreted kernels, and in single precision those of
    ``simulate(..., precision="single", interpret=True)``.

    Parameters
    ----------
    controller
        any controller that does not call Python; its parameters and its state before the first
        sample are written. Of several axes, ``quell.Axes`` (docs/axes), and of
        ``controllers.StateFeedback`` the functions take arrays.
    folder
        where to write; must be new or empty.
    name
        begins the names of all files, types and functions.
    precision
        ``"double"`` or ``"single"``.
    plant, scenario
        for single precision, both: the loop in which it is compared with double; of several axes
        with a plant of as many signals. With ``proof`` a plant alone will do.
    resolution
        of an encoder [y-unit per count]: adds ``NAME_step_counts``, which takes r and y as integers
        and computes with differences to the last count. For an ADRC without model of the position.
    accept
        write in single precision even if nothing is compared, or the difference is too large.
    proof
        also write the folder ``proof``, and prove with Frama-C, where it is installed, that no
        behaviour of the code is undefined and that u is always a number within its limits. It takes
        seconds for an observer of order 2, minutes with a learner; ``Exported.proof`` and
        ``proof/REPORT.md`` have the result. With a linear ``plant`` the report says whether the
        loop is stable with the numbers of the C code, and how much rounding changes u
        (``export.stability``; the extra ``proof`` installs what it needs).
    spread
        share of each coefficient of the plant and of its gain within which the loop shall be
        stable, too.
    overwrite
        whether files of the same names in the folder may be replaced.

    Raises
    ------
    ValueError
        for a name that C, C++, their headers or CMake use; a folder with files; a controller with
        parts in Python (``TranslationError``); parameters out of the range of single precision;
        a plant or a scenario alone, or for double precision, without a proof; single precision
        that differs too much, or is not compared, without ``accept``; a proof of a controller that
        calls functions in C; and a spread without a proof and a plant. Nothing is written then.

    Examples
    --------
    >>> import tempfile
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=1e-3)
    >>> controller = ql.ADRC(observer, omega_c=4.0, u_min=-1.0, u_max=1.0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     exported = c(controller, folder, name="servo")
    ...     [path.name for path in exported.files[:3]]
    ['servo.h', 'servo.c', 'test_servo.c']
    """
    check_controller(controller, several=True)
    checked_name(name, "CMake")
    single = checks.one_of("precision", precision, ("double", "single")) == "single"
    check_folder(folder, checks.flag("overwrite", overwrite))
    checks.flag("proof", proof)
    single = single or is_in_single(controller)
    source = c_source(controller, name, precision=precision, resolution=resolution)
    if spread and (not proof or plant is None):
        raise ValueError(f"spread = {spread!r}: goes with proof=True and a plant")
    compared = plant if scenario is not None or not proof else None
    comparison = checked_comparison(controller, single, compared, scenario, accept)
    stable, lines = None, []
    if proof and plant is not None:
        number = "single" if single else "double"
        try:
            stable = stability(controller, plant, precision=number, spread=spread)
            lines = stable.lines
        except (ValueError, ImportError) as error:
            if spread:
                raise
            lines = [f"NOT judged: whether the loop is stable: {error}"]
    proving = proof_files(controller, source) if proof else {}
    vectors = golden_vectors(controller, source)
    files = write_folder(folder, library_files(controller, source, vectors) | proving, overwrite)
    table = _function_table(source) if proof else ""
    done = prove(Path(folder), source, sizes=table, loop=lines) if proof else None
    return Exported(Path(folder), files, source, comparison, done, stable)


def _function_table(source: CSource) -> str:
    """Return a table in Markdown of what each public function takes, or why there is none."""
    try:
        place, functions = function_sizes(
            source.name, source.header, source.source, source.precision, source.operations
        )
    except NoCompilerError as error:
        return f"NOT measured: {error}.\n"
    rows = "".join(
        f"| `{each.name}` | {'–' if each.stack is None else each.stack} | {each.instructions} |\n"
        for each in functions
    )
    return (
        f"For {place}. Stack is the most that the function and all it calls take, by the\n"
        "compiler's graph of calls; instructions are those of its code and of what it calls, each\n"
        "counted once. Functions of the C library are not counted, nor registers of interrupts.\n\n"
        f"| function | stack at most [bytes] | instructions in the code |\n|---|---|---|\n{rows}"
    )


# ---- The files by which package managers know an exported controller ----

FILES = ("LICENSE", "idf_component.yml", "library.json", "library.properties")
"""Templates of the root of the folder; ``keywords.txt`` is written from the header."""

# Rules LP010, LP014 and LP016 of arduino-lint with --compliance strict.
_LONGEST_NAME = 32
_WORDS = ("arduino", "library")


def package_note(source: CSource) -> str:
    """Return the paragraph of README.md on what to change before the folder is published."""
    name = source.name
    objections = [f"{word} in it" for word in _WORDS if word in name.lower()]
    if len(name) > _LONGEST_NAME:
        objections.append(f"{len(name)} characters, {_LONGEST_NAME} are allowed")
    if not objections:
        return ""
    return (
        f"NOT for Arduino's Library Manager: the name {name} has {objections[0]}. Export with "
        "another name to submit it; in your\nsketchbook the folder works as it is.\n\n"
    )


def _keywords(source: CSource) -> str:
    """Return ``keywords.txt``: types, functions and constants that Arduino's editor colours."""
    name, upper = source.name, source.name.upper()
    types = re.findall(rf"^(?:}} |typedef \w+ )({name}_\w+);$", source.header, re.M)
    constants = re.findall(rf"^#define ({upper}_\w+) ", source.header, re.M)
    for members in re.findall(r"^enum \w+ \{(.*?)\}", source.header, re.M | re.S):
        constants += re.findall(rf"\b({upper}_\w+) =", members)
    rows = [
        *((each, "KEYWORD1") for each in types),
        *((f"{name}_{each}", "KEYWORD2") for each in source.operations),
        *((each, "LITERAL1") for each in (*constants, f"{name}_default_parameters")),
    ]
    return "".join(f"{word}\t{kind}\n" for word, kind in dict(rows).items())
