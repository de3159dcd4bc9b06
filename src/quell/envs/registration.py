"""Names of the library's environments in Gymnasium's registry.

It imports nothing of quell that takes time.
"""

from __future__ import annotations

from quell.optional import import_extra

NAMES = (
    "two-mass",
    "two-mass-residual",
    "dc-motor",
    "dc-motor-residual",
    "torsional",
    "torsional-residual",
)
"""Environments of ``library.py``, by their names without namespace and version."""


def register_all() -> None:
    """Add what is missing to Gymnasium's registry."""
    purpose = "quell.envs"
    registration = import_extra("gymnasium.envs.registration", "envs", purpose)
    for name in NAMES:
        full_name = f"quell/{name}-v0"
        if full_name in registration.registry:
            continue
        registration.register(
            id=full_name,
            entry_point="quell.envs.library:make",
            vector_entry_point="quell.envs.library:make_vector",
            kwargs={"name": name},
        )
