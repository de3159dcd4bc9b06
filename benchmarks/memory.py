"""Memory use of a run of 10^8 samples, relative to the process before the run.

python benchmarks/memory.py [--samples N]
"""

from __future__ import annotations

import resource
import time

from measured import options_of, parser_of, write

import quell as ql
from quell.experiments import two_mass_spring as study


def main() -> None:
    """Run the loop with the Kalman learner for a long time, recording every 10 000th sample."""
    parser = parser_of(__doc__)
    parser.add_argument("--samples", type=float, default=1e8)
    options = options_of(parser, samples=1e6)
    samples = int(options.samples)
    settings, plant = study.Settings(), ql.plants.two_mass_spring()
    controller = study.controllers(settings)[study.L]
    ql.simulate(plant, controller, ql.Scenario(duration=1.0))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    scenario = ql.Scenario(
        reference=ql.signals.Sinusoid(),
        disturbances=(0.0, ql.signals.Sinusoid(omega=0.3)),
        noise=ql.signals.BandLimitedNoise(1e-12, 0.01),
        duration=(samples - 1) * settings.dt,
    )
    began = time.perf_counter()
    run = ql.simulate(plant, controller, scenario, record_every=10_000)
    took = time.perf_counter() - began
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{samples:.0e} samples in {took:.1f} s ({took / samples * 1e9:.0f} ns each), "
        f"{len(run)} rows recorded"
    )
    print(f"memory: {before:.0f} MB before, {after - before:.0f} MB more at the most (bar: 200 MB)")
    write(
        options,
        {
            "samples": samples,
            "rows": len(run),
            "time of a sample [ns]": took / samples * 1e9,
            "memory before [MB]": before,
            "memory more [MB]": after - before,
        },
    )


if __name__ == "__main__":
    main()
