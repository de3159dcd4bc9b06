"""Tasks that messages of the page ask for: iterators of frames that run in a thread."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from quell.studio.designs import band_frames, compared_frames, tuned_frames
from quell.studio.downloads import exported
from quell.studio.frames import file_frame, frame
from quell.studio.messages import Granted, columns, setup_tables
from quell.studio.records import PageRecord, record_frames
from quell.studio.runs import Maker, delay_beside, run_frames
from quell.studio.texts import python_of, tables_of_text, toml_of

LONG = ("compare", "tune", "export", "record")
"""Tasks that take seconds: they have a thread of their own, so that sliders go on moving."""


def frames_for(
    message: Mapping[str, Any],
    make: Maker,
    granted: Granted,
    record: PageRecord,
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
    if task == "record":
        yield from record_frames(record, message, stale, report)
        return
    tables = setup_tables(message, granted)
    setup = make(tables)
    if task == "run":
        yield from run_frames(setup, columns(message), about, stale, make.warnings)
    elif task == "band":
        yield from band_frames(setup, tables, message, stale)
    elif task in ("compare", "tune"):
        work = compared_frames if task == "compare" else tuned_frames
        yield from work(setup, record, message, stale, report)
        yield frame({"kind": "done", **about})
    elif task == "export":
        name, content = exported(setup, message)
        yield file_frame({"kind": "file", "name": name, **about}, content)
    else:
        is_whole = not hasattr(setup.plant, "linear")
        script = python_of(tables, setup.title, is_whole, delay_beside(setup))
        yield frame({"kind": "texts", "toml": toml_of(tables), "python": script, **about})
