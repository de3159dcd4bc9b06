"""C code that writes a controller's state into a memory image, and reads it.

``controllers/memory.py`` describes the image. Both functions are written number by number from the
state in Python, whose order is that of the image: C has fewer numbers, because what never changes
is a constant there, and what no function uses does not exist. A constant stands in the image with
its value, and a number that C does not have with its initial one; an image in which a constant has
another value is refused. A number that is a truth value or an integer in C must be one in the
image.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from quell.controllers.memory import (
    CHECK,
    CHECK_BEGIN,
    CHECK_FACTOR,
    HEADER,
    MAGIC,
    VERSION,
    Layout,
    leaves,
)
from quell.export.translate.structs import Structs
from quell.export.translate.text import Array, Number, Struct, Value, wrapped

# Integers of a state are flags, places and counts; counts of kernels end at 2²³ or before. A larger
# one is refused, so that it can be added to.
_LARGEST_INTEGER = 2**24

_CODE = """
/* ---- The memory image: little-endian, see NAME_save ---- */

/* Called with constants: a copy for each call would be as large as the controller. */
#if defined(__GNUC__) && !defined(__clang__)
#define MEMORY_RARE __attribute__((noinline, noclone))
#elif defined(__GNUC__)
#define MEMORY_RARE __attribute__((noinline))
#else
#define MEMORY_RARE
#endif

static void memory_put_word(unsigned char *image, int at, uint32_t word)
{
    image[at] = (unsigned char)(word & 0xffU);
    image[at + 1] = (unsigned char)((word >> 8) & 0xffU);
    image[at + 2] = (unsigned char)((word >> 16) & 0xffU);
    image[at + 3] = (unsigned char)((word >> 24) & 0xffU);
}

static uint32_t memory_get_word(const unsigned char *image, int at)
{
    return (uint32_t)image[at] | ((uint32_t)image[at + 1] << 8)
        | ((uint32_t)image[at + 2] << 16) | ((uint32_t)image[at + 3] << 24);
}

static uint64_t memory_get_long(const unsigned char *image, int at)
{
    return memory_get_word(image, at) | ((uint64_t)memory_get_word(image, at + 4) << 32);
}

/* Write number k; what is not finite, which nobody reads again, as 0. */
static void memory_put(unsigned char *image, int k, REAL x)
{
    const REAL kept = FABS(x) <= REAL_MAX ? x : ZERO;
    BITS bits;

    (void)memcpy(&bits, &kept, sizeof bits);
PUT
}

/* Read number k, whatever it is. */
static REAL memory_get_any(const unsigned char *image, int k)
{
    const BITS bits = GET;
    REAL x;

    (void)memcpy(&x, &bits, sizeof x);
    return x;
}

/* Read number k; what is not finite, which memory_fits refuses, is 0. */
static REAL memory_get(const unsigned char *image, int k)
{
    const REAL x = memory_get_any(image, k);
    return x == x && x >= -REAL_MAX && x <= REAL_MAX ? x : ZERO;
}

/* Return the integer nearest to x towards zero; 0 for one that no state has. */
static int memory_whole(REAL x)
{
    return x > -BEYOND && x < BEYOND ? (int)x : 0;
}

/* Write the numbers from k on. */
static MEMORY_RARE void memory_put_all(unsigned char *image, int k, const REAL *x, int count)
{
    for (int i = 0; i < count; i++) {
        memory_put(image, k + i, x[i]);
    }
}

/* Read the numbers from k on. */
static MEMORY_RARE void memory_get_all(const unsigned char *image, int k, REAL *x, int count)
{
    for (int i = 0; i < count; i++) {
        x[i] = memory_get(image, k + i);
    }
}

/* Return the check of an image: FNV-1a with 64 bits over words of 32 bits. */
static MEMORY_RARE uint64_t memory_check(const unsigned char *image)
{
    uint64_t check = BEGINULL;

    for (int at = 0; at < CHECKED; at += 4) {
        check = (check ^ memory_get_word(image, at)) * FACTORULL;
    }
    return check;
}
RANGES
/* Return whether an image is whole and of this controller. */
static MEMORY_RARE bool memory_fits(const unsigned char *image, size_t length, bool resume)
{
    if (length != SIZEU || memory_get_word(image, 0) != MAGICU
        || memory_get_word(image, 4) != KINDU || memory_get_word(image, 8) != SIZEU
        || memory_get_long(image, 16) != LAYOUTULL
        || memory_get_long(image, CHECKED) != memory_check(image)) {
        return false;
    }
    if (resume && (ORIGINmemory_get_long(image, 24) != DESIGNULL)) {
        return false;
    }
    for (int k = 0; k < NUMBERS; k++) {
        if (!(FABS(memory_get_any(image, k)) <= REAL_MAX)) {
            return false;
        }
    }
TESTreturn true;
}
"""

_RANGES = """
/* Numbers that are whole here (low < high), or constant. */
static const struct { int place; REAL low; REAL high; } memory_ranges[COUNT] = {
    ROWS
};
"""

_TEST = """    for (int i = 0; i < COUNT; i++) {
        const REAL x = memory_get(image, memory_ranges[i].place);
        const REAL low = memory_ranges[i].low, high = memory_ranges[i].high;

        if (!(x >= low && x <= high) || (low < high && x != (REAL)memory_whole(x))) {
            return false;
        }
    }
    """


# What a state without integers, or without arrays, has no use for.
_WHOLE = _CODE[_CODE.index("/* Return the integer") : _CODE.index("/* Write the numbers")]
_ARRAYS = _CODE[_CODE.index("/* Write the numbers") : _CODE.index("/* Return the check")]


class _Part(NamedTuple):
    """Numbers of the image that follow each other, and what they are in C."""

    values: Any  # initial values (n,)
    value: Value | None  # in C; None if it has none


class ImageCode:
    """The code for a state: call it when it is known which members the structs keep.

    Parameters
    ----------
    known
        the layout of the images, with the state in Python.
    state
        the state in Python.
    structs, memory
        of the program, and its state.
    has_origin
        whether the state has ``origin``.
    """

    def __init__(
        self, known: Layout, state: Any, structs: Structs, memory: Value, has_origin: bool
    ) -> None:
        self.known, self.structs, self.has_origin = known, structs, has_origin
        self.write = structs.literals.write_real
        self.save: list[str] = []
        self.load: list[str] = []
        self._ranges: list[tuple[int, Any, Any]] = []
        at = 0
        for part in _parts(structs, memory, state, known):
            self._add(at, part)
            at += part.values.size
        if at != known.numbers:
            raise AssertionError

    def _add(self, at: int, part: _Part) -> None:
        """Add the lines for the numbers from ``at`` on."""
        value, size = part.value, part.values.size
        if at in self.known.zeros and value is not None:
            value = Value(value.kind, value.code, constant=0.0)
            self.load.append(f"    {value.code} = {'false' if value.kind is Number.BOOL else 0};")
        if value is not None and isinstance(value.kind, Array):
            if value.kind.element is not Number.REAL:
                raise AssertionError
            first = value.code + "[0]" * (len(value.kind.shape) - 1)
            self.save.append(f"    memory_put_all(image, {at}, {first}, {size});")
            self.load.append(f"    memory_get_all(image, {at}, {first}, {size});")
        elif value is None or value.is_constant:
            for i, number in enumerate(part.values.tolist()):
                self.save.append(f"    memory_put(image, {at + i}, {self.write(number)});")
                if value is not None:
                    self._ranges.append((at + i, number, number))
        elif value.kind is Number.REAL:
            self.save.append(f"    memory_put(image, {at}, {value.code});")
            self.load.append(f"    {value.code} = memory_get(image, {at});")
        else:
            real, zero = self.structs.literals.real, self.write(0.0)
            found, low, high = (
                f"memory_whole(memory_get(image, {at}))",
                -_LARGEST_INTEGER,
                _LARGEST_INTEGER,
            )
            shown = f"({real}){value.code}"
            if value.kind is Number.BOOL:
                found, low, high = f"memory_get(image, {at}) != {zero}", 0, 1
                shown = f"{value.code} ? {self.write(1.0)} : {zero}"
            self.save.append(f"    memory_put(image, {at}, {shown});")
            self.load.append(f"    {value.code} = {found};")
            self._ranges.append((at, float(low), float(high)))

    def save_lines(self) -> list[str]:
        """Return the statements of ``NAME_save``."""
        known, kind = self.known, self.known.width << 16 | VERSION
        words = {0: int.from_bytes(MAGIC, "little"), 4: kind, 8: known.size}
        words |= {
            at + 4 * i: number >> 32 * i & 0xFFFFFFFF
            for at, number in ((16, known.layout), (24, known.design))
            for i in (0, 1)
        }
        origin = "(uint32_t)state->origin" if self.has_origin else "0U"
        end = known.size - CHECK.size
        return [
            *(f"    memory_put_word(image, {at}, {word:#x}U);" for at, word in words.items()),
            f"    memory_put_word(image, 12, {origin});",
            *self._short(self.save),
            "    check = memory_check(image);",
            f"    memory_put_word(image, {end}, (uint32_t)(check & 0xffffffffU));",
            f"    memory_put_word(image, {end + 4}, (uint32_t)(check >> 32));",
        ]

    def load_lines(self) -> list[str]:
        """Return the statements of ``NAME_load`` that read an image which fits."""
        origin = ["    state->origin = (int32_t)memory_get_word(image, 12);"]
        return [*(origin if self.has_origin else []), *self._short(self.load)]

    def _short(self, lines: list[str]) -> list[str]:
        return [line for each in lines for line in wrapped(each)]

    def functions(self) -> list[str]:
        """Return the functions behind both."""
        known, single = self.known, self.known.width == 4
        literals, count = self.structs.literals, len(self._ranges)
        rows = ", ".join(
            f"{{{place}, {self.write(low)}, {self.write(high)}}}"
            for place, low, high in self._ranges
        )
        ranges, test = "", "    "
        if count:
            ranges = _RANGES.replace("ROWS", "\n    ".join(wrapped(rows))).replace(
                "COUNT", str(count)
            )
            test = _TEST.replace("COUNT", str(count))
        put = "    memory_put_word(image, 32 + 4 * k, bits);"
        get = "memory_get_word(image, 32 + 4 * k)"
        if not single:
            put = (
                "    memory_put_word(image, 32 + 8 * k, (uint32_t)(bits & 0xffffffffU));\n"
                "    memory_put_word(image, 36 + 8 * k, (uint32_t)(bits >> 32));"
            )
            get = "memory_get_long(image, 32 + 8 * k)"
        origin = "" if self.has_origin else "memory_get_word(image, 12) != 0U || "
        text = _CODE
        if not count:
            text = text.replace(_WHOLE, "")
        if not any("memory_put_all(" in line for line in self.save):
            text = text.replace(_ARRAYS, "")
        for word, code in {
            "RANGES\n": ranges, "TEST": test, "PUT": put, "GET": get, "ORIGIN": origin,
            "ZERO": self.write(0.0), "BEYOND": self.write(_LARGEST_INTEGER + 2),
            "REAL_MAX": "FLT_MAX" if single else "DBL_MAX", "FABS": literals.math_function("fabs"),
            "BITS": "uint32_t" if single else "uint64_t", "REAL": literals.real,
            "CHECKED": str(known.size - CHECK.size), "SIZE": str(known.size),
            "NUMBERS": str(known.numbers), "MAGIC": f"{int.from_bytes(MAGIC, 'little'):#x}",
            "KIND": f"{known.width << 16 | VERSION:#x}", "BEGIN": str(CHECK_BEGIN),
            "FACTOR": str(CHECK_FACTOR), "LAYOUT": f"{known.layout:#x}",
            "DESIGN": f"{known.design:#x}", "NAME": self.structs.prefix,
        }.items():  # fmt: skip
            text = text.replace(word, code)
        if HEADER.size != 32:
            raise AssertionError
        return text.rstrip("\n").split("\n")


def _parts(structs: Structs, memory: Value, state: Any, known: Layout) -> Iterator[_Part]:
    """Yield the numbers of a state in the order of the image."""
    for leaf in leaves(state):
        if leaf.name not in known.arrays:
            continue
        value: Value | None = memory
        for step in leaf.path:
            value = _member(structs, value, step)
        if leaf.array.dtype.names is None:
            yield _Part(np.ravel(leaf.array), value)
        else:
            for each in leaf.array.dtype.names:
                yield _Part(np.ravel(leaf.array[each]), _member(structs, value, each))


def _member(structs: Structs, owner: Value | None, name: str | int) -> Value | None:
    """Return a member of a struct in C; None if C has no memory for it."""
    if owner is None or not isinstance(owner.kind, Struct):
        return None
    if isinstance(name, int):
        return structs.entry(owner, name)
    layout = structs.layouts[owner.kind.name]
    value = structs.field(owner, name)
    if value is None or name in layout.scratch or name in layout.absent:
        return None
    if name not in layout.members and not value.is_constant:
        return None
    return value
