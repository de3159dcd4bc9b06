"""*Tune for me* of the studio on its examples and on drawn setups: what gets better, what is named.

Each drawn setup (motors, ovens, tanks, flexible axes; limits of u, noise, delay) has a plain
bandwidth design with the margins of the default, ``structure="bandwidths"``. The studio's own code
then tunes it and gives its verdict. Both setups are simulated here, and these are compared: ∫|e|
over the whole scenario, overshoot, the largest error under the load, the variation of u, and the
delay margin. Counted are

- ``better``: ∫|e| is smaller;
- ``applied``: the verdict names nothing, so the studio takes the tuned design;
- ``unsaid``: something of these is worse by more than 10 %, and the verdict names nothing.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from drawn_tunings import drawn
from measured import parser_of, write

import quell as ql
from quell.setup import made
from quell.studio.messages import parsed_frame
from quell.studio.records import PageRecord
from quell.studio.runs import Maker
from quell.studio.tasks import tuned_frames

PAGE = Path(ql.__file__).parent / "studio" / "page"
PRESETS = json.loads((PAGE / "presets.json").read_text(encoding="utf-8"))
# A share of a size of this much is rounding, and an overshoot below 2 % is not seen.
WORSE, SEEN = 0.1, 0.02


def tank(rng: np.random.Generator) -> dict[str, Any]:
    """Return two tanks behind each other, whose valve goes from 0 to 100 %."""
    first, second = np.exp(rng.uniform(np.log(20.0), np.log(200.0), 2))
    gain = float(rng.uniform(0.1, 0.6))
    found = {"num": [gain], "den": np.polymul([first, 1.0], [second, 1.0]).tolist()}
    found |= {"u": (0.0, 100.0), "size": gain * rng.uniform(10.0, 50.0), "load": -8.0}
    return found | {"last": 12.0 * (first + second), "dt": 0.5, "samples": 1, "noise": 0.02}


def drawn_setup(kind: str, seed: int) -> dict[str, Any]:
    """Return the tables of a drawn setup with a plain bandwidth design."""
    rng = np.random.default_rng(seed)
    of = tank(rng) if kind == "tank" else drawn(kind, rng)
    dt, low, high = of["dt"], *of["u"]
    linear, late = {"kind": "linear", "num": of["num"], "den": of["den"]}, of["samples"] * dt
    plant = (of["num"], of["den"])
    bounds = ql.tuning.Constraints(noise_std=of["noise"])
    how: dict[str, Any] = {"constraints": bounds, "delay": late, "u_min": low, "u_max": high}
    how |= {"order": 1 if low == 0.0 else 2, "compare": (), "feedforward": False}
    plain = ql.tune(plant, dt, structure="bandwidths", written=False, **how).design
    at, load_at = (round(share * of["last"] / dt) * dt for share in (0.1, 0.55))
    return {
        "title": kind,
        "dt": dt,
        "plant": {"kind": "delayed", "delay": late, "plant": linear},
        **plain.tables,
        "controller": {**plain.tables["controller"], "u_min": low, "u_max": high},
        "scenario": {
            "duration": round(of["last"] / dt) * dt,
            "reference": {"kind": "step", "height": of["size"], "at": at},
            "disturbances": [{"kind": "step", "height": of["load"], "at": load_at}],
            "noise": {"kind": "noise", "power": of["noise"] ** 2 * dt, "sample_time": dt},
        },
        "metrics": [{"start": at, "stop": load_at}, {"start": load_at}],
    }


def sizes(tables: dict[str, Any]) -> dict[str, float]:
    """Return what is compared, of a setup that is simulated here."""
    setup = made("setup", tables)
    run = ql.simulate(setup.plant, setup.controller, setup.scenario)
    error, t = np.abs(run["r"] - run["y"]), run.t
    r = run["r"]
    at = int(np.argmax(r != r[0])) if np.any(r != r[0]) else 0
    load = max((getattr(each, "at", 0.0) for each in setup.scenario.disturbances), default=0.0)
    height = r[-1] - r[0]
    during = (t >= t[at]) & ((t < load) | (load <= t[at]))
    over = float(np.max((run["y"][during] - r[-1]) / height)) if height else 0.0
    return {
        "∫|e|": float(np.sum(error) * setup.controller.dt),
        "overshoot": max(over, 0.0),
        "error under the load": float(np.max(error[t >= load])) if load > t[at] else 0.0,
        "variation of u": float(np.sum(np.abs(np.diff(run["u"])))),
    }


def trial(tables: dict[str, Any]) -> dict[str, Any]:
    """Tune for me: what is better and worse, and what the verdict names."""
    setup, named, tuned = made("setup", tables), [], None
    # The bounds that the page asks for when it opens.
    message = {"kind": "tune", "id": 1, "m_s": 1.6, "m_t": 1.6}
    frames = tuned_frames(
        setup, PageRecord(), message, lambda: False, lambda *_: None, Maker(trust=False)
    )
    for each in frames:
        header = parsed_frame(each)[0]
        if header["kind"] == "tuned":
            tuned = header["setup"]
        elif header["kind"] == "verdict":
            named = [worse["text"] for worse in header["worse"]]
            break
    before, now = sizes(tables), sizes(tuned or tables)
    worse = [
        name
        for name, old in before.items()
        if now[name] > old + max(WORSE * old, SEEN if name == "overshoot" else 1e-9)
    ]
    return {
        "ratio": now["∫|e|"] / before["∫|e|"],
        "worse": worse,
        "named": named,
        "unsaid": bool(worse and not named),
    }


def main() -> None:
    """Print a line for each setup, and the counts."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    setups = {each["name"]: each["setup"] for each in PRESETS if "axes" not in each["setup"]}
    if given.quick:
        setups = dict(list(setups.items())[:1])
    for i in range(0 if given.quick else given.count):
        kind = ("motor", "oven", "tank", "flexible")[i % 4]
        setups[f"{kind} {i}"] = drawn_setup(kind, given.seed * 1000 + i)
    rows = []
    for name, tables in setups.items():
        rows.append(trial(tables))
        print(name, rows[-1], flush=True)
    figures = {
        "setups": len(rows),
        "better": sum(row["ratio"] < 1.0 for row in rows),
        "applied": sum(not row["named"] for row in rows),
        "unsaid": sum(row["unsaid"] for row in rows),
        "median ratio": float(np.median([row["ratio"] for row in rows])),
    }
    print(figures)
    write(given, figures)


if __name__ == "__main__":
    main()
