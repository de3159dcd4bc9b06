"""Fits of ``identify`` to public records, next to an independent search from many starts.

    python benchmarks/identification_records.py [FOLDER] [--starts N] [--only RECORD]

FOLDER has robot_arm.csv (DaISy), cascaded_tanks.csv and emps.csv (nonlinear benchmarks), buck.csv
(sysidentpy). The independent search minimises the same output error by scipy's ``least_squares``,
in discrete time, for poles in second-order sections, from random starts; numerator, constant force
and initial state are solved for. With n − 1 zeros both have the same models, as discrete
poles on the negative real axis are excluded. The fit is NRMSE on the whole record [%].
"""

from __future__ import annotations

import time
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from measured import check_present, options_of, parser_of, shared_data, write
from scipy import signal
from scipy.optimize import least_squares

import quell as ql
from quell.identification import Measured, read_record
from quell.types import Matrix, Vector

# Columns, sample time [s], and orders of each record.
RECORDS = {
    "robot_arm": (("u", "y"), 1.0, (2, 3, 4, 5, 6)),
    "cascaded_tanks": (("uEst", "yEst"), 4.0, (1, 2, 3)),
    "buck": (("input", "y"), 1e-5, (1, 2, 3)),
    "emps": (("u", "y"), 1e-3, (2, 3)),
}


def sections(theta: Vector) -> list[Vector]:
    """Return the polynomials whose product is the denominator, in descending powers of z."""
    pairs = [np.append(1.0, theta[at : at + 2]) for at in range(0, theta.size - 1, 2)]
    return pairs + [np.array([1.0, theta[-1]])] * (theta.size % 2)


def is_sampled(theta: Vector) -> bool:
    """Return whether a continuous model has these poles: none is real and not positive."""
    roots = np.concatenate([np.roots(part) for part in sections(theta)])
    return not np.any((roots.imag == 0.0) & (roots.real <= 0.0))


def columns_of(theta: Vector, order: int, u: Vector) -> Matrix:
    """Return the responses that numerator, constant force and initial state scale."""
    a = reduce(np.convolve, sections(theta))
    impulse = np.zeros(u.size)
    impulse[0] = 1.0
    bases = [signal.lfilter([1.0], a, one) for one in (u, np.ones(u.size), impulse)]
    late = [np.append(np.zeros(k), bases[0][: u.size - k]) for k in range(1, order + 1)]
    free = [np.append(np.zeros(k), bases[2][: u.size - k]) for k in range(order)]
    return np.column_stack([*late, bases[1], *free])


def independent_fit(order: int, u: Vector, y: Vector, starts: int) -> float:
    """Return the best fit [%] of scipy's search from random stable starts."""
    rng, spread, best = np.random.default_rng(0), float(np.std(y)), np.inf

    def error(theta: Vector) -> Vector:
        if not is_sampled(theta):
            return np.full(y.size, 10.0 * spread)
        with np.errstate(all="ignore"):
            columns = columns_of(theta, order, u)
            size = np.linalg.norm(columns, axis=0)
            if not np.all(np.isfinite(size)) or np.max(size) > 1e12:
                return np.full(y.size, 10.0 * spread)
            scaled = columns / np.maximum(size, 1e-300)
            return np.asarray(y - scaled @ np.linalg.lstsq(scaled, y, rcond=1e-12)[0])

    for _ in range(starts):
        radius = 1.0 - np.exp(rng.uniform(np.log(1e-3), np.log(0.5), order))
        angle = np.exp(rng.uniform(np.log(0.01), np.log(np.pi), order))
        theta = np.empty(order)
        for at in range(0, order - 1, 2):
            theta[at : at + 2] = -2.0 * radius[at] * np.cos(angle[at]), radius[at] ** 2
        if order % 2:
            theta[-1] = -radius[-1]
        best = min(best, 2.0 * least_squares(error, theta, max_nfev=200).cost)
    return float(100.0 * (1.0 - np.sqrt(best / y.size) / spread))


def read(folder: Path, name: str) -> Measured:
    """Return a record, whose lines may end in a comma."""
    columns, dt, _ = RECORDS[name]
    path = folder / f"{name}.csv"
    if name != "cascaded_tanks":
        return read_record(path, columns, dt)
    names = [text.strip('"') for text in path.read_text().splitlines()[0].split(",")]
    places = [names.index(column) for column in columns]
    values = np.genfromtxt(path, delimiter=",", skip_header=1, usecols=places)
    return Measured(values[:, 0].copy(), values[:, 1].copy(), dt, None)


def main() -> None:
    """Fit all records and print one table."""
    parser = parser_of(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=shared_data(""))
    parser.add_argument("--starts", type=int, default=20, help="starts of the independent search")
    parser.add_argument("--only", choices=RECORDS)
    options = options_of(parser, starts=1, only="buck")
    figures: dict[str, Any] = {}
    print(f"{'record':15} order/zeros  identify [%]  converged  CPU [s]  independent [%]")
    for name, (_, _, orders) in RECORDS.items():
        if options.only not in (None, name):
            continue
        check_present(options, files=[options.folder / f"{name}.csv"])
        record = read(options.folder, name)
        for order in orders:
            began = time.process_time()
            found = ql.identify(
                record.u, record.y, record.dt, order, order - 1, integrators=0, held_out=0.0
            )
            taken = time.process_time() - began
            fit = found.fits["estimation"]
            other = independent_fit(order, record.u, record.y, options.starts)
            print(
                f"{name:15} {order:5}/{order - 1:<5} {fit:13.3f}  {found.converged!s:9} "
                f"{taken:8.2f} {other:16.3f}",
                flush=True,
            )
            figures.setdefault(name, {})[f"order {order}"] = {
                "identify": fit,
                "converged": found.converged,
                "cpu": taken,
                "independent": other,
            }
    write(options, figures)


if __name__ == "__main__":
    main()
