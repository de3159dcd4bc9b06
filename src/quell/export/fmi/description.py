"""``modelDescription.xml`` and ``buildDescription.xml`` of an FMU (FMI 3.0.1, 2.4 and 2.5)."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree

from quell.export.fmi.variables import (
    FIXED,
    INPUT,
    LOCAL,
    OUTPUT,
    TUNABLE,
    Variable,
    number,
)

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
    units = _add(root, "UnitDefinitions")
    for unit, powers in _UNITS.items():
        _add(_add(units, "Unit", name=unit), "BaseUnit", **powers)
    categories = _add(root, "LogCategories")
    _add(categories, "Category", name="error", description="reasons of fmi3Error")
    _add(root, "DefaultExperiment", startTime="0", stepSize=number(dt))
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


def build_description(name: str, files: Sequence[str]) -> bytes:
    """Return the description of the sources, C files in the folder of this file."""
    root = ElementTree.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = _add(root, "BuildConfiguration", modelIdentifier=name)
    sources = _add(configuration, "SourceFileSet", language="C99")
    for file in files:
        _add(sources, "SourceFile", name=file)
    _add(configuration, "Library", name="m", version="")
    return _text(root)


def _add_variable(parent: ElementTree.Element, reference: int, variable: Variable) -> None:
    attributes = {
        "name": variable.name,
        "valueReference": str(reference),
        "causality": _CAUSALITY.get(variable.role, variable.role),
    }
    if variable.role in _CAUSALITY:
        attributes["variability"] = variable.role
    elif variable.whole or variable.held:
        attributes["variability"] = "discrete"
    attributes["description"] = variable.description
    if variable.unit:
        attributes["unit"] = variable.unit
    if variable.role in (INPUT, *_CAUSALITY):
        attributes["start"] = number(variable.start)
    elif variable.role in (OUTPUT, LOCAL):
        attributes["initial"] = "calculated"
    _add(parent, "Int32" if variable.whole else "Float64", **attributes)


def _add(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(parent, tag, attributes)


def _text(root: ElementTree.Element) -> bytes:
    ElementTree.indent(root)
    text: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"
