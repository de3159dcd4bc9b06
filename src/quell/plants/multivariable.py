"""Names of an earlier release, which have other places now."""

from quell.lazy import imported_on_use

_HOMES = {
    "delayed_inputs": "channels",
    "encoded_outputs": "channels",
    "is_several": "base",
    "measure_all": "base",
}
_RENAMED = {
    "MultivariableLinearPlant": "LinearPlant",
    "MultivariableNonlinearPlant": "NonlinearPlant",
}

__getattr__ = imported_on_use("quell.plants", _HOMES, (), _RENAMED)
