"""FMUs for tests: a mass in C (``fmu_plant.c``), compiled and packed for FMI 2.0 or 3.0."""

from __future__ import annotations

import functools
import platform
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SOURCE = Path(__file__).parent / "fmu_plant.c"

_PARAMETERS = ("gain", "fail_at")
_NAMES = ("time", "u", "w", "y", "v", "gain", "fail_at", "fail_with", "count")


def _variables(version: int) -> str:
    """Return the elements of all variables."""
    causality = {"time": "independent", "u": "input", "w": "input", "y": "output", "v": "local"}
    text = ""
    for reference, name in enumerate(_NAMES):
        whole = name in ("fail_with", "count")
        kind = {2: "Integer", 3: "Int32"}[version] if whole else {2: "Real", 3: "Float64"}[version]
        role = causality.get(name, "local" if name == "count" else "parameter")
        start = {"gain": "1", "fail_at": "1e300", "fail_with": "3", "u": "0", "w": "0"}.get(name)
        value = f' start="{start}"' if start else ""
        vary = ' variability="fixed"' if role == "parameter" else ""
        vary = ' variability="discrete"' if name == "count" else vary
        head = f'name="{name}" valueReference="{reference}" causality="{role}"{vary}'
        text += (
            f"<ScalarVariable {head}><{kind}{value}/></ScalarVariable>"
            if version == 2
            else f"<{kind} {head}{value}/>"
        )
    return text


def description(version: int) -> str:
    """Return the model description."""
    if version == 2:
        return (
            '<fmiModelDescription fmiVersion="2.0" modelName="mass" guid="{mass}">'
            '<CoSimulation modelIdentifier="mass" canHandleVariableCommunicationStepSize="true" '
            f'canGetAndSetFMUstate="true"/><ModelVariables>{_variables(2)}</ModelVariables>'
            '<ModelStructure><Outputs><Unknown index="4"/></Outputs></ModelStructure>'
            "</fmiModelDescription>"
        )
    return (
        '<fmiModelDescription fmiVersion="3.0" modelName="mass" instantiationToken="{mass}">'
        '<CoSimulation modelIdentifier="mass" canHandleVariableCommunicationStepSize="true"/>'
        f"<ModelVariables>{_variables(3)}</ModelVariables>"
        '<ModelStructure><Output valueReference="3"/></ModelStructure></fmiModelDescription>'
    )


@functools.cache
def binary(version: int) -> bytes:
    """Return the compiled library."""
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "mass.so"
        command = ["gcc", "-shared", "-fPIC", "-O1", f"-DFMI={version}", str(SOURCE)]
        subprocess.run([*command, "-o", str(library), "-lm"], check=True)
        return library.read_bytes()


def place(version: int) -> str:
    """Return the name of the binary in the archive."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(
        platform.machine().lower(), platform.machine().lower()
    )
    return f"binaries/{'linux64' if version == 2 else machine + '-linux'}/mass.so"


def contents(version: int) -> dict[str, bytes]:
    """Return the files of a good FMU."""
    return {
        "modelDescription.xml": description(version).encode(),
        place(version): binary(version),
        "resources/table.txt": b"1 2 3\n",
        "sources/fmu_plant.c": SOURCE.read_bytes(),
    }


def packed(path: Path, files: dict[str, bytes]) -> Path:
    """Write an FMU of these files."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


class Driven:
    """An instance of an FMU of FMI 3.0 that FMPy calls, with its variables by name."""

    def __init__(self, path: Path, folder: Path) -> None:
        import fmpy
        from fmpy.fmi3 import FMU3Slave

        self.description = fmpy.read_model_description(str(path))
        self.references = {v.name: v.valueReference for v in self.description.modelVariables}
        self.messages: list[str] = []
        self.fmu = FMU3Slave(
            guid=self.description.guid,
            unzipDirectory=fmpy.extract(str(path), str(folder)),
            modelIdentifier=self.description.coSimulation.modelIdentifier,
            instanceName="driven",
        )
        self.instantiate()

    def instantiate(self) -> None:
        """Make the instance, which has not begun its initialisation."""

        def note(environment: Any, status: int, category: bytes, message: bytes) -> None:
            self.messages.append(message.decode())

        self.fmu.instantiate(logMessage=note)
        self.time = 0.0

    def begin(self, **start: float) -> Driven:
        """Set start values and go through the initialisation."""
        self.set(start)
        self.fmu.enterInitializationMode(startTime=0.0)
        self.fmu.exitInitializationMode()
        return self

    def set(self, values: Mapping[str, float]) -> None:
        """Set variables by name."""
        for name in [name for name in values if name == "held"]:
            self.fmu.setBoolean([self.references[name]], [bool(values[name])])
        values = {name: value for name, value in values.items() if name != "held"}
        self.fmu.setFloat64([self.references[name] for name in values], [*values.values()])

    def get(self, name: str) -> float:
        """Return a variable."""
        whole = name in ("status", "reason")
        read = self.fmu.getInt32 if whole else self.fmu.getFloat64
        read = self.fmu.getBoolean if name == "held" else read
        return float(read([self.references[name]])[0])

    def step(self, length: float, **inputs: float) -> float:
        """Set inputs, advance by a communication step [s], and return the first output."""
        self.advance(length, inputs)
        return self.get("u" if "u" not in inputs else "y")

    def advance(self, length: float, inputs: Mapping[str, float]) -> None:
        """Set inputs, and advance by a communication step [s]."""
        self.set(inputs)
        self.fmu.doStep(self.time, length)
        self.time += length

    def free(self) -> None:
        """Free the instance."""
        self.fmu.fmi3FreeInstance(self.fmu.component)
