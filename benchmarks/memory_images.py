"""Memory images: bits after save, kill and load; damaged images; time.

    python benchmarks/memory_images.py [--samples 10000] [--damaged 1e6]

*Bits.* A controller with a learner and a guard runs in a loop in this process. Its image is loaded
by another process and by exported C, and the image of that by Python again. Each continues for so
many samples; u is compared bit by bit, in double and in single precision.

*Damage.* So many images are damaged in ways drawn by chance: a bit, some bytes, a run of equal
bytes as of an erased page, a part moved, a part of an older image, a cut, other bytes altogether.
Exported C must refuse each of them, and the state must be the same afterwards. A hundredth of them
are given to Python, too. The script ends with 1 if a bit differs or a damaged image is taken.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from measured import check_present, options_of, parser_of, write
from rich.console import Console
from rich.table import Table

import quell as ql
from quell.controllers import in_single_precision
from quell.export import c_source

ROOT = Path(__file__).resolve().parent.parent
_CODE = r"""
#include <stdlib.h>
#include <stdint.h>
static uint64_t seed = 88172645463325252ULL;
static uint64_t bits(void)
{
    seed ^= seed << 13;
    seed ^= seed >> 7;
    seed ^= seed << 17;
    return seed;
}
/* Return how many damaged images were taken, or changed the state. */
long damaged(servo_state *state, const unsigned char *good, const unsigned char *older, long count)
{
    static unsigned char image[SERVO_MEMORY_SIZE], after[SERVO_MEMORY_SIZE];
    const size_t size = sizeof image;
    long wrong = 0;
    for (long k = 0; k < count; k++) {
        size_t length = size, at = bits() % size, part = 1 + bits() % (size - at);
        memcpy(image, good, size);
        switch (bits() % 8) {
        case 0: image[at] ^= (unsigned char)(1u << bits() % 8); break;
        case 1: for (int i = 0; i < 8; i++) image[bits() % size] = (unsigned char)bits(); break;
        case 2: memset(image + at, bits() & 1 ? 0xff : 0, part); break;
        case 3: for (size_t i = 0; i < part; i++) image[at + i] = (unsigned char)bits(); break;
        case 4: memcpy(image + at, older + at, part); break;
        case 5: length = bits() % size; break;
        case 6: memmove(image, image + at, size - at); break;
        default: for (size_t i = 0; i < size; i++) image[i] = (unsigned char)bits(); break;
        }
        if (length == size && memcmp(image, good, size) == 0)
            continue;
        if (length == size && memcmp(image, older, size) == 0)
            continue;
        if (servo_load(state, image, length, k & 1)) { wrong++; continue; }
        if (k % 1000 == 0) {
            servo_save(state, after);
            wrong += memcmp(after, good, size) != 0;
        }
    }
    return wrong;
}
"""


def controller(single: bool) -> Any:
    """Return the controller of the runs."""
    observer = ql.ESO.model_free(order=2, b0=1.5, omega_o=30.0, dt=0.01)
    law = ql.ADRC(
        observer, 4.0, learner=ql.learners.Kalman(), guard=ql.Guard(), u_min=-20.0, u_max=20.0
    )
    return in_single_precision(law) if single else law


def signals(samples: int, first: int) -> np.ndarray:
    """Return r and y of a loop, from a sample on."""
    k = np.arange(first, first + samples)
    noise = 1e-3 * np.random.default_rng(first).standard_normal(samples)
    y = 0.9 * np.sin(0.03 * k - 0.1) + 0.05 * np.sin(0.11 * k) + noise
    return np.column_stack([np.sin(0.03 * k), y])


def stepped(law: Any, samples: int, first: int) -> np.ndarray:
    """Return u of some samples."""
    return np.array([law.step(r, y) for r, y in signals(samples, first).tolist()])


def child(image: str, single: bool, samples: int, first: int, out: str) -> None:
    """Continue from an image in this process; write u and another image."""
    law = controller(single)
    law.restore(Path(image).read_bytes(), running=True)
    np.save(f"{out}.npy", stepped(law, samples, first))
    Path(out).write_bytes(law.memory())


def in_another_process(folder: Path, image: bytes, single: bool, samples: int, first: int) -> Any:
    """Return u and the image of another process that continues."""
    (folder / "image").write_bytes(image)
    arguments = json.dumps([str(folder / "image"), single, samples, first, str(folder / "next")])
    command = [sys.executable, __file__, "--child", arguments]
    subprocess.run(command, check=True, capture_output=True)
    return np.load(folder / "next.npy"), (folder / "next").read_bytes()


def bits(single: bool, samples: int, folder: Path) -> dict[str, Any]:
    """Return which u are the same after each step of Python → Python → C → Python."""
    law = controller(single)
    stepped(law, samples, 0)
    image = law.memory()
    in_c = compiled(single, folder)
    mine = stepped(law, samples, samples)
    other, later = in_another_process(folder, image, single, samples, samples)
    loaded = in_c.load(image)
    # Compiled kernels use FMA, the exported code does not: C is compared with kernels in Python.
    u_c = np.array([in_c.run("step", *row) for row in signals(samples, samples).tolist()])
    saved = in_c.save(len(image))
    plain = controller(single)
    plain.restore(image, running=True)
    with ql.kernels.dispatch.as_python():
        u_python = interpreted(plain, samples, samples)
        same_image = plain.memory() == saved
        plain.restore(saved, running=True)
        after = interpreted(plain, samples, 2 * samples)
    more = np.array([in_c.run("step", *row) for row in signals(samples, 2 * samples).tolist()])
    return {
        "image [B]": len(image),
        "Python to Python: other u": int(np.sum(mine != other)),
        "Python to Python: same image": later == law.memory(),
        "to C: loaded": loaded,
        "to C: other u": int(np.sum(u_c != u_python)),
        "to C: same image": same_image,
        "to Python: other u": int(np.sum(after != more)),
    }


def interpreted(law: Any, samples: int, first: int) -> np.ndarray:
    """Return u of kernels that run as Python."""
    from quell.controllers.base import control

    rows = signals(samples, first).tolist()
    with np.errstate(all="ignore"):
        return np.array([float(control(law.parameters, law._state, r, y)) for r, y in rows])


def compiled(single: bool, folder: Path) -> Any:
    """Return the exported controller, with the function ``damaged``."""
    sys.path.insert(0, str(ROOT))
    from tests.in_c import InC

    class Loaded(InC):
        def load(self, image: bytes, resume: bool = True) -> bool:
            function = self.library.servo_load
            function.restype = ctypes.c_bool
            return bool(function(self.state, image, ctypes.c_size_t(len(image)), resume))

        def save(self, size: int) -> bytes:
            image = ctypes.create_string_buffer(size)
            self.library.servo_save(self.state, image)
            return image.raw

    declared = "long damaged(servo_state *, const unsigned char *, const unsigned char *, long);\n"
    return Loaded(c_source(controller(single), "servo"), folder, declared + _CODE)


def damage(single: bool, count: int, folder: Path) -> dict[str, Any]:
    """Return what was found: images that were taken though they are damaged, in C and in Python."""
    law = controller(single)
    stepped(law, 300, 0)
    older = law.memory()
    stepped(law, 300, 300)
    image, in_c = law.memory(), compiled(single, folder)
    in_c.load(image)
    function = in_c.library.damaged
    function.restype = ctypes.c_long
    begin = time.monotonic()
    wrong = function(in_c.state, image, older, ctypes.c_long(count))
    seconds = time.monotonic() - begin
    random, taken = np.random.default_rng(1), 0
    for k in range(count // 100):
        damaged = bytearray(image)
        at = int(random.integers(len(image)))
        if k % 2:
            damaged[at] ^= 1 << int(random.integers(8))
        else:
            damaged[at : at + 16] = random.bytes(min(16, len(image) - at))
        try:
            law.restore(bytes(damaged), running=bool(k % 3))
            taken += bytes(damaged) != image
        except ValueError:
            pass
    unchanged = law.memory() == image
    return {
        "damaged, C": count,
        "taken or changed": wrong,
        "damaged, Python": count // 100,
        "taken, Python": taken,
        "unchanged": unchanged,
        "seconds": seconds,
    }


def main() -> None:
    """Print the tables; end with 1 if something is wrong."""
    parser = parser_of(__doc__)
    parser.add_argument("--samples", type=int, default=10_000)
    parser.add_argument("--damaged", type=float, default=1e6)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = options_of(parser, samples=200, damaged=2000.0)
    if options.child:
        child(*json.loads(options.child))
        return
    check_present(options, ["gcc"])
    heads = (
        "precision",
        "image [B]",
        "Python → Python: other u, image",
        "→ C: loaded, other u, image",
    )
    table = Table(*heads, "→ Python: other u", title=f"{options.samples} samples each")
    other = Table(
        "precision", "damaged, C", "taken or changed", "Python", "taken", "unchanged", "[s]"
    )
    right, figures = True, {}
    with tempfile.TemporaryDirectory() as place:
        for single in (False, True):
            name = "single" if single else "double"
            row = bits(single, options.samples, Path(place))
            hurt = damage(single, round(options.damaged), Path(place))
            size, *found = row.values()
            right = right and found == [0, True, True, 0, True, 0]
            right = right and hurt["taken or changed"] == hurt["taken, Python"] == 0
            right = right and hurt["unchanged"]
            cells = ["{}, {}".format(*found[:2]), "{}, {}, {}".format(*found[2:5]), f"{found[5]}"]
            table.add_row(name, f"{size}", *cells)
            other.add_row(name, *map(str, [*hurt.values()][:-1]), f"{hurt['seconds']:.1f}")
            figures[name] = row | hurt
    for each in (table, other):
        Console(width=140).print(each)
    write(options, figures)
    sys.exit(0 if right else 1)


if __name__ == "__main__":
    main()
