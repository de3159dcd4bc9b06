"""``fmu``: a controller, a plant or a loop as a co-simulation FMU of FMI 3.0."""

from __future__ import annotations

import hashlib
import os
import tempfile
import uuid
import zipfile
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quell import checks
from quell.controllers.base import check_controller
from quell.export.controller_source import c_source
from quell.export.fmi.binary import compiled, place
from quell.export.fmi.description import build_description, model_description
from quell.export.fmi.model import Model
from quell.export.fmi.parts import ControllerPart, PlantPart
from quell.export.plant_source import plant_source
from quell.export.translate.naming import checked_name
from quell.files import check_writable, written_atomically
from quell.lti.models import is_linear_model
from quell.plants.base import check_plant
from quell.plants.linear import LinearPlant
from quell.reading import check_regular, whole_text

# Files beside those that have the name of the model.
_OWN_NAMES = ("fmi3", "fmi3_refused", "model", "refuse")
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
    overwrite: bool = False,
) -> None:
    """Write an FMU of FMI 3.0 for co-simulation, with C sources and a binary for this machine.

    The FMU samples at its own fixed time: in a communication step of any length it takes the
    samples from its beginning to before its end, with inputs as they are held; outputs are those
    after the last sample. A controller and a plant, called one after the other in each sample, give
    what ``simulate`` gives.

    Parameters
    ----------
    part
        a controller, a plant, or the two as ``(plant, controller)``, which become one loop. The
        kernels are translated to C, see ``quell.export.c_source``.
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
    overwrite
        whether an existing file may be replaced.

    Raises
    ------
    ValueError
        for a name that is no C name, parts that can't be translated to C (``TranslationError``
        names them), no compiler, and a file that exists.

    Notes
    -----
    Inputs are ``r`` with its derivatives, and ``y`` or, in a loop, ``noise``; for a plant ``u`` and
    ``w[i]``. Outputs are ``u``, ``y`` and the controller's estimates; ``status`` and ``reason`` are
    integers. Parameters ``u_min``, ``u_max``, ``omega_c`` and ``omega_o`` can be changed at any
    time. A bandwidth is a parameter where it has a closed form: not for a controller that is no
    ``ADRC``, in single precision, omega_o not with a learner, a delay, half gain, the reduced or
    nonlinear form, and poles of another pattern.
    """
    target = Path(path)
    if target.suffix != ".fmu":
        raise ValueError(f"path = {str(target)!r}: must end in .fmu")
    name = checked_name(name or target.stem)
    if name in _OWN_NAMES:
        raise ValueError(f"name = {name!r}: is the name of a file that each FMU has; give another")
    check_writable(target, checks.flag("overwrite", overwrite))
    plant, controller = _parts(part)
    own = _own_sources(sources)
    model, files = _model(plant, controller, name, dt, x0)
    for each in own.keys() & files.keys():
        raise _two_files(each)
    if checks.flag("binary", binary):
        place(name)
    content = _content(model, files | own, name, binary)
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
        check_controller(controller)
    if plant is not None or controller is None:
        if not hasattr(plant, "sampled") and is_linear_model(plant):
            plant = LinearPlant.of(plant)
        check_plant(plant, "part")
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
        if path.suffix not in (".c", ".h") or path.stem in _OWN_NAMES:
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
    return Model(controller_part, plant_part, float(dt or 0.0), title), files


def _content(
    model: Model, generated: Mapping[str, str], name: str, binary: bool
) -> dict[str, bytes]:
    """Return the files of the FMU."""
    folder = resources.files(__package__) / "sources"
    fixed = {each.name: each.read_bytes() for each in folder.iterdir() if each.is_file()}
    token = _token(generated, model, fixed)
    sources = fixed | {
        each: text.encode() for each, text in (dict(generated) | model.files(token)).items()
    }
    units = sorted(each for each in sources if each.endswith(".c"))
    description = model_description(name, model.title, token, model.dt, model.variables)
    content = {"modelDescription.xml": description}
    if binary:
        with tempfile.TemporaryDirectory(prefix="quell-fmu-") as folder_name:
            for each, data in sources.items():
                (Path(folder_name) / each).write_bytes(data)
            content[place(name)] = compiled(Path(folder_name), units, name)
    content["sources/buildDescription.xml"] = build_description(name, units)
    return content | {f"sources/{each}": data for each, data in sorted(sources.items())}


def _token(generated: Mapping[str, str], model: Model, fixed: Mapping[str, bytes]) -> str:
    """Return the instantiation token: a UUID of all that the FMU is made of."""
    digest = hashlib.sha256()
    for each in (*generated.values(), *model.files("").values(), *map(repr, sorted(fixed.items()))):
        digest.update(each.encode())
    return f"{{{uuid.UUID(bytes=digest.digest()[:16])}}}"
