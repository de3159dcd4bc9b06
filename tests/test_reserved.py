"""``quell.export.reserved``: each word that a target has for itself is refused, or the export compiles."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

import quell as ql
from quell.export import reserved
from quell.export.axes_source import names_in_c
from quell.export.reserved import is_taken_in_st, objection
from quell.export.structured_text.function_block import st_source
from quell.export.translate.text import function_name, identifier

from .in_c import needs_gcc

ALONE = reserved.C | reserved.CPP | reserved.MACROS | reserved.ARDUINO
CALLED = reserved.FUNCTIONS | reserved.ARDUINO_CALLED
OTHERS = reserved.HEADERS | reserved.DEVICES | reserved.CMAKE | reserved.FMI | reserved.ROS2
WORDS = sorted(ALONE | CALLED | OTHERS | reserved.IEC)
# The macros of Arduino.h and binary.h that a header meets in a sketch.
SKETCH = "".join(f"#define {word} 1\n" for word in sorted(reserved.ARDUINO - {"A0"}))
SKETCH += (
    "#define abs(x) ((x)>0?(x):-(x))\n#define round(x) ((x)>=0?(long)((x)+0.5):(long)((x)-0.5))\n"
)
SKETCH += (
    "#define min(a,b) ((a)<(b)?(a):(b))\n#define max(a,b) ((a)>(b)?(a):(b))\n#define F(x) (x)\n"
)
SKETCH += "#define sq(x) ((x)*(x))\n#define bit(b) (1UL << (b))\n#define word(...) 1\n"
OWN = "#include <float.h>\n#include <math.h>\n#include <stdbool.h>\n#include <stdint.h>\n#include <string.h>\n"
HEADERS = "#include <complex.h>\n#include <errno.h>\n#include <float.h>\n#include <math.h>\n"
HEADERS += "#include <stdbool.h>\n#include <stdint.h>\n#include <stdio.h>\n#include <stdlib.h>\n"
HEADERS += "#include <string.h>\n#include <time.h>\n"


def servo() -> ql.ADRC:
    """Return a small controller."""
    return ql.ADRC(ql.ESO.model_free(2, 3.0, 25.0, 0.01), 4.0, u_min=-2.0, u_max=1.5)


def test_a_refusal_names_the_word_and_the_target_and_says_what_to_do() -> None:
    """Also for a spelling that makes no difference to the target."""
    for target, word in (("C", "while"), ("C", "Features"), ("C", "arduino"), ("C", "Aux"),
                         ("CMake", "Test"), ("FMI", "model"), ("ROS 2", "pluginlib"),
                         ("Structured Text", "Override"), ("Structured Text", "LTIME")):  # fmt: skip
        said = objection(word, target)
        assert said.startswith(f"name = {word!r}: is a"), said
        assert f"target {target}" in said
        assert said.endswith("choose another name")


def test_good_names_are_not_refused() -> None:
    """In C the name of a controller begins longer names, so macros are no reason to refuse it."""
    for word in ("PI", "servo", "HIGH", "linux", "controller", "axis1", "method"):
        assert not objection(word, "C")
        assert not objection(word, "CMake")
    assert not objection("servo", "Structured Text")
    assert not objection("controller", "ROS 2")


def test_names_of_axes_are_no_word_of_a_header_or_a_language() -> None:
    """Macros get an underscore, as keywords do; words that are functions alone stay."""
    assert names_in_c(("NULL", "unix", "M_PI", "B0", "PI", "class", "round")) == (
        "NULL_", "unix_", "M_PI_", "B0_", "PI_", "class_", "round"
    )  # fmt: skip
    assert function_name("round") == "round_"
    assert function_name("max") == "max_"


def test_structured_text_has_the_keywords_of_edition_3() -> None:
    """IEC 61131-3:2013, table 1 and the chapters on classes, references and long times."""
    for word in ["method", "interface", "extends", "implements", "override", "super", "this", "ltime", "ldate", "ltod", "ldt", "namespace", "using", "abstract", "final", "ref_to", "null", "overlap", "class", "wchar"]:  # fmt: skip
        assert is_taken_in_st(word)
        assert is_taken_in_st(word.upper())
    for word in ("Method", "LTime", "super"):
        with pytest.raises(ValueError, match=f"name = '{word}': is a keyword of Structured Text"):
            ql.export.st_source(servo(), word)


@pytest.mark.trial
@needs_gcc
def test_each_word_as_a_variable_a_field_and_a_function_compiles(tmp_path: Path) -> None:
    """As C99, GNU C and C++, behind the headers of C and behind the macros of a sketch."""
    words = [word for word in WORDS if re.fullmatch(r"[A-Za-z]\w*", word)]
    members = names_in_c(tuple(words))
    code = "".join(f"typedef struct {{ double {each}; }} s{i};\nenum {{ X_AXIS_{each.upper()}_{i} }};\n"
                   f"static double f{i}(s{i} s, double {identifier(word)});\n"
                   f"static double f{i}(s{i} s, double {identifier(word)})\n"
                   f"{{ return s.{each} + {identifier(word)}; }}\n"
                   for i, (word, each) in enumerate(zip(words, members, strict=True)))  # fmt: skip
    functions = "".join(f"static double {name}(double a)\n{{ return a; }}\n"
                        for name in sorted({function_name(word) for word in words}))  # fmt: skip
    for place, (head, text) in enumerate(
        ((HEADERS, code), (SKETCH, code), (OWN, functions), (SKETCH, functions))
    ):
        (tmp_path / f"all{place}.c").write_text(head + text)
    for place in range(4):
        file = tmp_path / f"all{place}.c"
        commands = [["gcc", "-std=c99"], ["gcc", "-std=gnu17"]]
        commands += [["clang"]] if shutil.which("clang") else []
        if shutil.which("g++") and place != 2:  # C++ takes more than a translated file does
            commands += [["g++", "-x", "c++"], ["g++", "-std=c++11", "-x", "c++"]]
        for command in commands:
            done = subprocess.run([*command, "-w", "-fsyntax-only", file], capture_output=True,
                                  text=True, check=False)  # fmt: skip
            assert done.returncode == 0, (place, command, done.stderr[:800])


@pytest.mark.trial
@needs_gcc
def test_each_word_as_the_name_of_a_controller_compiles_or_is_refused(tmp_path: Path) -> None:
    """The texts of an export with the name in place of another one, as the writer puts it."""
    source = ql.export.c_source(servo(), "zqservo")
    allowed = [word for word in WORDS
               if re.fullmatch(r"[A-Za-z]\w*", word) and not objection(word, "C")]  # fmt: skip
    # No public name is the bare word, so that only a longer one could be taken.
    tokens = set(
        re.findall(r"[A-Za-z_]\w*", re.sub(r"/\*.*?\*/|#include.*", "", source.header, flags=re.S))
    )
    assert "zqservo" not in tokens
    lines = [HEADERS]
    for word in allowed:
        text = source.header.replace("zqservo", word).replace(
            "ZQSERVO", f"{word.upper()}_OF_{word}"
        )
        lines.append(text)
    (tmp_path / "headers.c").write_text("\n".join(lines))
    for command in (["gcc", "-std=c99"], ["gcc"], ["g++", "-x", "c++"]):
        if shutil.which(command[0]):
            done = subprocess.run([*command, "-w", "-fsyntax-only", tmp_path / "headers.c"],
                                  capture_output=True, text=True, check=False)  # fmt: skip
            assert done.returncode == 0, done.stderr[:800]
    for word in ("PI", "linux", "NAN", "errno_", "HIGH", "method"):
        ql.export.c(servo(), tmp_path / word, name=word)
        done = subprocess.run(["gcc", f"-I{tmp_path / word / 'src'}", tmp_path / word / f"test_{word}.c",
                               tmp_path / word / f"src/{word}.c", "-lm", "-o", tmp_path / "test"],
                              capture_output=True, text=True, check=False)  # fmt: skip
        assert done.returncode == 0, done.stderr[:800]
    for word in reserved.IEC:
        assert objection(word, "Structured Text")
    text = st_source(servo(), "zqservo")
    declared = re.findall(r"^\s*(\w+)(?:, \w+)* :", text, re.M)
    assert declared
    assert not [name for name in declared if is_taken_in_st(name)]
