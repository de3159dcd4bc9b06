"""How often a verdict over seeds is wrong: two coupled axes, two controllers, drawn loads.

The mean of the logarithms of the ratio of RMS errors over all runs stands for the true one. Of the
groups of seeds, the share whose interval, at the level of one comparison, does not hold it is
counted; it should be 5 %.

    python benchmarks/over_seeds.py --seeds 2000
"""

import math

import numpy as np
from measured import options_of, parser_of, write

import quell as ql
from quell.experiments.over_seeds import over_seeds
from quell.monitoring.rank import decide

DT, LEVEL = 1e-3, 0.05


def gantry():
    """Return a gantry whose drives act on both axes."""
    A = [[0, 1, 0, 0], [0, -2, 0, 0], [0, 0, 0, 1], [0, 0, 0, -3]]
    B = [[0, 0], [5, 0.5], [0, 0], [0.4, 6]]
    return ql.plants.LinearPlant(A, B, np.eye(4)[[0, 2]])


def axes(omega_c):
    """Return an ADRC for each axis."""
    one = ql.ADRC(ql.ESO.model_free(order=2, b0=1.0, omega_o=60.0, dt=DT), omega_c=omega_c)
    return ql.Axes({"x": one, "y": one}, B0=[[5.0, 0.5], [0.4, 6.0]])


def main():
    """Print the shares."""
    parser = parser_of(__doc__)
    parser.add_argument("--seeds", type=int, default=2000)
    options = options_of(parser, seeds=20)
    seeds = options.seeds
    load = ql.signals.BandLimitedNoise(1e-2, 0.05)
    noise = ql.signals.BandLimitedNoise(1e-11, DT)
    scenario = ql.Scenario((0.1, 0.1), 1.0, (load, load), noise)
    found = over_seeds(gantry(), {"8": axes(8.0), "9": axes(9.0)}, scenario, seeds=seeds)
    d = np.log(found.values["rms"][0, 0]) - np.log(found.values["rms"][1, 0])
    d = np.vstack([d, d.mean(axis=0)])
    figures = {}
    for axis, row in zip(("x", "y", "all axes"), d, strict=True):
        true = float(row.mean())
        for size in (3, 5, 10, 20):
            groups = row[: row.size // size * size].reshape(-1, size)
            spread = groups.std(axis=1, ddof=1) / math.sqrt(size)
            pairs = zip(groups.mean(axis=1), spread, strict=True)
            ends = [decide(*map(float, pair), size - 1.0, LEVEL).ends for pair in pairs]
            missed = np.mean([not low <= true <= high for _, low, high in ends])
            share = f"{100.0 * missed:.1f} % of {len(groups)} intervals"
            print(f"{axis:8} {size:2} seeds: {share} miss the mean, {true:.4f}")
            figures[f"{axis}, {size} seeds"] = {
                "missed [%]": 100.0 * missed,
                "intervals": len(groups),
                "mean of the logarithm": true,
            }
    write(options, figures)


if __name__ == "__main__":
    main()
