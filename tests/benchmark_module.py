"""The scripts of ``benchmarks`` as modules: a test runs the short version of a trial."""

from __future__ import annotations

import importlib.util
import sys
from functools import cache
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@cache
def benchmark(name: str) -> Any:
    """Return the module of a script, by its name without suffix."""
    if str(BENCHMARKS) not in sys.path:  # scripts import each other by name
        sys.path.append(str(BENCHMARKS))
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module
