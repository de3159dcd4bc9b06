"""Run the plain Python blocks and the setups of the pages; cells are run where the pages are built.

    python .ci/checks/pages.py [--part K/N] [PAGE ...]

``--part K/N`` takes each N-th page from the K-th on; names of pages take only these. A block that
needs a machine, a cluster or a large library is named in ``NOT_HERE`` with the reason.
"""

import argparse
import os
import re
import sys
import tempfile
import time
import tomllib
import warnings
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import quell as ql
from quell.setup import load

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from measured import part_of

ROOT = Path(__file__).parents[2]
NOT_HERE = {
    "NiDevice(": "a card of National Instruments",
    "open_device(": "a rig",
    "import torch": "PyTorch",
    "import equinox": "JAX",
    "SLURMCluster": "a cluster",
    '"drive.fmu"': "a unit of somebody's",
    '"robot.fmu"': "a unit of somebody's",
    "controller_fmu.set(": "the interface of a unit, in words",
    "Relay(": "a rig",
}
DT = 1e-3


def blocks(page: Path, language: str) -> list[str]:
    """Return the blocks of a page in a language."""
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.M | re.S)


def known() -> dict[str, object]:
    """Return what the text around a block has defined."""
    plant = ql.plants.LinearPlant([[0.0, 1.0], [0.0, -0.6]], [0.0, 2.0], [1.0, 0.0])
    observer = ql.ESO.model_free(order=2, b0=2.0, omega_o=60.0, dt=DT)
    controller = ql.ADRC(observer, omega_c=15.0)
    scenario = ql.Scenario(reference=1.0, duration=0.5)
    u = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], 200), 10)
    y, state = np.zeros(u.size), np.zeros(2)
    for k in range(u.size - 1):  # a chain of two lags, sampled at 20 Hz
        state += 0.05 * np.array([u[k] - state[0], state[0] - state[1]])
        y[k + 1] = state[1] + 1e-3 * np.sin(3.1 * k)
    names = {"plant": plant, "observer": observer, "controller": controller, "scenario": scenario}
    return {"ql": ql, "u": u, "y": y, "dt": 0.05, **names}


def run_block(code: str, before: dict[str, object]) -> str:
    """Run a block of Python; ``before`` has what the page's blocks before it have defined."""
    for part, reason in NOT_HERE.items():
        if part in code:
            return f"not here: {reason}"
    names = known() | before
    exec(compile(code, "block", "exec"), names)
    before |= names
    plt.close("all")
    return "runs"


def run_setup(code: str) -> str:
    """Simulate a setup; return how it went."""
    if len(re.findall("^plant = ", code, re.M)) > 1:
        return "several plants, which tests/test_pages.py takes one after the other"
    tables = tomllib.loads(code)
    if not {"plant", "controller", "scenario"} <= tables.keys():
        return "a part of a setup"
    Path("setup.toml").write_text(code, encoding="utf-8")
    setup = load("setup.toml")
    run = ql.simulate(setup.plant, setup.controller, setup.scenario)
    assert np.all(np.isfinite(run["y"])), run.status
    return f"runs, {len(run)} samples"


pages = {page.name: page for page in sorted([*(ROOT / "docs").glob("*.md"), ROOT / "README.md"])}
parser = argparse.ArgumentParser(description="Run the blocks of pages.")
parser.add_argument("--part", type=part_of, default="1/1", help="K/N")
parser.add_argument("page", nargs="*", default=[*pages], help="names of pages; all without")
options = parser.parse_args()
if unknown := set(options.page) - pages.keys():
    parser.error(f"there is no page {', '.join(sorted(unknown))}")
warnings.simplefilter("ignore")
failed: list[str] = []
for page in [pages[name] for name in sorted(set(options.page))][options.part]:
    began = time.process_time()
    shared: dict[str, object] = {}
    for language, how in (("python", partial(run_block, before=shared)), ("toml", run_setup)):
        for number, code in enumerate(blocks(page, language), 1):
            with tempfile.TemporaryDirectory() as folder:
                os.chdir(folder)
                try:
                    found = how(code)
                except Exception as error:  # one block must not hide the others
                    found = f"NOT: {type(error).__name__}: {error}"
                    failed.append(f"{page.name}, {language} {number}: {found}")
                finally:
                    os.chdir(ROOT)
                print(f"{page.name}, {language} {number}: {found}", flush=True)
    print(f"{page.name}: {time.process_time() - began:.1f} s of CPU", flush=True)
sys.exit("\n".join(failed) or None)
