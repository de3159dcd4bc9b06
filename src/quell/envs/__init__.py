"""Environments for Gymnasium: loops whose control signal, or feedforward, a policy gives.

The import registers ``quell/two-mass-v0`` and others with Gymnasium (extra ``envs``); the compiler
is loaded when one of them is made, or ``Env``, ``VectorEnv`` or ``Policy`` is first used.

May import ``simulation`` and what it imports.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quell.envs.env import Env, VectorEnv
    from quell.envs.loops import Policy

__all__ = ["Env", "Policy", "VectorEnv", "register"]

_HOME = {"Env": "env", "Policy": "loops", "VectorEnv": "env"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'quell.envs' has no attribute {name!r}")
    return getattr(import_module(f"quell.envs.{_HOME[name]}"), name)


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
