"""The package ``nidaqmx``, and its errors in one line with a remedy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from quell.optional import import_extra

# Error codes of NIDAQmx.h with their remedies: wrong arguments, then failures of the hardware.
_ARGUMENTS = {
    -200220: "for the cards present see NI MAX, or nidaqmx.system.System.local().devices",
    -200170: "counters have names like Dev1/ctr0, outputs Dev2/ao0, digital lines Dev2/port0/line0",
    -200077: "take limits within the range of this card's output",
    -200662: "this card has none (X Series and some cDAQ chassis have one): "
    "give a digital line as heartbeat to a relay instead",
}
_HARDWARE = {
    -50103: "another program uses the card: close it",
    -201003: "the card does not answer: check that it is plugged in and on",
    -200324: "the card is gone",
    -200045: "the card was removed",
    -200678: "the card's watchdog has set the output to zero because the loop was late; "
    "reset the card in NI MAX before the next run",
}


def driver() -> Any:
    """Return the package ``nidaqmx`` with the modules that are used here."""
    for module in ("constants", "stream_readers", "stream_writers", "system.watchdog", "types"):
        import_extra(f"nidaqmx.{module}", "ni", "a card of NI")
    return import_extra("nidaqmx", "ni", "a card of NI")


@contextmanager
def translated_errors(context: str) -> Iterator[None]:
    """Turn an error of the driver into an error with one line, which begins with ``context``.

    It is a ``ValueError`` for arguments that are wrong for these cards, else an ``OSError``.
    """
    from nidaqmx import errors

    missing = (
        errors.DaqNotFoundError,
        errors.DaqNotSupportedError,
        errors.DaqFunctionNotSupportedError,
    )
    try:
        yield
    except missing as error:
        raise OSError(
            f"{context}: {_in_one_line(error)} The driver is not part of the Python package: "
            "python -m nidaqmx installdriver, or ni.com/downloads"
        ) from None
    except errors.DaqError as error:
        code, text = error.error_code, f"{context}: {_in_one_line(error)}"
        if code in _ARGUMENTS:
            raise ValueError(f"{text}: {_ARGUMENTS[code]}") from None
        raise OSError(f"{text}: {_HARDWARE[code]}" if code in _HARDWARE else text) from None


def _in_one_line(error: Exception) -> str:
    return "; ".join(part.strip().rstrip(".") for part in str(error).splitlines() if part.strip())
