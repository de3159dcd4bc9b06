"""``quell excite``."""

from __future__ import annotations

from pathlib import Path

from quell.cli.options import Overwrite, Whole, refuse
from quell.cli.output import Console, print_line


def excite(
    out: Path,
    *,
    kind: str = "prbs",
    low: float = 0.5,
    high: float = 60.0,
    duration: float = 60.0,
    dt: float = 1e-3,
    u_min: float = -1.0,
    u_max: float = 1.0,
    seed: Whole = 0,
    overwrite: Overwrite = False,
) -> None:
    """Design an input that excites a band within limits, for quell identify, and write it as CSV.

    Parameters
    ----------
    out
        CSV file to write, with columns t,u.
    kind
        multisine, prbs or chirp.
    low
        Lowest frequency of the band [rad/s].
    high
        Highest frequency of the band [rad/s].
    duration
        Length of the input [s].
    dt
        Sample time [s].
    u_min
        Lower limit of u.
    u_max
        Upper limit of u.
    seed
        Start of a PRBS, or phases of a multisine.
    """
    from quell.files import check_writable
    from quell.identification import excitation

    if kind == "chirp":
        refuse({"seed": (seed, 0)}, "a chirp has nothing random")
    check_writable(out, overwrite)
    design = excitation(kind, (low, high), duration, dt, u_min, u_max, seed=seed)
    design.save(out, overwrite)
    console = Console()
    print_line(console, design.describe())
    print_line(console, f"Samples: {out}, {design.u.size} of t,u")
