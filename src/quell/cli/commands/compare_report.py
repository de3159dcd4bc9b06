"""Tables and JSON of ``quell compare``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from math import inf
from typing import TYPE_CHECKING, Any

from quell.cli.output import Console, table
from quell.files import nonfinite_to_none

if TYPE_CHECKING:
    from quell.experiments.compare import Benchmark, Comparison, Entry
    from quell.tuning import Constraints

# Key, heading, unit, factor and most decimals.
_COLUMNS = (
    ("overshoot", "over-\nshoot", "%", 100.0, 2),
    ("settling_time", "settling", "s", 1.0, 2),
    ("disturbance_peak", "peak", "y-unit", 1.0, 4),
    ("rms", "RMS", "y-unit", 1.0, 4),
    ("control_variation", "vari-\nation", "u-unit", 1.0, 2),
)
_GAINS = (("m_s", "M_s", 3), ("m_t", "M_t", 3), ("m_ks", "M_ks", 1), ("k_i", "k_i", 3))
# Characters of a number, so that the table fits into a terminal of 80 columns.
_WIDTH = 6


def as_json(
    result: Comparison,
    stable: Mapping[str, bool | None],
    gains: Mapping[str, Any],
    entries: Mapping[str, Entry],
    bounds: Constraints | None,
) -> dict[str, Any]:
    """Return scores, gains and what was tuned, for a JSON file."""
    results = result.to_json()
    for name, scores in results["controllers"].items():
        scores["stable"] = stable[name]
        if gains[name] is not None:
            scores |= nonfinite_to_none(asdict(gains[name]))  # k_i with two integrators
        if name in entries:
            scores |= {"structure": entries[name].structure, "values": dict(entries[name].values)}
    if bounds is not None:
        results["constraints"] = {key: getattr(bounds, key) for key in ("m_s", "m_t", "m_ks")}
    missing = {name: entry.reason for name, entry in entries.items() if entry.controller is None}
    return results | ({"not_possible": missing} if missing else {})


def print_scores(
    console: Console,
    title: str,
    result: Comparison,
    stable: Mapping[str, bool | None],
) -> None:
    """Print a row for each run, with the units of the plant that are known."""
    signals = next(iter(result.runs.values())).signals
    units = [signals.unit(unit) for _, _, unit, _, _ in _COLUMNS]
    headings = [
        heading if unit.endswith("-unit") else f"{heading}\n[{unit}]"
        for (_, heading, *_), unit in zip(_COLUMNS, units, strict=True)
    ]
    rows = table(title, "controller", *headings, padding=(0, 1, 0, 0), pad_edge=False)
    rows.add_column("status")
    for name, score in result.scores.items():
        cells = [
            "–" if (value := score[key]) is None else _short(factor * value, decimals)
            for key, _, _, factor, decimals in _COLUMNS
        ]
        run = result.runs[name]
        status = (run.status.name or "OK").lower().replace("_", " ").replace("|", ", ")
        if run.diverged:
            status = f"[red]diverged {run.ended:.0f} s[/]"
        elif stable[name] is False:
            status = "[red]unstable[/]"
        rows.add_row(name, *cells, status)
    console.print(rows)


def print_two_mass(console: Console, settings: Benchmark) -> None:
    """Print what the scores of the benchmark are."""
    from quell.experiments.compare import BAND, END, FORCE, FORCE_AT

    limit = "u not limited" if settings.u_max == inf else f"|u| up to {settings.u_max:g} N"
    console.print(
        f"Unit step from rest, judged until {FORCE_AT:g} s (settling ±{100.0 * BAND:g} %); "
        f"{FORCE:g} N on m2 from then on (peak). RMS and variation: all {END:g} s. "
        f"dt = {settings.dt:g} s, {limit}. –: not settled, or diverged before. "
        "Variation of u without its first jump. "
        "Unstable: the linear loop has a growing pole, perhaps a slow one.",
        soft_wrap=True,
    )


def print_gains(
    console: Console,
    gains: Mapping[str, Any],
    entries: Mapping[str, Entry],
    bounds: Constraints | None,
) -> None:
    """Print what the loops were tuned for, and who rejects loads best."""
    shown = {name: found for name, found in gains.items() if found is not None}
    headings = [heading for _, heading, _ in _GAINS]
    rows = table("Largest gains and integral gain of the linear loops", "controller", *headings)
    for name, found in shown.items():
        rows.add_row(name, *(f"{getattr(found, key):.4g}" for key, _, _ in _GAINS))
    if shown:
        console.print(rows)
        best = max(shown, key=lambda name: float(shown[name].k_i))
        ours = [n for n in shown if n in entries]
        text = f"Largest k_i: {best}"
        if ours:
            first = max(ours, key=lambda name: float(shown[name].k_i))
            text += f"; of the tuned ones {first}"
        console.print(text + ".", highlight=False)
    if bounds is not None:
        text = f"Tuned for the largest k_i (PID: the least ∫|y| after a load) under {bounds}."
        console.print(text, soft_wrap=True, highlight=False)
    for name, entry in entries.items():
        if entry.controller is None:
            console.print(f"{name}: {entry.reason}", soft_wrap=True, highlight=False)


def _short(value: float, decimals: int) -> str:
    """Return a number with at most ``decimals`` decimals in few characters; large ones as 4.9e4."""
    for count in range(decimals, -1, -1):
        text = f"{value:.{count}f}"
        if len(text) <= _WIDTH:
            return text
    digits, _, power = f"{value:.1e}".partition("e")
    return f"{digits}e{int(power)}"
