"""``quell setup``: checks setup files, and prints their JSON Schema."""

from __future__ import annotations

import json
from pathlib import Path

from quell.cli.options import Switch, Trust, refuse


def setup(files: list[Path] | None = None, *, schema: Switch = False, trust: Trust = False) -> None:
    """Check setup files, or print the JSON Schema by which editors complete and check them.

    A file that can be used is named with what is in it; otherwise each mistake has a line and the
    exit code is 2. Nothing is simulated.

    Parameters
    ----------
    files
        Setup files, in TOML, of one axis or several.
    schema
        Print the JSON Schema (draft 7) of setup files, and do no more.
    """
    from quell.setup import SetupError, made, read

    if schema:
        unused = {"files": (files, None), "trust": (trust, False)}
        refuse(unused, "has no effect beside --schema, which only prints")
        from quell.setup.json_schema import json_schema

        print(json.dumps(json_schema(), indent=1, allow_nan=False, ensure_ascii=False))
        return
    if not files:
        raise ValueError("files: missing; give setup files to check, or --schema")
    mistakes: list[str] = []
    for file in files:
        try:
            name, data = read(file)
            found = made(name, data, trust)
        except SetupError as error:
            mistakes += error.mistakes
        else:
            print(f"{file}: a setup, with {', '.join(found.tables())}")
    if mistakes:
        raise SetupError(mistakes)
