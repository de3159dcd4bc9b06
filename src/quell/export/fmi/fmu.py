"""``fmu``: a controller, a plant or a loop as a co-simulation FMU of FMI 3.0 or 2.0.

``model.h`` and ``model.c``: what an FMU samples, between ``sources/fmi3.c`` and generated code.

A model is a controller, a plant, or both in a loop. It keeps the values of all variables in the
order of their value references. A sample of a loop does what ``simulate`` does::

    y = measure(x),   u = step(r, y + noise),   advance(x, u, w)
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import uuid
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

from quell import checks
from quell.checks import import_extra
from quell.controllers.base import check_controller
from quell.export import reserved
from quell.export.c_files import plant_source
from quell.export.controller_source import c_source
from quell.export.fmi.parts import (
    FIXED,
    INPUT,
    LOCAL,
    OUTPUT,
    TUNABLE,
    ControllerPart,
    PlantPart,
    Variable,
    constant_of,
    number,
    ordered,
    several,
    tuning_lines,
)
from quell.export.library.exported import FLAGS, NoCompilerError
from quell.export.translate.text import TranslationError, checked_name
from quell.files import check_regular, check_writable, whole_text, written_atomically
from quell.lazy import install
from quell.lti.models import is_linear_model
from quell.plants.base import check_plant, is_several
from quell.plants.linear import LinearPlant

# ---- The two versions ----

VERSIONS = ("3.0", "2.0")
"""Versions of FMI that ``fmu`` writes."""
# The C files that each FMU has; those of the first line are compiled, fmi3.c is a part of fmi2.c.
_SOURCES = {
    "3.0": (("fmi3.c", "fmi3_refused.c"), ("refuse.h",)),
    "2.0": (("fmi2.c",), ("fmi3.c", "refuse.h")),
}

# ---- modelDescription.xml and buildDescription.xml of an FMU (FMI 3.0.1, 2.4 and 2.5) ----

# Units by name, with their exponents of SI base units.
_UNITS = {"s": {"s": "1"}, "rad/s": {"rad": "1", "s": "-1"}}
_CAUSALITY = {FIXED: "parameter", TUNABLE: "parameter"}


def model_description(
    name: str, title: str, token: str, dt: float, variables: Sequence[Variable]
) -> bytes:
    """Return the description of a co-simulation FMU.

    Parameters
    ----------
    name
        identifier of the model, and of its binary.
    title
        what the model is, in words.
    token
        the ``instantiationToken``.
    dt
        sample time [s].
    variables
        all variables, in the order of their value references.
    """
    root = ElementTree.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=name,
        instantiationToken=token,
        description=title,
        generationTool="quell",
        variableNamingConvention="structured",
    )
    _add(
        root,
        "CoSimulation",
        modelIdentifier=name,
        canHandleVariableCommunicationStepSize="true",
        fixedInternalStepSize=number(dt),
        canGetAndSetFMUState="true",
        canSerializeFMUState="true",
    )
    _add_settings(root, "fmi3Error", dt)
    elements = _add(root, "ModelVariables")
    for reference, variable in enumerate(variables):
        _add_variable(elements, reference, variable)
    structure = _add(root, "ModelStructure")
    references = [str(i) for i, variable in enumerate(variables) if variable.role == OUTPUT]
    for output in references:
        # An output changes in fmi3DoStep only: it does not follow an input at once.
        _add(structure, "Output", valueReference=output, dependencies="")
    for output in references:
        _add(structure, "InitialUnknown", valueReference=output)
    return _text(root)


def older_description(
    name: str,
    title: str,
    token: str,
    dt: float,
    variables: Sequence[Variable],
    files: Sequence[str],
) -> bytes:
    """Return the description of a co-simulation FMU of FMI 2.0 (2.0.4, 2.2 and 4.3).

    Parameters are those of ``model_description``; ``files`` are the C files to compile.
    """
    root = ElementTree.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=name,
        guid=token,
        description=title,
        generationTool="quell",
        variableNamingConvention="structured",
    )
    slave = _add(
        root,
        "CoSimulation",
        modelIdentifier=name,
        canHandleVariableCommunicationStepSize="true",
        canGetAndSetFMUstate="true",
        canSerializeFMUstate="true",
    )
    sources = _add(slave, "SourceFiles")
    for file in files:
        _add(sources, "File", name=file)
    _add_settings(root, "fmi2Error", dt)
    elements = _add(root, "ModelVariables")
    for reference, variable in enumerate(variables):
        attributes, value = _attributes(reference, variable)
        kind = "Boolean" if variable.flag else "Integer" if variable.whole else "Real"
        _add(_add(elements, "ScalarVariable", **attributes), kind, **value)
    structure = _add(root, "ModelStructure")
    outputs, unknowns = _add(structure, "Outputs"), _add(structure, "InitialUnknowns")
    for place_, variable in enumerate(variables, start=1):
        if variable.role == OUTPUT:
            _add(outputs, "Unknown", index=str(place_), dependencies="")
            _add(unknowns, "Unknown", index=str(place_))
    return _text(root)


def _add_settings(root: ElementTree.Element, error: str, dt: float) -> None:
    """Add units, the category of messages, and the step, which both versions write alike."""
    units = _add(root, "UnitDefinitions")
    for unit, powers in _UNITS.items():
        _add(_add(units, "Unit", name=unit), "BaseUnit", **powers)
    categories = _add(root, "LogCategories")
    _add(categories, "Category", name="error", description=f"reasons of {error}")
    _add(root, "DefaultExperiment", startTime="0", stepSize=number(dt))


def build_description(name: str, files: Sequence[str]) -> bytes:
    """Return the description of the sources, C files in the folder of this file."""
    root = ElementTree.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = _add(root, "BuildConfiguration", modelIdentifier=name)
    sources = _add(configuration, "SourceFileSet", language="C99")
    for file in files:
        _add(sources, "SourceFile", name=file)
    _add(configuration, "Library", name="m", version="")
    return _text(root)


def _attributes(reference: int, variable: Variable) -> tuple[dict[str, str], dict[str, str]]:
    """Return the attributes of a variable, and those of its value: unit and start."""
    attributes = {
        "name": variable.name,
        "valueReference": str(reference),
        "causality": _CAUSALITY.get(variable.role, variable.role),
    }
    if variable.role in _CAUSALITY:
        attributes["variability"] = variable.role
    elif variable.whole or variable.held or variable.flag:
        attributes["variability"] = "discrete"
    attributes["description"] = variable.description
    value = {"unit": variable.unit} if variable.unit else {}
    if variable.role in (INPUT, *_CAUSALITY):
        start = str(bool(variable.start)).lower() if variable.flag else number(variable.start)
        value["start"] = start
    elif variable.role in (OUTPUT, LOCAL):
        attributes["initial"] = "calculated"
    return attributes, value


def _add_variable(parent: ElementTree.Element, reference: int, variable: Variable) -> None:
    attributes, value = _attributes(reference, variable)
    kind = "Boolean" if variable.flag else "Int32" if variable.whole else "Float64"
    _add(parent, kind, **attributes, **value)


def _add(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(parent, tag, attributes)


def _text(root: ElementTree.Element) -> bytes:
    ElementTree.indent(root)
    text: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


# ---- model.h and model.c ----

_ROLES = {INPUT: "MODEL_INPUT", FIXED: "MODEL_FIXED", TUNABLE: "MODEL_TUNABLE"}

_HEADER = """\
/* The model inside of the FMU: {title}. Generated by quell. */
#ifndef MODEL_H
#define MODEL_H

#include <stdbool.h>
#include <stdint.h>

{includes}

#define MODEL_TOKEN "{token}"
#define MODEL_SAMPLE_TIME {dt} /* [s] */
#define MODEL_REALS {reals} /* the first value references; the first of all is the time */
#define MODEL_INTEGERS {integers} /* those that follow */
#define MODEL_FLAGS {flags} /* the last ones: inputs that are true or false */

/* Places of the variables: their value references. */
enum {{
{places}
}};

/* What may be set, and when. */
typedef enum {{ MODEL_OUTPUT, MODEL_INPUT, MODEL_FIXED, MODEL_TUNABLE }} Role;

typedef struct {{
    double real[MODEL_REALS];
    int32_t integer[MODEL_INTEGERS + 1];
    bool flag[MODEL_FLAGS + 1];
{members}
}} model;

extern const Role model_roles[MODEL_REALS];

/* Set all variables to their start values. */
void model_reset(model *m);
/* Correct the addresses inside of a model that was copied. */
void model_moved(model *m);
/* Let parameters act; return what is wrong with them, or NULL. */
const char *model_tune(model *m);
/* Set the outputs before the first sample. */
void model_begin(model *m);
/* Take the sample at the time t [s]. */
void model_sample(model *m, double t);

#endif
"""

_SOURCE = """\
/* See model.h. Generated by quell. */
#include "model.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

const Role model_roles[MODEL_REALS] = {{
{roles}
}};
{helpers}
void model_reset(model *m)
{{
{reset}
}}

void model_moved(model *m)
{{
{moved}
}}

const char *model_tune(model *m)
{{
{tune}
}}

void model_begin(model *m)
{{
{begin}
}}

void model_sample(model *m, double t)
{{
{sample}
}}
"""


@dataclass(frozen=True)
class Model:
    """A controller, a plant, or both in a loop."""

    controller: ControllerPart | None
    plant: PlantPart | None
    dt: float
    title: str

    @property
    def variables(self) -> tuple[Variable, ...]:
        """All variables, in the order of their value references."""
        controller, plant, found = self.controller, self.plant, list[Variable]()
        found += controller.inputs if controller else [Variable("u", INPUT, "control signal")]
        if plant:
            found += several("w", plant.disturbances, INPUT, "disturbance {i}")
        if controller:
            noise = Variable("noise", INPUT, "what is added to y before the controller sees it")
            measured = [Variable(name, INPUT, "measurement") for name in controller.measurements]
            found += [noise] if plant else measured
            found += [
                Variable(name, OUTPUT, "control signal", held=True) for name in controller.controls
            ]
        if plant:
            found.append(Variable("y", OUTPUT, "output of the plant"))
        if controller:
            found += [*controller.outputs, *controller.tunables]
        if plant:
            found += several("x", plant.order, LOCAL, "state {i} of the plant")
            found += several("x0", plant.order, FIXED, "state {i} at the start", plant.x0)
        return ordered(found)

    def files(self, token: str) -> dict[str, str]:
        """Return the texts of ``model.h`` and ``model.c`` of the FMU with this token."""
        return {"model.h": self._header(token), "model.c": self._source()}

    def _header(self, token: str) -> str:
        variables = self.variables
        integers = sum(variable.whole for variable in variables)
        flags = sum(variable.flag for variable in variables)
        sources = [part.source for part in (self.controller, self.plant) if part]
        return _HEADER.format(
            title=self.title,
            includes="\n".join(f'#include "{source.name}.h"' for source in sources),
            token=token,
            dt=repr(self.dt),
            reals=len(variables) - integers - flags,
            integers=integers,
            flags=flags,
            places=_indented(f"{each.constant}," for each in variables),
            members=_indented(self._members()),
        )

    def _members(self) -> list[str]:
        lines = []
        if self.controller:
            name = self.controller.source.name
            lines += [
                f"{name}_parameters parameters[2]; /* those that act, and the next ones */",
                "int32_t acting;",
                f"{name}_state controller;",
            ]
        if self.plant:
            lines.append(f"{self.plant.source.name}_state plant;")
        return lines

    def _source(self) -> str:
        reals = [each for each in self.variables if not (each.whole or each.flag)]
        roles = (f"{_ROLES.get(v.role, 'MODEL_OUTPUT')}, /* {v.name} */" for v in reals)
        starts = [
            f"m->real[{v.constant}] = {_c_number(v.start)};" for v in reals if v.role in _ROLES
        ]
        reset, moved, tune = list[str](), ["(void)m;"], ["(void)m;", "return NULL;"]
        helpers, begin, outputs = "", list[str](), list[str]()
        if self.controller:
            name = self.controller.source.name
            helpers = _estimate_function(self.controller)
            moved = ["m->controller.parameters = &m->parameters[m->acting];"]
            reset += [
                f"{name}_init(&m->controller);",
                f"m->parameters[0] = {name}_default_parameters;",
                "m->parameters[1] = m->parameters[0];",
                "m->acting = 0;",
                "model_moved(m);",
            ]
            tune = tuning_lines(self.controller)
            outputs += ["set_estimate(m);"]
        if self.plant:
            name = self.plant.source.name
            moved.append(f"m->plant.parameters = &{name}_default_parameters;")
            reset.append(f"{name}_init(&m->plant);")
            order = self.plant.order
            begin = [f"m->plant.x[{i}] = m->real[AT_X0_{i + 1}];" for i in range(order)]
            outputs += _plant_outputs(self.plant)
        return _SOURCE.format(
            roles=_indented(roles),
            helpers=helpers,
            reset=_indented([*starts, *reset]),
            moved=_indented(moved),
            tune=_indented(tune),
            begin=_indented([*begin, *outputs]),
            sample=_indented([*self._sample_lines(), *outputs]),
        )

    def _sample_lines(self) -> list[str]:
        """Return the lines of a sample, without the outputs after it."""
        lines = [] if self.plant else ["(void)t;"]
        y = "m->real[AT_Y]"
        if self.plant and self.controller:
            lines.append(f"const double y = {self.plant.source.name}_measure(&m->plant);")
            y = "y + m->real[AT_NOISE]"
        if self.controller and self.controller.source.sizes is not None:
            return [*lines, *_several_lines(self.controller)]
        if self.controller:
            source = self.controller.source
            real, state = source.real, "&m->controller"
            cast = "" if real == "double" else f"({real})"
            y = f"{cast}({y})" if cast else y
            given = [state, f"{cast}m->real[AT_R]", y]
            for i in range(source.derivatives):
                given.append(f"{cast}m->real[AT_R_DERIVATIVE_{i + 1}]")
            for i in range(source.signals):
                given.append(f"{cast}m->real[AT_SIGNAL_{i + 1}]")
            if self.controller.can_be_held:
                at = "AT_HELD - MODEL_REALS - MODEL_INTEGERS"
                lines.append(f"{source.name}_set_held({state}, m->flag[{at}]);")
            lines.append(f"m->real[AT_U] = {source.name}_step({', '.join(given)});")
        if self.plant:
            w = ", &m->real[AT_W_1]" if self.plant.disturbances else ""
            name = self.plant.source.name
            lines.append(f"{name}_advance(&m->plant, t, m->real[AT_U]{w});")
        return lines


def _several_lines(controller: ControllerPart) -> list[str]:
    """Return the lines of a sample of a controller of several signals, which takes arrays."""
    source = controller.source
    real, cast = source.real, "" if source.real == "double" else f"({source.real})"

    def filled(array: str, names: Iterable[str]) -> str:
        values = (f"{cast}m->real[{constant_of(name)}]" if name else "0" for name in names)
        return f"const {real} {array}[] = {{{', '.join(values)}}};"

    lines = [filled("r", controller.references), filled("y", controller.measurements)]
    each = [controller.derivatives_of(i) for i in range(len(controller.derivatives))]
    for i in range(source.derivatives):
        lines.append(filled(f"r{i + 1}", (names[i] if i < len(names) else "" for names in each)))
    lines.append(f"{real} u[{len(controller.controls)}];")
    for i, name in enumerate(controller.held):
        at = f"{constant_of(name)} - MODEL_REALS - MODEL_INTEGERS"
        lines.append(f"{source.name}_set_held(&m->controller, {i}, m->flag[{at}]);")
    more = "".join(f", {each}" for each in source.further)
    lines.append(f"{source.name}_step(&m->controller, r, y{more}, u);")
    return [
        *lines,
        *(f"m->real[{constant_of(name)}] = u[{k}];" for k, name in enumerate(controller.controls)),
    ]


def _plant_outputs(plant: PlantPart) -> list[str]:
    lines = [f"m->real[AT_Y] = {plant.source.name}_measure(&m->plant);"]
    return [*lines, *(f"m->real[AT_X_{i + 1}] = m->plant.x[{i}];" for i in range(plant.order))]


def _estimate_function(controller: ControllerPart) -> str:
    """Return the C function that copies the estimate to the outputs."""
    name = controller.source.name
    lines = [f"const {name}_estimate estimate = {name}_get_estimate(&m->controller);"]
    has_status = "status" in dict(controller.source.channels)
    fields = (
        f"estimate.{re.sub(r'f_hat$', 'f', channel)}" + (f"[{i}]" if width > 1 else "")
        for channel, width in controller.channels
        for i in range(width)
    )
    for output, field in zip(controller.outputs, fields, strict=True):
        value = field
        if output.name == "status" and not has_status:
            value = f"{name}_status(&m->controller)"
        target = (
            f"integer[{output.constant} - MODEL_REALS]"
            if output.whole
            else f"real[{output.constant}]"
        )
        lines.append(f"m->{target} = {value};")
    body = _indented(lines)
    doc = "/* Copy what the controller knows to the outputs. */"
    return f"\n{doc}\nstatic void set_estimate(model *m)\n{{\n{body}\n}}\n"


def _indented(lines: Iterable[str]) -> str:
    return "\n".join(f"    {line}" if line else "" for line in lines)


def _c_number(value: float) -> str:
    text = number(value)
    return {"INF": "INFINITY", "-INF": "-INFINITY", "NaN": "NAN"}.get(text, text)


# ---- The binary of an FMU for this machine, from a C compiler ----

_COMPILERS = ("gcc", "clang", "cc")
_OPTIONS = (*FLAGS, "-fPIC", "-shared", "-fvisibility=hidden")
_SYSTEMS = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib")}
# Else a function that is missing would be noticed only by the tool that loads the FMU.
_COMPLETE = {"linux": ("-Wl,-z,defs",)}
_MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
# A model of the largest learners takes some seconds. Chosen by hand.
_LONGEST = 300.0


def place(name: str, version: str = "3.0") -> str:
    """Return the path of the binary of the model ``name`` in an FMU, for this machine.

    FMI 2.0 has names of folders for processors of Intel and AMD alone.
    """
    if sys.platform not in _SYSTEMS:
        raise ValueError(
            f"binary = True: is not supported on {sys.platform}; give binary=False and compile the "
            "sources of the FMU there (fmpy compile)"
        )
    system, suffix = _SYSTEMS[sys.platform]
    machine = platform.machine().lower()
    if version == "2.0":
        if _MACHINES.get(machine, machine) != "x86_64":
            raise ValueError(
                f"binary = True: FMI 2.0 has no folder for {machine}; give version='3.0', or "
                "binary=False and compile the sources"
            )
        return f"binaries/{system}64/{name}{suffix}"
    return f"binaries/{_MACHINES.get(machine, machine)}-{system}/{name}{suffix}"


def compiler() -> str:
    """Return the C compiler: that of the environment variable CC, or the first that is found.

    Raises
    ------
    NoCompilerError
        if there is none.
    """
    candidates = (os.environ["CC"],) if os.environ.get("CC") else _COMPILERS
    for candidate in candidates:
        if shutil.which(candidate):
            return candidate
    raise NoCompilerError(
        f"binary = True: no C compiler was found ({', '.join(candidates)}); install one, set CC, "
        "or give binary=False for an FMU of sources only"
    )


def compiled(folder: Path, files: Sequence[str], name: str) -> bytes:
    """Return the shared library of C files in ``folder``.

    Raises
    ------
    NoCompilerError
        without a compiler, and with its first message if it fails.
    """
    library = folder / f"{name}.library"
    last = (*_COMPLETE.get(sys.platform, ()), "-lm", "-o", library.name)
    command = [compiler(), *_OPTIONS, *files, *last]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=_LONGEST, check=False
    )
    if done.returncode != 0:
        lines, marks = done.stderr.splitlines(), ("undefined", "error")
        said = [line for mark in marks for line in lines if mark in line] or [done.stderr]
        raise NoCompilerError(f"binary = True: {command[0]} failed: {said[0].strip()[:300]}")
    return library.read_bytes()


# ---- fmu ----

# The same files give the same FMU: times in the archive are the first that ZIP knows.
_EPOCH = (1980, 1, 1, 0, 0, 0)


def fmu(
    part: Any,
    path: str | os.PathLike[str],
    *,
    name: str = "",
    dt: float | None = None,
    x0: ArrayLike | None = None,
    sources: Sequence[str | os.PathLike[str]] = (),
    binary: bool = True,
    version: str = "3.0",
    overwrite: bool = False,
) -> None:
    """Write an FMU of FMI 3.0 or 2.0 for co-simulation: C sources, a binary for this machine.

    The FMU samples at its own fixed time: in a communication step of any length it takes the
    samples from its beginning to before its end, with inputs as they are held; outputs are those
    after the last sample. A controller and a plant, called one after the other in each sample, give
    what ``simulate`` gives.

    Parameters
    ----------
    part
        a controller, a plant, or the two as ``(plant, controller)``, which become one loop. The
        kernels are translated to C, see ``quell.export.c_source``. ``quell.Axes`` and
        ``StateFeedback`` have a variable for each of their signals, and stand without a plant.
    path
        the file, ending in ``.fmu``.
    name
        of the model, its files and C names; the name of the file by default.
    dt
        sample time of a plant alone [s]; a controller has its own.
    x0
        initial state of the plant, zero by default; a parameter of the FMU.
    sources
        C files of yours that the parts call, of ``features.Custom(…, c_function=…)``.
    binary
        whether to compile a binary. Without one, other tools compile the sources.
    version
        of FMI: ``3.0``, or ``2.0`` for tools that do not read it. Both compute the same bits.
    overwrite
        whether an existing file may be replaced.

    Raises
    ------
    ValueError
        for a name that is no C name, parts that can't be translated to C (``TranslationError``
        names them), no compiler, and a file that exists.
    ImportError
        without FMPy, which brings the headers of FMI (extra ``fmi``).

    Notes
    -----
    Inputs are ``r`` with its derivatives, and ``y`` or, in a loop, ``noise``; for a plant ``u`` and
    ``w[i]``; ``signal[i]`` of a schedule; and ``held``, true or false, where the controller's
    ``set_held`` has an effect. Outputs are ``u``, ``y`` and the controller's estimates; ``status``
    and ``reason`` are integers. Parameters ``u_min``, ``u_max``, ``omega_c`` and ``omega_o`` can be
    changed at any time. A bandwidth is a parameter where it has a closed form: not for a controller
    that is no ``ADRC``, in single precision, omega_o not with a learner, a delay, half gain, the
    reduced or nonlinear form, and poles of another pattern.
    """
    target = Path(path)
    if target.suffix != ".fmu":
        raise ValueError(f"path = {str(target)!r}: must end in .fmu")
    name = checked_name(name or target.stem, "FMI")
    check_writable(target, checks.flag("overwrite", overwrite))
    checks.one_of("version", version, VERSIONS)
    fixed = headers(version)
    plant, controller = _parts(part)
    own = _own_sources(sources)
    model, files = _model(plant, controller, name, dt, x0)
    for each in own.keys() & files.keys():
        raise _two_files(each)
    if checks.flag("binary", binary):
        place(name, version)
    content = _content(model, fixed | files | own, name, binary, version)
    with (
        written_atomically(target, overwrite) as file,
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        for each, data in content.items():
            archive.writestr(zipfile.ZipInfo(each, _EPOCH), data, zipfile.ZIP_DEFLATED)


def _parts(part: Any) -> tuple[Any, Any]:
    """Return the plant and the controller, or None in place of one."""
    if isinstance(part, tuple) and len(part) == 2 and hasattr(part[1], "initial_state"):
        plant, controller = part
    elif hasattr(part, "initial_state"):
        plant, controller = None, part
    else:
        plant, controller = part, None
    if controller is not None:
        check_controller(controller, several=True)
    if hasattr(controller, "inputs") and plant is not None:
        what = f"{controller.outputs} axes" if controller.axes else "StateFeedback"
        raise TranslationError(
            f"{what}: an FMU with a plant is of one u and one y; write the FMU of the controller "
            "alone, and connect it to the plant in your simulator"
        )
    if plant is not None or controller is None:
        if not hasattr(plant, "sampled") and is_linear_model(plant):
            plant = LinearPlant.of(plant)
        check_plant(plant, "part")
        if is_several(plant):
            raise TranslationError(
                f"{type(plant).__name__}: an FMU with a plant is of one u and one y, and this one "
                f"has {plant.inputs} and {plant.outputs}; write the FMU of the controller alone"
            )
    return plant, controller


def _own_sources(sources: Sequence[str | os.PathLike[str]]) -> dict[str, str]:
    """Return the texts of the user's C files by name."""
    if not checks.is_sequence(sources) or not all(
        isinstance(each, str | os.PathLike) for each in sources
    ):
        raise ValueError(f"sources = {sources!r}: must be a sequence of files")
    found: dict[str, str] = {}
    for given in sources:
        path = Path(given)
        if path.suffix not in (".c", ".h") or path.stem in reserved.FMI:
            shown = os.fspath(given)  # Path("") would show "."
            raise ValueError(f"sources: {shown!r}: must be a file *.c or *.h, of another name")
        if path.name in found:
            raise _two_files(path.name)
        check_regular(path, f"sources: {path}")
        found[path.name] = whole_text(path)
    return found


def _two_files(name: str) -> ValueError:
    return ValueError(f"sources: {name}: there are two files of this name")


def _model(
    plant: Any, controller: Any, name: str, dt: float | None, x0: ArrayLike | None
) -> tuple[Model, dict[str, str]]:
    """Return the model, and the generated files of its parts."""
    files: dict[str, str] = {}
    controller_part = plant_part = None
    if controller is not None:
        if dt is not None and dt != controller.dt:
            raise ValueError(f"dt = {dt!r} s: must be the controller's, {controller.dt!r} s")
        dt = controller.dt
        own = c_source(controller, name)
        files |= {f"{name}.h": own.header, f"{name}.c": own.source}
        controller_part = ControllerPart.of(controller, own)
    if plant is None:
        if x0 is not None:
            raise ValueError("x0 is given: is the state of a plant, and there is none")
    else:
        dt = checks.positive("dt", dt, "s")
        start = np.zeros(plant.order) if x0 is None else checks.vector("x0", x0, plant.order)
        translated = plant_source(plant, dt, f"{name}_plant")
        files |= {
            f"{translated.name}.h": translated.header,
            f"{translated.name}.c": translated.source,
        }
        plant_part = PlantPart(translated, plant.order, plant.disturbances, start.tolist())
    what = [type(each).__name__ for each in (controller, plant) if each is not None]
    title = " with ".join(what) + (controller_part.fixed if controller_part else "")
    model = Model(controller_part, plant_part, float(dt or 0.0), title)
    places: dict[str, str] = {}
    for variable in model.variables:
        other = places.setdefault(variable.constant, variable.name)
        if other != variable.name:
            raise TranslationError(
                f"{other} and {variable.name}: these variables would have one name in C; give the "
                "axis another name"
            )
    return model, files


# The headers of the standard, which come from FMPy.
_HEADERS = {
    "3.0": ("fmi3FunctionTypes.h", "fmi3Functions.h", "fmi3PlatformTypes.h"),
    "2.0": ("fmi2FunctionTypes.h", "fmi2Functions.h", "fmi2TypesPlatform.h"),
}


def headers(version: str = "3.0") -> dict[str, str]:
    """Return the headers of FMI of the Modelica Association, as the installed FMPy has them.

    Raises
    ------
    ImportError
        without FMPy, naming the extra that installs it, and for an FMPy without these headers.
    """
    fmpy = import_extra("fmpy", "fmi", "an FMU, whose headers come from it,")
    folder = Path(fmpy.__file__).parent / "c-code"
    try:
        names = (*_HEADERS["3.0"], *(_HEADERS["2.0"] if version == "2.0" else ()))
        return {name: (folder / name).read_text(encoding="utf-8") for name in names}
    except OSError as error:
        raise ImportError(
            f"FMPy {fmpy.__version__} has no {Path(str(error.filename)).name}: {install('fmi')}"
        ) from None


def _content(
    model: Model, generated: Mapping[str, str], name: str, binary: bool, version: str
) -> dict[str, bytes]:
    """Return the files of the FMU."""
    folder = resources.files(__package__) / "sources"
    own, included = _SOURCES[version]
    fixed = {each: (folder / each).read_bytes() for each in (*own, *included)}
    token = _token(generated, model, fixed)
    sources = fixed | {
        each: text.encode() for each, text in (dict(generated) | model.files(token)).items()
    }
    units = sorted(each for each in sources if each.endswith(".c") and each not in included)
    about = name, model.title, token, model.dt, model.variables
    older = version == "2.0"
    description = older_description(*about, units) if older else model_description(*about)
    content = {"modelDescription.xml": description}
    if binary:
        with tempfile.TemporaryDirectory(prefix="quell-fmu-") as folder_name:
            for each, data in sources.items():
                (Path(folder_name) / each).write_bytes(data)
            content[place(name, version)] = compiled(Path(folder_name), units, name)
    if not older:
        content["sources/buildDescription.xml"] = build_description(name, units)
    return content | {f"sources/{each}": data for each, data in sorted(sources.items())}


def _token(generated: Mapping[str, str], model: Model, fixed: Mapping[str, bytes]) -> str:
    """Return the instantiation token: a UUID of all that the FMU is made of."""
    digest = hashlib.sha256()
    for each in (*generated.values(), *model.files("").values(), *map(repr, sorted(fixed.items()))):
        digest.update(each.encode())
    return f"{{{uuid.UUID(bytes=digest.digest()[:16])}}}"
