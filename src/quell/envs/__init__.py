"""Environments for Gymnasium: loops whose control signal, or feedforward, a policy gives.

The import registers ``quell/two-mass-v0`` and others with Gymnasium (extra ``envs``); the compiler
is loaded when one of them is made, or ``Env``, ``VectorEnv`` or ``Policy`` is first used.

May import ``simulation`` and what it imports.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING

from quell.checks import import_extra
from quell.lazy import imported_on_use, public_names

if TYPE_CHECKING:
    from quell.envs.actions import Policy
    from quell.envs.env import Env, VectorEnv

__all__ = ["NAMES", "Env", "Policy", "VectorEnv", "register"]

__getattr__ = imported_on_use(__name__, {"Env": "env", "Policy": "actions", "VectorEnv": "env"})

NAMES = (
    "two-mass",
    "two-mass-residual",
    "dc-motor",
    "dc-motor-residual",
    "torsional",
    "torsional-residual",
    "arm",
    "arm-residual",
)
"""The environments of the library, by their names without namespace and version."""


def register() -> None:
    """Register the environments of the library as ``quell/…`` with Gymnasium.

    Importing ``quell.envs`` does so, if Gymnasium is installed. Gymnasium imports the module itself
    for ``gymnasium.make("quell.envs:quell/two-mass-v0")``; since version 1.0 it has no plugins.

    Raises
    ------
    ImportError
        without Gymnasium.
    """
    registration = import_extra("gymnasium.envs.registration", "envs", "quell.envs")
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


if find_spec("gymnasium") is not None:
    register()

__dir__ = public_names(__name__)
