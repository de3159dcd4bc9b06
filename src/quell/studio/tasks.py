"""What a message of the page asks for, as an iterator of frames that runs in a thread."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from quell.plants.linear_part import linear_model
from quell.studio.designs import band_frames, compared_frames, tuned_frames
from quell.studio.downloads import exported
from quell.studio.frames import file_frame, frame
from quell.studio.messages import Granted, columns, setup_tables
from quell.studio.runs import Maker, run_frames
from quell.studio.texts import python_of, tables_of_text, toml_of

LONG = ("compare", "tune", "export")
"""Tasks that take seconds: they have a thread of their own, so that sliders go on moving."""


def frames_for(
    message: Mapping[str, Any],
    make: Maker,
    granted: Granted,
    stale: Callable[[], bool],
    report: Callable[[str, float], None],
) -> Iterator[bytes]:
    """Yield the frames that answer a message of ``messages.parsed``.

    Raises
    ------
    ValueError
        for a message that asks for what cannot be.
    StoppedError
        if ``stale`` returns that nobody waits any more.
    """
    task, about = message["do"], {"id": message["id"]}
    if task == "open":
        tables = tables_of_text(message.get("text"), granted)
        make(tables)
        yield frame({"kind": "opened", "setup": tables, **about})
        return
    tables = setup_tables(message, granted)
    setup = make(tables)
    if task == "run":
        yield from run_frames(setup, columns(message), about, stale, make.warnings)
    elif task == "band":
        yield from band_frames(setup, tables, message, stale)
    elif task in ("compare", "tune"):
        work = compared_frames if task == "compare" else tuned_frames
        yield from work(setup, message, stale, report)
        yield frame({"kind": "done", **about})
    elif task == "export":
        name, content = exported(setup, message)
        yield file_frame({"kind": "file", "name": name, **about}, content)
    else:
        linear = linear_model(setup.plant) is setup.plant
        delay = setup.controller.dt * int(getattr(setup.plant, "late", 0) or 0)
        script = python_of(tables, setup.title, linear, delay)
        yield frame({"kind": "texts", "toml": toml_of(tables), "python": script, **about})
