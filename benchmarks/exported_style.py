"""Style of exported C: rules of MISRA C:2012, the analyser of gcc, comparisons of real numbers.

    python benchmarks/exported_style.py [--rows TEXT] [--part I/N]

Every row of ``exported.py`` is exported in double and in single precision, and read by cppcheck
with its addon for MISRA C:2012, by gcc with ``-fanalyzer`` and by gcc with ``-Wfloat-equal``. The
table has for each rule the number of its places in all rows, and of the rows that have one. A rule
that is not in ``DEVIATIONS`` ends the script with 1, so does any report of the analyser.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path

from hostile_exports import exported_source
from measured import check_present, options_of, parser_of, part_of, write
from rich.console import Console
from rich.table import Table

from quell.export import CSource

# What <float.h> defines: cppcheck reads no headers of the system.
_CPPCHECK = (
    *("cppcheck", "--addon=misra", "--std=c99", "--platform=unix64", "--enable=warning"),
    *("-DDBL_MANT_DIG=53", "-DDBL_MAX=1.0e308", "-DFLT_MAX=1.0e38f", "-DFLT_MANT_DIG=24"),
    *("-U__FAST_MATH__", "-U__cplusplus", "-U_MSC_VER", "--inline-suppr", "--template={id}"),
)
ANALYSER = "analyser of gcc"
FLOAT_EQUAL = "-Wfloat-equal"
DEVIATIONS = {
    "2.2": "required: j * 1 + k stands where other designs have more than one of a kind",
    "8.14": "required: restrict is used where the translator knows that arguments differ",
    "10.3": "required: a variable of real numbers may begin with the integer 0",
    "10.8": "required: a sum of small integers becomes a real number, which is exact",
    "8.7": "advisory: functions and the default parameters are for the program that links the file",
    "8.9": "advisory: constants stand at the head of the file, with the module they are from",
    "12.1": "advisory: products need no parentheses in sums, comparisons none in conditions",
    "12.3": "advisory: the end of a loop is computed once, beside its beginning",
    "15.4": "advisory: a loop may have several ends",
    "15.5": "advisory: a function may return early, as the function in Python does",
    "17.8": "advisory: an argument may be changed, as in Python",
    "19.2": "advisory: arrays that are never used at once share their place in a union",
    "21.15": "required: memcpy is the way to the bits of a number that C defines",
    "2.3": "advisory: NAME_real, and structs of which only members are used, are for programs",
    "2.4": "advisory: the enums of flags and reasons are for programs",
    "2.5": "advisory: NAME_SAMPLE_TIME and the like are for programs",
    FLOAT_EQUAL: "flags that are 0 or 1, exact zeros, and x == x, which finds NaN",
}  # fmt: skip
"""Rules that exported code does not keep, and why."""
# Reports of the analyser that are wrong: it follows one pass of a loop that sets all entries. With
# MemorySanitizer nothing is read before it is set (``hostile_exports.py --sanitizer memory``).
_WRONG = ("use of uninitialized value ‘gain[i]’",)


def style_of(source: CSource) -> Counter[str]:
    """Return how many places of exported code break each rule."""
    with tempfile.TemporaryDirectory() as place:
        folder, name = Path(place), source.name
        (folder / f"{name}.h").write_text(source.header, encoding="utf-8")
        (folder / f"{name}.c").write_text(source.source, encoding="utf-8")
        text = _output(folder, *_CPPCHECK, f"{name}.c")
        found = Counter(re.findall(r"misra-c2012-(\d+\.\d+)", text))
        found.update(f"cppcheck: {each}" for each in re.findall(r"^[a-zA-Z]+$", text, re.MULTILINE))
        base = ("gcc", "-std=c99", "-O2", "-c", f"{name}.c", "-o", "out.o")
        said = [line for line in _output(folder, *base, "-fanalyzer").splitlines()
                if "warning:" in line and not any(each in line for each in _WRONG)]  # fmt: skip
        found[ANALYSER] = len(said)
        found[FLOAT_EQUAL] = _output(folder, *base, "-Wfloat-equal").count("warning:")
    return +found


def _output(folder: Path, *command: str) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr[:2000])
    return done.stdout + done.stderr


def unexplained(found: Counter[str]) -> list[str]:
    """Return what is neither kept nor listed as a deviation."""
    return sorted(set(found) - set(DEVIATIONS))


def main() -> None:
    """Read the rows and print a table of rules."""
    from exported import cases, chosen_rows

    parser = parser_of(__doc__)
    parser.add_argument("--rows", default="", help="controllers whose name has this text")
    parser.add_argument("--part", type=part_of, default="1/1", help="K/N: each N-th row from K on")
    options = options_of(parser, rows="PID", part="1/100")
    check_present(options, tools=("gcc", "cppcheck"))
    warnings.simplefilter("ignore")
    places: Counter[str] = Counter()
    having: Counter[str] = Counter()
    count, bad = 0, False
    for name, controller, precision in chosen_rows(cases(), options.rows, options.part):
        try:
            _, source = exported_source(controller, precision == "single")
        except ValueError:  # a model in Python
            continue
        found = style_of(source)
        count += 1
        places.update(found)
        having.update(found.keys())
        more = unexplained(found)
        bad = bad or bool(more)
        print(f"{name}, {source.precision}: {', '.join(more) or 'as listed'}", flush=True)
    table = Table("rule", "places", "rows", "of", "reason")
    for rule, number in sorted(places.items(), key=lambda each: -each[1]):
        reason = DEVIATIONS.get(rule, "")
        table.add_row(rule, f"{number}", f"{having[rule]}", f"{count}", reason)
    Console(width=150).print(table)
    figures = {
        rule: {"places": number, "rows": having[rule], "a deviation": DEVIATIONS.get(rule, "no")}
        for rule, number in places.items()
    }
    write(options, {"rows": count, **figures})
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
