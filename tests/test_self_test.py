"""The self-test of an export, ``test_NAME.c``: it fails for a controller that is not what quell has written."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

import quell as ql
from quell.controllers.memory import HEADER
from quell.export.library.vectors import SAVED, golden_vectors

from .in_c import needs_gcc
from .python_step import interpreted

LIMITS = {"u_min": -2.0, "u_max": 1.5, "rate_limit": 60.0}


def servo() -> ql.ADRC:
    """Return a small controller."""
    return ql.ADRC(ql.ESO.model_free(2, 3.0, 25.0, 0.01), 4.0, **LIMITS)


@pytest.mark.trial
def test_the_images_of_a_run_are_those_of_the_controller() -> None:
    """One of a running loop, and what a start without resume leaves of it; the run goes on as if there were none."""
    controller = servo()
    vectors = golden_vectors(controller, ql.export.c_source(controller, "servo"))
    running, at_rest = vectors.images
    assert running[: HEADER.size] == at_rest[: HEADER.size]
    assert running != at_rest
    assert len(running) == HEADER.size + 8 * sum(count for count, _ in vectors.parts) + 8
    own = interpreted(servo())
    own.restore(running, running=True)
    assert own.memory() == running
    own.restore(running)
    assert own.memory() == at_rest
    own.restore(running, running=True)
    row = vectors.rows[SAVED]
    assert own.step(float(row.r[0]), float(row.y[0])) == row.u[0]


# What is changed in the C file, each a kind that an error of a compiler or a hand may have.
MUTANTS = {
    "the check of an image is not compared": (r"\n *\|\| memory_get_long\(image, 296\) != memory_check\(image\)", ""),
    "the length is not compared": (r"length != \d+U", "false"),
    "NaN in an image is taken": (r"if \(!\(fabs\(memory_get_any\(image, k\)\) <= DBL_MAX\)\)", "if (false)"),
    "only the first numbers are looked at": (r"for \(int k = 0; k < 33; k\+\+\)", "for (int k = 0; k < 5; k++)"),
    "the design is not compared": (r"resume && \(memory_get_word", "false && (memory_get_word"),
    "what begins the image is not compared": (r"memory_get_word\(image, 0\) != 0x4d4c4c51U", "false"),
    "the layout is not compared": (r"memory_get_long\(image, 16\) != 0x\w+", "false"),
    "the count of a position is not compared": (r"memory_get_word\(image, 12\) != 0U", "false"),
    "what was learned needs the same design": (r"if \(resume && \(", "if (true && ("),
    "a flag is any number": (r"if \(!\(x >= low && x <= high\)", "if (!(x >= low && true)"),
    "a whole number is any number": (r" \|\| \(low < high && x != \(double\)memory_whole\(x\)\)", ""),
    "r and y are exchanged by load": (r"loop\.r = memory_get\(image, 10\);\n    state->loop\.y = memory_get\(image, 11\)",
                                      "loop.r = memory_get(image, 11);\n    state->loop.y = memory_get(image, 10)"),
    "r and y are exchanged by save": (r"image, 10, state->loop\.r\);\n    memory_put\(image, 11, state->loop\.y",
                                      "image, 10, state->loop.y);\n    memory_put(image, 11, state->loop.r"),
    "r and y are exchanged by both": (r"loop\.(r|y)( = memory_get\(image, |\);\n)", "BOTH"),
    "load keeps a running loop": (r"if \(!resume\) \{\n        reset_loop", "if (false) {\n        reset_loop"),
    "a reset keeps the loop": (r"(void servo_reset\(servo_state \*state\)\n\{\n)    reset_loop\(state\);", r"\1    (void)state;"),
    "a number is not loaded": (r"    state->loop\.u_limited = memory_get\(image, \d+\);\n", ""),
    "one number too few is loaded": (r"(memory_get_all\(image, 3, state->estimates, )3", r"\g<1>2"),
    "one number too few is saved": (r"(memory_put_all\(image, 3, state->estimates, )3", r"\g<1>2"),
    "the image is of big-endian words": (r"\(\(word >> 8\) & 0xffU\)", "((word >> 16) & 0xffU)"),
    "a controller begins otherwise": (r"(void servo_init\(.*?)\n\}", r"\1\n    state->loop.u = 1.0;\n}"),
    "there is no upper limit": (r"        applied = limits->high;\n", ""),
    "there is no limit of the rate": (r"most_change;", "most_change + 1e9;"),
    "u is not held in an interval": (r"limits->low\)", "limits->low - 1e9)"),
}  # fmt: skip


def changed(code: str, pattern: str, new: str) -> str:
    """Return the code with a mutant in it."""
    if new == "BOTH":
        for call in (
            "memory_put(image, {}, state->loop.{}",
            "state->loop.{1} = memory_get(image, {0}",
        ):
            r, y = call.format(10, "r"), call.format(11, "y")
            assert r in code
            assert y in code
            code = code.replace(r, call.format(11, "r") + " ").replace(y, call.format(10, "y"))
        return code
    return re.sub(pattern, new, code, flags=re.DOTALL)


@pytest.mark.trial
@needs_gcc
def test_the_self_test_notices_what_is_wrong_with_images_limits_and_resets(tmp_path: Path) -> None:
    """Each mutant fails; the exported code itself passes."""
    folder = tmp_path / "out"
    ql.export.c(servo(), folder, name="servo")
    code = (folder / "src/servo.c").read_text()
    program, unnoticed = tmp_path / "test", []
    for name, (pattern, new) in {"nothing": ("", ""), **MUTANTS}.items():
        text = changed(code, pattern, new)
        assert (text == code) == (name == "nothing"), name
        (folder / "src/servo.c").write_text(text)
        command = ["gcc", "-std=c99", "-w", "-O1", "-ffp-contract=off", f"-I{folder / 'src'}"]
        files = [folder / "test_servo.c", folder / "src/servo.c"]
        subprocess.run([*command, *files, "-lm", "-o", program], check=True)
        ended = subprocess.run([program], capture_output=True, check=False).returncode
        if (ended == 0) != (name == "nothing"):
            unnoticed.append(name)
    assert unnoticed == []
