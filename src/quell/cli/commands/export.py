"""``quell export``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from quell.cli.exit_codes import ExitCode
from quell.cli.options import Overwrite, Switch, Trust, refuse
from quell.cli.output import Console, print_line

if TYPE_CHECKING:
    from quell.export import Comparison, Exported
    from quell.setup import Setup


def export(
    setup: Path,
    *,
    to: Literal["c", "fmu"] = "c",
    out: Path,
    name: str | None = None,
    precision: Literal["double", "single"] = "double",
    what: Literal["controller", "plant", "loop"] = "controller",
    resolution: float | None = None,
    accept: Switch = False,
    prove: Switch = False,
    trust: Trust = False,
    overwrite: Overwrite = False,
) -> None:
    """Write the controller of a setup for another machine: as C files, or as an FMU.

    The C files (C99) are a library for CMake, Arduino and PlatformIO with golden vectors and a
    README. In single precision the scenario of the setup is simulated in both precisions before,
    and nothing is written if they differ too much.

    Parameters
    ----------
    setup
        The file, in TOML; docs/setup has all keys.
    to
        c or fmu, which is an FMU of FMI 3.0 for co-simulation.
    out
        The folder for the C files, or the file .fmu.
    name
        Begins all names in C; controller by default, and for an FMU the name of the file.
    precision
        Of the C code: double, or single for a processor that has no double precision.
    what
        Of an FMU: controller, plant or loop.
    resolution
        Of an encoder [y-unit per count]: adds NAME_step_counts to the C code, which takes r and y
        as integers.
    accept
        Write in single precision even if it differs too much, or can't be compared.
    prove
        Write the folder proof beside the C code, and prove with Frama-C that no behaviour is
        undefined and u is always a number within its limits. What is not proved is printed, and the
        exit code is not 0.
    """
    from quell.export import c
    from quell.setup import load

    if to == "fmu":
        if precision != "double" or accept or prove or resolution is not None:
            rule = "are for --to c; an FMU is in double"
            raise ValueError(f"--precision, --resolution, --accept and --prove: {rule}")
        _to_fmu(load(setup, trust), what, out, name or "", overwrite)
        return
    if what != "controller":
        raise ValueError(f"--what = {what}: is for --to fmu; C files are those of the controller")
    if precision == "double":
        refuse({"accept": (accept, False)}, "goes with --precision single, which it accepts")
    given = load(setup, trust)
    if precision == "single" and not accept:
        given.needed("plant")
        given.needed("scenario")
    exported = c(
        given.controller,
        out,
        name=name or "controller",
        precision=precision,
        plant=given.plant,
        scenario=given.scenario,
        resolution=resolution,
        accept=accept,
        proof=prove,
        overwrite=overwrite,
    )
    _print(given.title, exported)
    if exported.proof is not None and not exported.proof.proved:
        sys.exit(ExitCode.NOT_PROVED)


def _to_fmu(given: Setup, what: str, out: Path, name: str, overwrite: bool) -> None:
    from quell.export import fmu

    controller, dt = given.controller, given.controller.dt
    part = controller if what == "controller" else given.needed("plant")
    if what == "loop":
        part = part, controller
    scenario = given.scenario
    x0 = None if what == "controller" or scenario is None else scenario.x0
    fmu(part, out, name=name, dt=dt, x0=x0, overwrite=overwrite)
    print_line(Console(), f"FMU of the {what}: {out}")


def _print(title: str, exported: Exported) -> None:
    """Print what was written, the differences of the precisions, and the sizes."""
    source, folder = exported.source, exported.folder
    name = source.name
    console = Console()
    print_line(console, f"{title}: {folder}/src/{name}.h and .c, in {source.precision} precision")
    if exported.comparison is not None:
        for line in _differences(exported.comparison):
            print_line(console, line)
    print_line(console, _sizes(exported))
    if exported.proof is not None:
        print_line(console, exported.proof.summary)
        for line in exported.proof.open:
            print_line(console, f"NOT proved: {line}")
        print_line(console, f"Report: {folder}/proof/REPORT.md; again: {folder}/proof/prove.sh")
    print_line(console, f"Test: {folder}/test_{name}.c; how to use it: {folder}/README.md")


def _differences(found: Comparison) -> list[str]:
    """Return lines about single precision, next to the effect of the noise."""
    if found.diverged:
        return ["Single precision: the run diverges; in double precision it does not"]
    rows = {"u": (found.u, found.u_noise), "y": (found.y, found.y_noise)}
    lines = []
    for signal, (difference, noise) in rows.items():
        text = f"Single precision changes {signal} by {100 * difference:.2g} % RMS"
        if noise is not None:
            text += f"; the measurement noise changes it by {100 * noise:.2g} %"
        lines.append(text)
    return lines


def _sizes(exported: Exported) -> str:
    """Return a line with the sizes, or with the reason why there are none."""
    from quell.export import NoCompilerError

    try:
        sizes = exported.sizes()
    except NoCompilerError as error:
        return f"Sizes of code, state and stack: not measured, {error}"
    stack = "not measured (gcc 10 can)" if sizes.stack is None else f"{sizes.stack} B"
    return (
        f"{sizes.processor} ({sizes.compiler} -O2): code {sizes.code} B, constants "
        f"{sizes.constants} B, state {sizes.state} B, stack {stack}; without the C library"
    )
