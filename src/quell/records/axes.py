"""Names of an earlier release, which have other places now."""

from quell.lazy import imported_on_use

_HOMES = {
    "one_gain": "gains",
    "OneGain": "gains",
    "Trajectory": "trajectory",
    "BatchTrajectory": "trajectory",
}
_RENAMED = {"AxesBatch": "BatchTrajectory", "AxesTrajectory": "Trajectory"}

__getattr__ = imported_on_use("quell.records", _HOMES, (), _RENAMED)
