"""``c``: a controller as a library in C, with test and description."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quell import checks
from quell.controllers.base import check_controller
from quell.controllers.single import SinglePrecision, in_single_precision
from quell.export.c_files import CSource
from quell.export.controller_source import c_source
from quell.export.library.comparison import Comparison, compared
from quell.export.library.texts import library_files
from quell.export.library.toolchain import (
    NoCompilerError,
    Sizes,
    function_sizes,
    measured_sizes,
)
from quell.export.library.vectors import golden_vectors
from quell.export.proof import Proof, proof_files, prove
from quell.export.translate.naming import checked_name
from quell.files import check_folder, write_folder
from quell.plants.base import Plant
from quell.simulation.scenario import Scenario

# Targets that CMake, or a program for which it writes, has of its own.
_CMAKE_TARGETS = """all all_build clean edit_cache help install list_install_components package
    package_source rebuild_cache run_tests test uninstall zero_check"""


@dataclass(frozen=True)
class Exported:
    """A controller that was exported to C."""

    folder: Path  #: the folder
    files: tuple[Path, ...]  #: all files in it
    source: CSource  #: texts of header and source
    comparison: Comparison | None  #: single to double precision, if they were compared
    proof: Proof | None = None  #: what was proved, if it was asked for

    def sizes(self) -> Sizes:
        """Return the bytes of code, state and stack, as gcc tells: for ARM if it can.

        Raises
        ------
        NoCompilerError
            if there is no gcc.
        """
        source = self.source
        return measured_sizes(source.name, source.header, source.source, source.precision)


def c(
    controller: Any,
    folder: str | os.PathLike[str],
    *,
    name: str = "controller",
    precision: str = "double",
    plant: Plant | None = None,
    scenario: Scenario | None = None,
    resolution: float | None = None,
    accept: bool = False,
    proof: bool = False,
    overwrite: bool = False,
) -> Exported:
    """Write a controller as a library in C99, translated from the kernels that simulate it.

    The folder is a project for CMake, and a library for Arduino and PlatformIO: ``src/NAME.h`` and
    ``src/NAME.c``, a test with golden vectors ``test_NAME.c``, and ``README.md``. Without
    contraction to FMA the code gives, in double precision, the bits of the interpreted kernels, and
    in single precision those of ``simulate(..., precision="single", interpret=True)``.

    Parameters
    ----------
    controller
        any controller that does not call Python; its parameters and its state before the first
        sample are written.
    folder
        where to write; must be new or empty.
    name
        begins the names of all files, types and functions.
    precision
        ``"double"`` or ``"single"``.
    plant, scenario
        for single precision: the loop in which it is compared with double.
    resolution
        of an encoder [y-unit per count]: adds ``NAME_step_counts``, which takes r and y as integers
        and computes with differences to the last count. For an ADRC without model of the position.
    accept
        write in single precision even if nothing is compared, or the difference is too large.
    proof
        also write the folder ``proof``, and prove with Frama-C, where it is installed, that no
        behaviour of the code is undefined and that u is always a number within its limits. It takes
        seconds for an observer of order 2, minutes with a learner; ``Exported.proof`` and
        ``proof/REPORT.md`` have the result.
    overwrite
        whether files of the same names in the folder may be replaced.

    Raises
    ------
    ValueError
        for a name that C, C++, their headers or CMake use; a folder with files; a controller with
        parts in Python (``TranslationError``); parameters out of the range of single precision;
        single precision that differs too much, or is not compared, without ``accept``; and a proof
        of a controller that calls functions in C. Nothing is written then.

    Examples
    --------
    >>> import tempfile
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=2, b0=1.0, omega_o=20.0, dt=1e-3)
    >>> controller = ql.ADRC(observer, omega_c=4.0, u_min=-1.0, u_max=1.0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     exported = c(controller, folder, name="servo")
    ...     [path.name for path in exported.files[:3]]
    ['servo.h', 'servo.c', 'test_servo.c']
    """
    check_controller(controller)
    if checked_name(name).lower() in _CMAKE_TARGETS.split():
        rule = "is a target of CMake itself, so CMakeLists.txt can't have it; choose another name"
        raise ValueError(f"name = {name!r}: {rule}")
    single = checks.one_of("precision", precision, ("double", "single")) == "single"
    check_folder(folder, checks.flag("overwrite", overwrite))
    checks.flag("accept", accept)
    checks.flag("proof", proof)
    single = single or isinstance(controller, SinglePrecision)
    shown = in_single_precision(controller) if single else controller
    source = c_source(shown, name, resolution=resolution)
    comparison = None
    if single and plant is not None and scenario is not None:
        comparison = compared(plant, controller, scenario)
    if single and not accept:
        _check_comparison(comparison, controller)
    proving = proof_files(shown, source) if proof else {}
    vectors = golden_vectors(shown, source.operations)
    files = write_folder(folder, library_files(shown, source, vectors) | proving, overwrite)
    done = prove(Path(folder), source, sizes=_function_table(source)) if proof else None
    return Exported(Path(folder), files, source, comparison, done)


def _function_table(source: CSource) -> str:
    """Return a table in Markdown of what each public function takes, or why there is none."""
    try:
        place, functions = function_sizes(
            source.name, source.header, source.source, source.precision, source.operations
        )
    except NoCompilerError as error:
        return f"NOT measured: {error}.\n"
    rows = "".join(
        f"| `{each.name}` | {'–' if each.stack is None else each.stack} | {each.instructions} |\n"
        for each in functions
    )
    return (
        f"For {place}. Stack is the most that the function and all it calls take, by the\n"
        "compiler's graph of calls; instructions are those of its code and of what it calls, each\n"
        "counted once. Functions of the C library are not counted, nor registers of interrupts.\n\n"
        f"| function | stack at most [bytes] | instructions in the code |\n|---|---|---|\n{rows}"
    )


def _check_comparison(comparison: Comparison | None, controller: Any) -> None:
    if comparison is None:
        raise ValueError(
            "precision = 'single': needs plant and scenario, to compare it with double precision; "
            "or accept=True (--accept)"
        )
    comparison.check(controller)
