"""What NI-DAQmx says went wrong, in one line that says what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from quell.optional import import_extra

# Codes of NIDAQmx.h: those of a wrong argument, and what mends each; then those of the world outside.
_ARGUMENTS = {
    -200220: "the names of the cards that are there: NI MAX, or nidaqmx.system.System.local().devices",
    -200170: "counters are called like Dev1/ctr0, analog outputs Dev2/ao0, digital lines Dev2/port0/line0",
    -200077: "take limits within the range of this card's output",
    -200662: "this card has none (X Series and some cDAQ chassis have one): give a line as heartbeat to a relay instead",
}
_WORLD = {
    -50103: "another program holds the card: close it",
    -201003: "the card does not answer: is it plugged in, is it on?",
    -200324: "the card is gone",
    -200045: "the card was removed",
    -200678: "the card's watchdog has set the output to zero, the loop came too late; reset the card in NI MAX before the next run",
}


def driver() -> Any:
    """Return the package ``nidaqmx``.

    Raises
    ------
    ImportError
        where it is not installed.
    """
    for module in ("constants", "stream_readers", "stream_writers", "system.watchdog", "types"):
        import_extra(f"nidaqmx.{module}", "ni", "a card of NI")
    return import_extra("nidaqmx", "ni", "a card of NI")


@contextmanager
def said(what: str) -> Iterator[None]:
    """Turn what the driver raises into one line that begins with ``what``.

    Raises
    ------
    ValueError
        where an argument is wrong for these cards.
    OSError
        where there is no driver, or a card does not do as it is told.
    """
    from nidaqmx import errors

    try:
        yield
    except (
        errors.DaqNotFoundError,
        errors.DaqNotSupportedError,
        errors.DaqFunctionNotSupportedError,
    ) as error:
        raise OSError(
            f"{what}: {_line(error)} The driver is not part of the Python package: python -m nidaqmx installdriver, or ni.com/downloads"
        ) from None
    except errors.DaqError as error:
        code = error.error_code
        if code in _ARGUMENTS:
            raise ValueError(f"{what}: {_line(error)}: {_ARGUMENTS[code]}") from None
        remedy = f": {_WORLD[code]}" if code in _WORLD else ""
        raise OSError(f"{what}: {_line(error)}{remedy}") from None


def _line(error: Exception) -> str:
    """Return the driver's paragraphs in one line."""
    return "; ".join(line.strip().rstrip(".") for line in str(error).splitlines() if line.strip())
