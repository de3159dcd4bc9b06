"""Many cases in one test, where a case takes a millisecond: pytest spends more on a test of its own."""

from __future__ import annotations

import copy
import functools
import inspect
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest


def cases(names: str | Iterable[str], values: Iterable[Any], ids: Any = None) -> Any:
    """Run a test for each of the values, as ``pytest.mark.parametrize`` does, but as one test.

    All cases run, also behind one that fails. The error of the first one that fails is shown, with
    the names of all that fail. Each case has a generator ``rng`` and a folder ``tmp_path`` of its
    own, and what it changes by ``monkeypatch`` is undone; other fixtures are shared.
    """
    given = [*names.replace(",", " ").split()] if isinstance(names, str) else [*names]
    single = isinstance(names, str) and len(given) == 1
    values = [*values]
    if all(hasattr(value, "marks") for value in values):  # pytest.param(…, id=…)
        assert not any(value.marks for value in values), "cases can't be marked: parametrize"
        ids, values = [value.id for value in values], [value.values for value in values]
        single = False
    rows = [(value,) if single else tuple(value) for value in values]
    if callable(ids):
        labels = ["-".join(str(ids(value)) for value in row) for row in rows]
    else:
        labels = (
            [*map(str, ids)] if ids is not None else [_label(i, row) for i, row in enumerate(rows)]
        )

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(test)
        def looped(*args: Any, **fixtures: Any) -> None:
            failed: list[tuple[str, Exception]] = []
            skipped: list[BaseException] = []
            for i, (label, row) in enumerate(zip(labels, rows, strict=True)):
                own = {name: _own(value, i) for name, value in fixtures.items()}
                try:
                    test(*args, **own, **dict(zip(given, row, strict=True)))
                except pytest.skip.Exception as reason:
                    skipped.append(reason)
                except (Exception, pytest.fail.Exception) as error:
                    failed.append((label, error))
                finally:
                    if "monkeypatch" in fixtures:
                        fixtures["monkeypatch"].undo()
            if failed:
                label, error = failed[0]
                error.add_note(
                    f"This is the case {label}. {len(failed)} of {len(rows)} cases fail: "
                    f"{', '.join(label for label, _ in failed)}"
                )
                raise error
            if skipped and len(skipped) == len(rows):
                raise skipped[0]

        signature = inspect.signature(test)
        left = [each for name, each in signature.parameters.items() if name not in given]
        looped.__signature__ = signature.replace(parameters=left)  # type: ignore[attr-defined]
        return looped

    return decorate


def _own(fixture: Any, number: int) -> Any:
    """Return what a case gets of a fixture."""
    if isinstance(fixture, np.random.Generator):
        return copy.deepcopy(fixture)
    if isinstance(fixture, Path):
        folder = fixture / f"case{number}"
        folder.mkdir()
        return folder
    if isinstance(fixture, pytest.CaptureFixture):
        fixture.readouterr()
    return fixture


def _label(number: int, row: tuple[Any, ...]) -> str:
    """Return the name of a case: its numbers and texts, else its position."""
    plain = [str(value) for value in row if isinstance(value, str | int | float)]
    return "-".join(plain) if plain else str(number)
