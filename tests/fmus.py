"""FMUs for tests: a mass or an arm in C (``fmu_plant.c``), compiled and packed for FMI 2.0 or 3.0."""

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

_NAMES = {
    "mass": ("time", "u", "w", "y", "v", "gain", "fail_at", "fail_with", "count"),
    "arm": (
        "time", "tau[1]", "tau[2]", "push[1]", "push[2]", "q[1]", "q[2]", "v[1]", "v[2]",
        "gain", "fail_at", "fail_with", "count",
    ),
}  # fmt: skip
_ROLES = {
    "time": "independent", "u": "input", "w": "input", "tau": "input", "push": "input",
    "y": "output", "q": "output", "v": "local", "count": "local",
}  # fmt: skip
_STARTS = {"gain": "1", "fail_at": "1e300", "fail_with": "3"}


def _role(name: str) -> str:
    return _ROLES.get(name.partition("[")[0], "parameter")


def _variables(version: int, model: str) -> str:
    """Return the elements of all variables."""
    text = ""
    for reference, name in enumerate(_NAMES[model]):
        whole = name in ("fail_with", "count")
        kind = {2: "Integer", 3: "Int32"}[version] if whole else {2: "Real", 3: "Float64"}[version]
        role = _role(name)
        start = "0" if role == "input" else _STARTS.get(name)
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


def description(version: int, model: str = "mass") -> str:
    """Return the model description."""
    outputs = [i for i, name in enumerate(_NAMES[model]) if _role(name) == "output"]
    if version == 2:
        unknowns = "".join(f'<Unknown index="{i + 1}"/>' for i in outputs)
        return (
            f'<fmiModelDescription fmiVersion="2.0" modelName="{model}" guid="{{mass}}">'
            f'<CoSimulation modelIdentifier="{model}" canHandleVariableCommunicationStepSize="true" '
            f'canGetAndSetFMUstate="true"/><ModelVariables>{_variables(2, model)}</ModelVariables>'
            f"<ModelStructure><Outputs>{unknowns}</Outputs></ModelStructure>"
            "</fmiModelDescription>"
        )
    unknowns = "".join(f'<Output valueReference="{i}"/>' for i in outputs)
    return (
        f'<fmiModelDescription fmiVersion="3.0" modelName="{model}" instantiationToken="{{mass}}">'
        f'<CoSimulation modelIdentifier="{model}" canHandleVariableCommunicationStepSize="true"/>'
        f"<ModelVariables>{_variables(3, model)}</ModelVariables>"
        f"<ModelStructure>{unknowns}</ModelStructure></fmiModelDescription>"
    )


@functools.cache
def binary(version: int, model: str = "mass") -> bytes:
    """Return the compiled library."""
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / f"{model}.so"
        command = ["gcc", "-shared", "-fPIC", "-O1", f"-DFMI={version}", f"-D{model.upper()}"]
        subprocess.run([*command, str(SOURCE), "-o", str(library), "-lm"], check=True)
        return library.read_bytes()


def place(version: int, model: str = "mass") -> str:
    """Return the name of the binary in the archive."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(
        platform.machine().lower(), platform.machine().lower()
    )
    return f"binaries/{'linux64' if version == 2 else machine + '-linux'}/{model}.so"


def contents(version: int, model: str = "mass") -> dict[str, bytes]:
    """Return the files of a good FMU: of a mass, or of an arm of two rods."""
    return {
        "modelDescription.xml": description(version, model).encode(),
        place(version, model): binary(version, model),
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

        self.description = fmpy.read_model_description(str(path))
        self.references = {v.name: v.valueReference for v in self.description.modelVariables}
        self.messages: list[str] = []
        self.fmu = self.kind()(
            guid=self.description.guid,
            unzipDirectory=fmpy.extract(str(path), str(folder)),
            modelIdentifier=self.description.coSimulation.modelIdentifier,
            instanceName="driven",
        )
        self.instantiate()

    def kind(self) -> Any:
        """Return the class of FMPy that calls such FMUs."""
        from fmpy.fmi3 import FMU3Slave

        return FMU3Slave

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


class DrivenOlder(Driven):
    """The same of an FMU of FMI 2.0."""

    def kind(self) -> Any:
        """Return the class of FMPy that calls such FMUs."""
        from fmpy.fmi2 import FMU2Slave

        return FMU2Slave

    def instantiate(self) -> None:
        """Make the instance, which has not begun its initialisation."""
        self.fmu.instantiate()
        self.time = 0.0

    def begin(self, **start: float) -> Driven:
        """Set start values and go through the initialisation."""
        self.set(start)
        self.fmu.setupExperiment(startTime=0.0)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        return self

    def set(self, values: Mapping[str, float]) -> None:
        """Set variables by name."""
        for name, value in values.items():
            write = self.fmu.setBoolean if name == "held" else self.fmu.setReal
            write([self.references[name]], [int(value) if name == "held" else value])

    def get(self, name: str) -> float:
        """Return a variable."""
        whole = name in ("status", "reason")
        read = self.fmu.getInteger if whole else self.fmu.getReal
        read = self.fmu.getBoolean if name == "held" else read
        return float(read([self.references[name]])[0])

    def free(self) -> None:
        """Free the instance."""
        self.fmu.fmi2FreeInstance(self.fmu.component)
