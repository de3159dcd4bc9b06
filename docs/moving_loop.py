"""Moving pictures of loops: quell's kernels as WebAssembly, and the directive ``moving``.

    python docs/moving_loop.py FOLDER

Each machine becomes a file ``moving-NAME.js`` with its WebAssembly, which clang and wasm-ld make of
the C code that quell exports: the plant, and the loop without learner, with one, and with learner
and guard. ``_moving/loop.c`` calls them in the order of a simulation, ``_moving/loop.js`` draws.
Nothing is calculated by a library of the browser, so y and u have the bits of ``quell.simulate``
(``tests/test_moving_loop.py``).

The sliders have 25 positions each. What a design of quell's is there stands in tables: for every
number of the C parameters that changes, its values over the slider that changes it, or over two.
So the parameters of every combination are those that quell writes, bit for bit.

A page embeds a machine with::

    ```{moving} two-mass
    :learner: on
    :load: 0.5
    ```

Without clang or wasm-ld the directive shows a figure and says what to install.
"""

from __future__ import annotations

import argparse
import base64
import itertools
import json
import math
import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from docutils import nodes
from docutils.parsers.rst import Directive, directives
from sphinx.application import Sphinx

import quell as ql
from quell.export import c_source, plant_source
from quell.plants.linear import sampled_plant

PARTS = Path(__file__).parent / "_moving"
STRUCTURES = ("plain", "learner", "guarded")
SLIDERS = ("b0", "omega_c", "omega_o")
POSITIONS = 25
WIDEST = 2.5  # largest and inverse of the least factor of a slider
# Drawn combinations of all sliders at which the tables are compared with quell's parameters.
_CHECKED = 20
ROOM = 4096  # samples of one call of run() in loop.c


# ---- The machines ----


@dataclass(frozen=True)
class Machine:
    """A plant, its loop, and how the page shows it."""

    name: str
    plant: Any
    linear: Any  # the plant without what is not linear: for the margins
    order: int  # of the observer
    dt: float
    b0: float
    omega_c: float
    omega_o: float
    u_max: float
    shown: dict[str, Any] = field(repr=False)  # what only the page needs

    def values(self, slider: str) -> list[float]:
        """Return the values of a slider, with three digits; the design's own is in the middle."""
        middle = getattr(self, slider)
        factors = WIDEST ** np.linspace(-1.0, 1.0, POSITIONS)
        return [float(f"{middle * factor:.3g}") for factor in factors]

    def controller(self, structure: str, b0: float, omega_c: float, omega_o: float) -> ql.ADRC:
        """Return the loop's controller in a structure."""
        observer = ql.ESO.model_free(order=self.order, b0=b0, omega_o=omega_o, dt=self.dt)
        learner = None if structure == "plain" else ql.learners.Kalman()
        guard = ql.Guard() if structure == "guarded" else None
        limits = {"u_min": -self.u_max, "u_max": self.u_max}
        return ql.ADRC(observer, omega_c=omega_c, learner=learner, guard=guard, **limits)

    @cached_property
    def true_f(self) -> dict[str, Any]:
        """Return what f is: ``f = y^(n) − b0 u`` as a row of x, u, and w with its derivatives.

        A plant that is not linear has the mean over a sample of the change of its speed instead.
        """
        if self.plant is not self.linear:
            return {}
        A, B, C, E = self.linear.A, self.linear.B.ravel(), self.linear.C.ravel(), self.linear.E
        rows = [C @ np.linalg.matrix_power(A, i) for i in range(self.order + 1)]
        from_w = [(rows[self.order - 1 - j] @ E).tolist() for j in range(3)]
        return {"x": rows[-1].tolist(), "u": float(rows[-2] @ B), "w": from_w}


def two_mass() -> Machine:
    """Return two masses and a spring; y is the position of the second one."""
    plant = ql.plants.two_mass_spring(m1=1.0, m2=1.0, k=1.0)
    shown = {
        "pace": 2.5, "window": 30.0, "pull": 0.5, "most": 0.8, "hand": 5.0,
        "load": {"input": 1, "omega": 0.8, "largest": 1.5},
        "step": {"height": 1.0, "every": 20.0}, "y": [-0.4, 1.4], "unit": "m",
    }  # fmt: skip
    return Machine("two-mass", plant, plant, 4, 5e-3, 1.0, 1.0, 10.0, 10.0, shown)


def servo() -> Machine:
    """Return a motor with dry friction and cogging; y is its angle."""
    angle = math.tau * np.arange(96) / 96
    motor = ql.plants.dc_motor(
        coulomb=0.004, cogging_map=0.01 * np.sin(7.0 * angle), counts=None, voltage_limit=24.0
    )
    shown = {
        "pace": 0.4, "window": 5.0, "pull": 0.12, "most": 0.12, "hand": 40.0,
        "load": {"input": 0, "omega": 9.0, "largest": 0.06},
        "step": {"height": 1.5, "every": 3.0}, "y": [-0.5, 2.0], "unit": "rad",
    }  # fmt: skip
    return Machine("servo", motor, motor.linear, 2, 1e-3, 500.0, 20.0, 100.0, 24.0, shown)


MACHINES = {"two-mass": two_mass, "servo": servo}


# ---- The layout of C parameters in memory ----

_STRUCT = re.compile(r"typedef struct \{\n(.*?)\n\} (\w+);", re.DOTALL)
_MEMBER = re.compile(r"(\w+) (\w+)((?:\[\d+\])*)$")
# Size, which is the alignment, and the letter of the type for the page.
_SIZES = {"double": (8, "d"), "int": (4, "i"), "bool": (1, "b")}


@dataclass(frozen=True)
class Entry:
    """A number of the parameters: where it stands in C, and in Python."""

    offset: int
    letter: str
    path: tuple[str, ...]
    index: tuple[int, ...]

    def value(self, parameters: Any) -> float:
        """Return it from the parameters of a controller."""
        for name in self.path:
            parameters = getattr(parameters, name)
        return float(np.asarray(parameters)[self.index])


def layout(header: str, struct: str) -> tuple[list[Entry], int]:
    """Return the numbers of a struct of a header, and its size, for a processor of 32 bits."""
    text = re.sub(r"/\*.*?\*/", "", header, flags=re.DOTALL)
    structs = {name: body for body, name in _STRUCT.findall(text)}

    def place(name: str, at: int, path: tuple[str, ...]) -> tuple[list[Entry], int, int]:
        entries, start, widest = [], at, 1
        for member in filter(None, map(str.strip, structs[name].split(";"))):
            found = _MEMBER.fullmatch(member)
            if found is None:
                raise ValueError(f"{name}: {member!r} is no member of parameters")
            kind, called, sizes = found.groups()
            if kind in _SIZES:
                align, letter = _SIZES[kind]
                at += -at % align
                shape = [int(size) for size in re.findall(r"\d+", sizes)]
                for index in itertools.product(*map(range, shape)):
                    entries.append(Entry(at, letter, (*path, called), index))
                    at += align
            else:
                align = place(kind, 0, ())[2]
                inner, at, _ = place(kind, at + -at % align, (*path, called))
                entries += inner
            widest = max(widest, align)
        return entries, at + -(at - start) % widest, widest

    entries, size, _ = place(struct, 0, ())
    return entries, size


# ---- Tables of designs ----


@dataclass
class Table:
    """Values over one slider or two, of the numbers of the parameters that change with them."""

    sliders: tuple[str, ...]
    values: list[float]
    places: dict[str, list[tuple[int, str]]]  # offset and type in the parameters of a structure


def tables(machine: Machine, entries: dict[str, list[Entry]]) -> list[Table]:
    """Return the tables of a machine; numbers that are equal everywhere share one."""
    middle = {slider: getattr(machine, slider) for slider in SLIDERS}
    values = {slider: machine.values(slider) for slider in SLIDERS}
    made: dict[tuple[str, tuple[float, ...]], Any] = {}

    def parameters(structure: str, **changed: float) -> Any:
        key = (structure, tuple((middle | changed).values()))
        if key not in made:
            made[key] = machine.controller(structure, **(middle | changed)).parameters
        return made[key]

    found: dict[tuple[tuple[str, ...], tuple[float, ...]], Table] = {}
    for structure, numbers in entries.items():
        for entry in numbers:
            usual = entry.value(parameters(structure))
            sliders = tuple(
                slider
                for slider in SLIDERS
                if any(
                    entry.value(parameters(structure, **{slider: value})) != usual
                    for value in (values[slider][0], values[slider][-1])
                )
            )
            if not sliders:
                continue
            column = tuple(
                entry.value(parameters(structure, **dict(zip(sliders, each, strict=True))))
                for each in itertools.product(*(values[slider] for slider in sliders))
            )
            table = found.setdefault((sliders, column), Table(sliders, list(column), {}))
            table.places.setdefault(structure, []).append((entry.offset, entry.letter))
    return list(found.values())


def check_tables(machine: Machine, entries: dict[str, list[Entry]], found: list[Table]) -> None:
    """Raise an ``AssertionError`` if a drawn combination of sliders has other parameters."""
    rng = np.random.default_rng(1)
    values = {slider: machine.values(slider) for slider in SLIDERS}
    for _ in range(_CHECKED):
        at = {slider: int(rng.integers(POSITIONS)) for slider in SLIDERS}
        chosen = {slider: values[slider][at[slider]] for slider in SLIDERS}
        for structure, numbers in entries.items():
            parameters = machine.controller(structure, **chosen).parameters
            usual = {slider: getattr(machine, slider) for slider in SLIDERS}
            before = machine.controller(structure, **usual).parameters
            written = {entry.offset: entry.value(before) for entry in numbers}
            for table in found:
                place = 0
                for slider in table.sliders:
                    place = place * POSITIONS + at[slider]
                for offset, _ in table.places.get(structure, ()):
                    written[offset] = table.values[place]
            for entry in numbers:
                assert written[entry.offset] == entry.value(parameters), (structure, entry, chosen)


# ---- C code and WebAssembly ----

# The headers of C that the exported files include, for a target without a library. clang replaces
# these functions by instructions, pow(x, 2) by a product.
_HEADERS = {
    "math.h": """#define INFINITY __builtin_inff()
#define fabs __builtin_fabs
#define sqrt __builtin_sqrt
#define floor __builtin_floor
#define copysign __builtin_copysign
double pow(double x, double y);
double exp(double x);
""",
    "string.h": """#include <stddef.h>
void *memset(void *to, int value, size_t size);
void *memcpy(void *to, const void *from, size_t size);
""",
}
# The plant's friction is C + (S − C) exp(…). Without stiction S = C, and exp has no effect.
_NO_EXP = "double exp(double x);\ndouble exp(double x)\n{\n    return x > 0.0 ? 1.0 : 0.0;\n}\n"
_FUNCTIONS = ("begin", "next_design", "start", "retune", "change_structure", "run")
_LOGS = ("r", "w", "y", "u", "x", "f_hat", "f_learned", "authority")
_FLAGS = (
    *("--target=wasm32", "-std=c99", "-Os", "-mbulk-memory", "-ffp-contract=off"),
    *("-fno-math-errno", "-nostdlib", "-Wall", "-Wextra", "-Werror"),
    *("-Wl,--no-entry", "-Wl,--gc-sections", "-Wl,--strip-all", "-Wl,-z,stack-size=16384"),
    *(f"-Wl,--export={name}" for name in _FUNCTIONS),
    *(f"-Wl,--export=log_{name}" for name in _LOGS),
)


def _program(name: str) -> str | None:
    """Return the path of a program, whose name may end with a version as in Debian."""
    versions = ("", *(f"-{version}" for version in range(30, 10, -1)))
    return next((found for each in versions if (found := shutil.which(name + each))), None)


def missing_tools() -> list[str]:
    """Return the Debian packages that are missing to compile WebAssembly."""
    wanted = {"clang": "clang", "wasm-ld": "lld"}
    return [package for program, package in wanted.items() if _program(program) is None]


def webassembly(machine: Machine, sources: dict[str, Any], checks: str, folder: Path) -> bytes:
    """Compile the C files of a machine, with what ``checks`` says of their layout."""
    motor = machine.plant
    if getattr(motor, "stiction", 0.0) != getattr(motor, "coulomb", 0.0):
        raise ValueError(f"{machine.name}: stiction needs exp, which has no bits of its own here")
    for name, source in sources.items():
        (folder / f"{name}.h").write_text(source.header, encoding="utf-8")
        (folder / f"{name}.c").write_text(source.source, encoding="utf-8")
    for name, text in _HEADERS.items():
        (folder / name).write_text(text, encoding="utf-8")
    lines = [f'#include "{name}.h"' for name in sources]
    lines += ["enum {", f"    ORDER = {machine.order},", f"    STATES = {motor.order},"]
    lines += [
        f"    LOADS = {motor.disturbances},",
        f"    ROOM = {ROOM}",
        "};",
        f"#define SAMPLE_TIME {machine.dt!r}",
    ]
    (folder / "machine.h").write_text("\n".join([*lines, checks, ""]), encoding="utf-8")
    (folder / "exp.c").write_text(_NO_EXP, encoding="utf-8")
    files = [*(folder / f"{name}.c" for name in (*sources, "exp")), PARTS / "loop.c"]
    result = folder / "loop.wasm"
    clang, linker = _program("clang") or "clang", _program("wasm-ld") or "wasm-ld"
    command = [clang, *_FLAGS, f"-fuse-ld={linker}", f"-I{folder}", *files, "-o", result]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{machine.name}: {done.stderr}")
    return result.read_bytes()


def data(machine: Machine) -> dict[str, Any]:
    """Return all that the page has of a machine."""
    sources = {"plant": plant_source(machine.plant, machine.dt, name="plant")}
    middle = (machine.b0, machine.omega_c, machine.omega_o)
    for structure in STRUCTURES:
        sources[structure] = c_source(machine.controller(structure, *middle), structure)
    entries, asserted = {}, []
    for structure in STRUCTURES:
        struct = f"{structure}_parameters"
        entries[structure], size = layout(sources[structure].header, struct)
        asserted.append(f'_Static_assert(sizeof({struct}) == {size}, "{struct}");')
        for each in entries[structure]:
            place = ".".join(each.path) + "".join(f"[{i}]" for i in each.index)
            asserted.append(
                f"_Static_assert(__builtin_offsetof({struct}, {place}) == {each.offset}, "
                f'"{place}");'
            )
    found = tables(machine, entries)
    check_tables(machine, entries, found)
    with tempfile.TemporaryDirectory() as folder:
        wasm = webassembly(machine, sources, "\n".join(asserted), Path(folder))
    plant = sampled_plant(machine.linear, machine.dt)
    names = ("transition", "input", "gain", "law", "cancel", "cancel_f", "b0")
    offsets = {
        each.path[-1]: each.offset for each in reversed(entries["plain"]) if each.path[-1] in names
    }
    return {
        "wasm": base64.b64encode(wasm).decode(),
        "tables": [
            {"sliders": [SLIDERS.index(each) for each in table.sliders],
             "places": [table.places.get(each, []) for each in STRUCTURES]}
            for table in found
        ],
        "values": base64.b64encode(
            np.array([value for table in found for value in table.values], dtype="<f8").tobytes()
        ).decode(),
        "positions": [machine.values(slider) for slider in SLIDERS],
        "order": machine.order, "states": machine.plant.order,
        "loads": machine.plant.disturbances, "dt": machine.dt, "room": ROOM,
        "sampled": {"N": plant.N.tolist(), "B": plant.B.tolist(), "C": plant.C.tolist()},
        "offsets": offsets, "f": machine.true_f, **machine.shown,
    }  # fmt: skip


def write(folder: Path) -> list[Path]:
    """Write the files of the pages, and return them."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, machine in MACHINES.items():
        text = json.dumps(data(machine()), separators=(",", ":"))
        paths.append(folder / f"moving-{name}.js")
        paths[-1].write_text(f'(window.movingMachines??={{}})["{name}"]={text};\n')
    for part, target in (("loop.js", "moving.js"), ("loop.css", "moving.css")):
        paths.append(folder / target)
        shutil.copyfile(PARTS / part, paths[-1])
    return paths


# ---- The directive ----


def _switch(text: str | None) -> str:
    return directives.choice(text, ("on", "off"))


class Moving(Directive):
    """A machine that moves; the options are the first settings of sliders and switches.

    ``b0``, ``omega-c`` and ``omega-o`` are factors of the machine's own values.
    """

    required_arguments = 1
    option_spec = {
        "b0": float,
        "omega-c": float,
        "omega-o": float,
        "load": float,
        "learner": _switch,
        "guard": _switch,
    }

    def run(self) -> list[nodes.Node]:
        """Return the block, or the figure that stands for it."""
        machine = directives.choice(self.arguments[0], tuple(MACHINES))
        missing = missing_tools()
        if missing:
            text = (
                "This build has no moving picture: it is compiled by clang and wasm-ld. "
                f"Install the Debian packages that are missing: {' '.join(missing)}."
            )
            picture = nodes.image(uri="/images/learning.png", alt="A loop that learns")
            return [nodes.figure("", picture, nodes.caption(text, text))]
        settings = "".join(f' data-{key}="{value}"' for key, value in self.options.items())
        block = f'<div class="moving-loop" data-machine="{machine}"{settings}></div>'
        needed = [f"moving-{machine}.js", "moving.js"]
        up = "../" * self.state.document.settings.env.docname.count("/")
        head = f'<link rel="stylesheet" href="{up}_static/moving.css">'
        scripts = "".join(f'<script src="{up}_static/{each}"></script>' for each in needed)
        without = "<noscript><p>This picture moves with JavaScript.</p></noscript>"
        return [nodes.raw("", f"{head}{block}{without}{scripts}", format="html")]


def setup(app: Sphinx) -> dict[str, Any]:
    """Add the directive, and the files that it needs to the static ones."""
    app.add_directive("moving", Moving)

    def prepare(app: Sphinx) -> None:
        if app.builder.format == "html" and not missing_tools():
            folder = Path(app.doctreedir) / "moving"
            write(folder)
            app.config.html_static_path.append(str(folder))

    app.connect("builder-inited", prepare)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write the files of the moving pictures.")
    parser.add_argument("folder", type=Path)
    for path in write(parser.parse_args().folder):
        print(f"{path}  {path.stat().st_size / 1000.0:.1f} kB")
