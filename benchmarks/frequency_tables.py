"""Tables of frequencies: poles beside those of the time record of the same plant.

Draws servos (rigid; flexible, measured at the motor or at the load), ovens with dead time, and
converters with an LC filter. Each gives a time record, a PRBS of u that is held, with white noise
of 0.01 to 1 % of y, which is identified with the order of the plant and a delay that is searched.
The table is either the frequency response of another record of the plant, with its deviations, or
that of an analyser: 60 to 250 frequencies with errors of 0.01 to 1 %, in one of five formats (dB
and degrees, a factor and radians, real and imaginary part; Hz, kHz or rad/s; commas, semicolons
with decimal commas, tabs). It is read from a file, and order and delay are not given.

Counts the poles of the time record within the table that a pole of the table is within 1 % of.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from measured import parser_of, write
from records_of_form import answer

import quell as ql
from quell.identification import frequency_response, frequency_table, identify_frequencies
from quell.signals import PRBS

SAMPLES, NEAR = 4000, 0.01
KINDS = ("rigid", "at the motor", "at the load", "oven", "converter")


def plant(rng: np.random.Generator, kind: str) -> tuple[Any, Any, float, float]:
    """Return numerator, denominator, sample time and delay."""
    if kind == "oven":
        dt, lag = 1.0, 10.0 ** rng.uniform(1.5, 2.5)
        other = lag * rng.uniform(0.05, 0.3)
        den = np.polymul([lag, 1.0], [other, 1.0])
        return [rng.uniform(0.3, 3.0)], den, dt, dt * rng.integers(0, 15)
    if kind == "converter":
        dt, w = 1e-5, 2.0 * np.pi * 10.0 ** rng.uniform(2.7, 3.7)
        z = 10.0 ** rng.uniform(-1.5, -0.3)
        return [24.0 * w * w], [1.0, 2.0 * z * w, w * w], dt, dt * rng.integers(0, 3)
    dt, pole = 1e-3, rng.uniform(1.0, 15.0)
    num, den = np.array([1e3]), np.array([1.0, pole, 0.0])
    if kind != "rigid":
        fixed = 2.0 * np.pi * rng.uniform(15.0, 60.0)
        w, z = fixed * rng.uniform(1.15, 1.8), 10.0 ** rng.uniform(-2.3, -1.2)
        den = np.polymul(den, [1.0 / w**2, 2.0 * z / w, 1.0])
        if kind == "at the motor":
            num = 1e3 * np.array([1.0 / fixed**2, 1.6 * z / fixed, 1.0])
    return num, den, dt, dt * rng.integers(0, 3)


def record(
    rng: np.random.Generator, num: Any, den: Any, dt: float, late: float, noise: float
) -> tuple[Any, Any]:
    """Return u and y."""
    hold = int(rng.integers(2, 6))
    u = PRBS(1.0, 13, hold * dt, seed=int(rng.integers(1, 1000)))(np.arange(SAMPLES) * dt)
    y = answer(num, den, dt, u, late)
    return u, y + noise * np.std(np.diff(y, 3)) * rng.standard_normal(y.size)


def written(rng: np.random.Generator, file: Path, omega: Any, G: Any) -> None:
    """Write a table in one of the formats."""
    f, size = omega / (2.0 * np.pi), 20.0 * np.log10(np.abs(G))
    degrees = np.degrees(np.angle(G))
    columns, head, mark = [
        ((f, size, degrees), "Frequency [Hz],Magnitude [dB],Phase [deg]", ","),
        ((omega, G.real, G.imag), "omega\treal\timag", "\t"),
        ((f, size, degrees), "Freq (Hz);Gain (dB);Phase (°)", ";"),
        ((f, np.abs(G), np.unwrap(np.angle(G))), "f mag phase_rad", " "),
        ((f / 1e3, size, degrees), "Frequency (kHz),Trace 1: Gain: Magnitude (dB),Phase (°)", ","),
    ][int(rng.integers(5))]
    rows = [mark.join(f"{value:.6g}" for value in row) for row in zip(*columns, strict=True)]
    text = "\n".join([head, *rows])
    file.write_text(text.replace(".", ",") if mark == ";" else text, encoding="utf-8")


def main() -> None:
    """Print the tables with a pole that is off, and the counts."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    tables, poles, near, orders, of_truth, unsaid = 0, 0, 0, 0, 0, 0
    count = 3 if given.quick else given.count
    all_near = 0
    for i in range(count):
        rng, kind = np.random.default_rng([given.seed, i]), KINDS[i % len(KINDS)]
        num, den, dt, late = plant(rng, kind)
        noise = 10.0 ** rng.uniform(-4.0, -2.0)
        u, y = record(rng, num, den, dt, late, noise)
        order = len(den) - 1
        model = ql.identify(u, y, dt, order, 2 if kind == "at the motor" else 0, delay=None)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, "table.txt")
            if i % 2:
                u, y = record(rng, num, den, dt, late, noise)
                frequency_response(u, y, dt, method="auto").save(file)
            else:
                fast = min(0.4 * np.pi / dt, 6.0 * float(np.max(np.abs(np.roots(den)))))
                slow = min(
                    0.3 * float(np.min(np.abs(np.roots(den)[np.roots(den) != 0.0]))), fast / 50
                )
                omega = np.geomspace(slow, fast, int(rng.integers(60, 250)))
                s = 1j * omega
                hold = np.exp(-0.5 * s * dt) * np.sinc(omega * dt / (2.0 * np.pi))
                G = np.polyval(num, s) / np.polyval(den, s) * np.exp(-s * late) * hold
                error = rng.standard_normal((2, omega.size))
                written(rng, file, omega, G * (1.0 + noise * (error[0] + 1j * error[1])))
            table = frequency_table(file)
        assert table is not None
        assert table.response is not None
        found = identify_frequencies(table.omega, table.response, deviation=table.deviation, dt=dt)
        away, truth = [], []
        for pole in model.poles:
            if not pole.value or not table.omega[0] < pole.omega < table.omega[-1]:
                continue
            at = min(found.poles, key=lambda one: abs(one.value - pole.value))
            away.append(abs(at.value - pole.value) / pole.omega)
        for value in np.roots(den):
            if table.omega[0] < abs(value) < table.omega[-1]:
                truth.append(min(abs(one.value / value - 1.0) for one in found.poles))
        tables, poles, near = tables + 1, poles + len(away), near + sum(e < NEAR for e in away)
        all_near += bool(max(away, default=0.0) < NEAR)
        of_truth += bool(max(truth, default=0.0) < NEAR)
        orders += len(found.poles) == order
        unsaid += bool(max(truth, default=0.0) > 5.0 * NEAR and not found.shortcomings)
        if max(away, default=0.0) >= NEAR or max(truth, default=0.0) >= NEAR:
            print(
                i,
                kind,
                f"{max(away):.4f} of the record's, {max(truth):.4f} of the truth,",
                f"order {len(found.poles)} of {order}, {found.shortcomings}",
                flush=True,
            )
    figures = {
        "tables": tables,
        "poles": poles,
        "poles within 1 % of those of the time record": near,
        "tables with all poles within 1 % of those of the time record": all_near,
        "tables with all poles within 1 % of the truth": of_truth,
        "tables with the order of the plant": orders,
        "poles over 5 % off without NOT": unsaid,
    }
    print(figures)
    write(given, figures)


if __name__ == "__main__":
    main()
