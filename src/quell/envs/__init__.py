"""Environments for Gymnasium: loops whose control signal, or feedforward, a policy gives.

The import registers ``quell/two-mass-v0`` and others with Gymnasium (extra ``envs``); the compiler
is loaded when one of them is made, or ``Env``, ``VectorEnv`` or ``Policy`` is first used.

May import ``simulation`` and what it imports.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING

from quell.lazy import imported_on_use

if TYPE_CHECKING:
    from quell.envs.env import Env, VectorEnv
    from quell.envs.loops import Policy

__all__ = ["Env", "Policy", "VectorEnv", "register"]

__getattr__ = imported_on_use(__name__, {"Env": "env", "Policy": "loops", "VectorEnv": "env"})


def register() -> None:
    """Register the environments of the library as ``quell/…`` with Gymnasium.

    Importing ``quell.envs`` does so, if Gymnasium is installed. Gymnasium imports the module itself
    for ``gymnasium.make("quell.envs:quell/two-mass-v0")``; since version 1.0 it has no plugins.

    Raises
    ------
    ImportError
        without Gymnasium.
    """
    import_module("quell.envs.env").register_all()


if find_spec("gymnasium") is not None:
    register()
