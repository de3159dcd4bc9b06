"""The C struct of what a controller knows after a sample, and the enums of its integers."""

from __future__ import annotations

from quell.export.c_files import CFiles
from quell.export.translate.text import wrapped
from quell.guard import Reason
from quell.types import Channels, Status

# Channels that hold integers.
_WHOLE = ("status", "reason")

# Comments of the members of the estimate.
_CHANNELS = {
    "x_hat": "y and its derivatives",
    "f_residual": "the observer's share of f",
    "f_learned": "the learner's share of f",
    "f_derivatives": "derivatives of the observer's share of f",
    "u_feedforward": "feedforward of the model, a part of u",
    "status": "flags of the last sample",
    "authority": "share of its output that the guard allows the learner",
    "error_plain": "RMS error in f of an ESO without learner",
    "error_learned": "the same for the learner with full authority",
    "reason": "for the authority",
    "theta": "the learner's coefficients",
    "r_shaped": "reference behind the prefilter",
    "u_unlimited": "control signal before limits",
}


def _has_f(channels: Channels) -> bool:
    return {"f_residual", "f_learned"} <= {name for name, _ in channels}


def estimate_struct(name: str, channels: Channels, real: str, doc: str) -> list[str]:
    """Return the lines of the struct ``name`` with a member for each channel of a controller."""
    lines = ["", f"/* {doc} */", "typedef struct {"]
    for channel, width in channels:
        kind = "int" if channel in _WHOLE else real
        shape = f"[{width}]" if width > 1 else ""
        lines.append(f"    {kind} {channel}{shape}; /* {_CHANNELS.get(channel, channel)} */")
    if _has_f(channels):
        lines.append(f"    {real} f; /* total disturbance: f_residual + f_learned */")
    return [*lines, f"}} {name};"]


def estimate_lines(files: CFiles, place: str, channels: Channels) -> list[str]:
    """Return the statements that set the struct at ``place`` from the numbers in ``row``."""
    lines, at = [], 0
    for channel, width in channels:
        whole = channel in _WHOLE
        for i in range(width):
            index = f"[{i}]" if width > 1 else ""
            number = f"row[{at}]"
            if whole:
                number = f"{files.program.calls.helper('truncated')}({number})"
            lines.append(f"    {place}.{channel}{index} = {number};")
            at += 1
    if _has_f(channels):
        lines.append(f"    {place}.f = {place}.f_residual + {place}.f_learned;")
    return lines


def enums(name: str, channels: Channels) -> list[str]:
    """Return the lines of the enums of flags, and of the guard's reasons if there are some."""
    upper = name.upper()
    flags = ", ".join(f"{upper}_{flag.name} = {int(flag)}" for flag in Status if flag.name)
    lines = ["", "/* Flags of a sample, combined by |. */"]
    lines += wrapped(f"enum {name}_flag {{ {flags} }};")
    if "reason" in dict(channels):
        reasons = ", ".join(f"{upper}_{reason.name} = {int(reason)}" for reason in Reason)
        lines += ["", "/* Reasons of the guard for the learner's authority. */"]
        lines += wrapped(f"enum {name}_reason {{ {reasons} }};")
    return lines
