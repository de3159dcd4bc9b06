"""What the package does without being asked: nothing on the network, no processes, no unpickling."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

import quell

from .commands import run_python

ROOT = Path(quell.__file__).parent
# Modules that run code which data holds.
UNPICKLERS = {"pickle", "_pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"}
AUDIT = """
import importlib, json, pkgutil, sys
seen = []
WATCHED = ("socket.", "subprocess.", "pickle.", "urllib.", "http.", "ftplib.", "smtplib.", "shutil.",
    "os.system", "os.exec", "os.fork", "os.posix_spawn", "os.spawn", "os.remove", "os.rename", "winreg.")
sys.addaudithook(lambda event, _: event.startswith(WATCHED) and seen.append(event))
import quell
for module in pkgutil.walk_packages(quell.__path__, "quell."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
during, seen[:] = list(seen), []
import pickle, socket, subprocess
pickle.loads(pickle.dumps(len))
socket.socket().close()
subprocess.run([sys.executable, "-c", ""])
print(json.dumps([during, sorted(set(seen))]))
"""


@pytest.mark.trial
def test_importing_every_module_touches_no_network_and_starts_or_unpickles_nothing() -> None:
    """In a fresh interpreter, as Python itself reports it; the same hook sees each of these."""
    done = run_python(AUDIT, timeout=120)
    during, control = json.loads(done.stdout)
    assert during == []
    assert {"pickle.find_class", "socket.__new__", "subprocess.Popen"} <= set(control)


@pytest.mark.trial
def test_no_module_can_unpickle_data() -> None:
    """None imports what could, and numpy's and torch's loaders are not used."""
    found = []
    for file in ROOT.rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        if not any(word in text for word in (*UNPICKLERS, "allow_pickle", "load")):
            continue
        for node in ast.walk(ast.parse(text)):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [alias.name.partition(".")[0] for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [(node.module or "").partition(".")[0]]
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                loads = node.attr in ("load", "loads") and node.value.id in ("np", "numpy", "torch")
                names = ["pickle"] if loads else []
            elif isinstance(node, ast.keyword):
                names = ["pickle"] if node.arg == "allow_pickle" else []
            if UNPICKLERS & set(names):
                found.append(f"{file.relative_to(ROOT)}:{node.lineno}")
    assert not found


def test_a_pickle_is_no_file_of_quell_s(tmp_path: Path) -> None:
    """It is refused by every reader, and not run."""
    import pickle

    class Trap:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return exec, ("raise SystemExit('unpickled')",)

    path = tmp_path / "run.nc"
    path.write_bytes(pickle.dumps(Trap()))
    for read in (quell.Trajectory.load, quell.realtime.load, quell.setup.load):
        with pytest.raises(ValueError):
            read(path)
