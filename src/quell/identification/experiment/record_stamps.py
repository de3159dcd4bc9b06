"""Times of a record that are dates or times of day."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date

import numpy as np

from quell.types import Vector

_DATE = (
    r"(?P<iso>(?P<Y>\d{4})(?P<a>[-/.])(?P<M>\d{1,2})(?P=a)(?P<D>\d{1,2}))"
    r"|(?P<mixed>(?P<p>\d{1,2})(?P<b>[-/.])(?P<q>\d{1,2})(?P=b)(?P<z>\d{4}|\d{2}))"
    r"|(?P<named>(?P<d>\d{1,2})[- ](?P<m>[A-Za-z]{3})[- ](?P<y>\d{4}))"
)
_CLOCK = (
    r"(?P<first>\d{1,3}):(?P<second>\d{2})(?::(?P<third>\d{2}))?(?:[.,:](?P<part>\d+))?"
    r"(?:\s*(?P<half>[AaPp])\.?[Mm]\.?)?"
)
_ZONE = r"(?:\s*(?:(?P<utc>Z|UTC|GMT)|(?P<sign>[+-])(?P<zh>\d{2}):?(?P<zm>\d{2})))?"
_STAMP = re.compile(rf"(?:{_DATE})?(?:(?:^|[T ,]\s*){_CLOCK}{_ZONE})?")
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_DAY = 86400.0


def is_stamp(text: str) -> bool:
    """Return whether a text is a date, a time of day, or both."""
    return bool(text) and _STAMP.fullmatch(text) is not None


class Stamps:
    """Reader of one column of stamps: seconds since the midnight before its first one.

    A stamp is an ISO 8601 date and time, day.month.year, day-Mon-year, a date with slashes, a time
    of day, or a date or a time alone; fractions of seconds have a point or a comma. Which part of a
    date with slashes or dashes is the day is taken from the column's first lines, ``cells``.
    """

    def __init__(self, cells: Sequence[str]) -> None:
        self.day_first = _day_first(cells)
        self.start: int | None = None  # the first day
        self.seen: str | None = None  # a date of which day and month are not told apart
        self.dated = False

    def seconds(self, text: str) -> float:
        """Return a stamp in seconds; raise a ``ValueError`` with the rule that it breaks."""
        found = _STAMP.fullmatch(text)
        if found is None or not text:
            raise ValueError("must be a date or a time of day, as the first ones are")
        day = self._day(found)
        if self.start is None:
            self.start, self.dated = day or 0, day is not None
        if (day is not None) != self.dated:
            raise ValueError("must have a date, as the first one" if self.dated else "has a date")
        return _DAY * ((day or 0) - self.start) + _second_of_day(found, self.dated)

    def _day(self, found: re.Match[str]) -> int | None:
        if found["iso"]:
            parts = int(found["Y"]), int(found["M"]), int(found["D"])
        elif found["named"]:
            if found["m"].lower() not in _MONTHS:
                raise ValueError("has no month in English, Jan to Dec")
            parts = int(found["y"]), _MONTHS.index(found["m"].lower()) + 1, int(found["d"])
        elif found["mixed"]:
            year = int(found["z"]) + (2000 if len(found["z"]) == 2 else 0)
            pair = int(found["p"]), int(found["q"])
            first = True if found["b"] == "." else self.day_first
            if first is None:
                if self.seen not in (None, found["mixed"]):
                    raise ValueError("day and month can't be told apart; write 2024-05-31")
                self.seen = found["mixed"]
            parts = year, *(pair if first is False else pair[::-1])
        else:
            return None
        try:
            return date(*parts).toordinal()
        except ValueError:
            raise ValueError("is no date") from None


def unwrapped(seconds: Vector) -> Vector:
    """Return times of day that rise over midnight."""
    days = np.cumsum(np.diff(seconds, prepend=seconds[:1]) < -0.5 * _DAY)
    return np.asarray(seconds + _DAY * days)


def _day_first(cells: Sequence[str]) -> bool | None:
    """Return whether dates begin with the day, or with the month; None if nothing tells."""
    pairs = [
        (int(found["p"]), int(found["q"]))
        for found in map(_STAMP.fullmatch, cells)
        if found is not None and found["mixed"]
    ]
    if any(p > 12 for p, _ in pairs):
        return True
    if any(q > 12 for _, q in pairs):
        return False
    return None


def _second_of_day(found: re.Match[str], dated: bool) -> float:
    """Return the time of day [s], in the zone UTC if a zone is given."""
    if found["first"] is None:
        return 0.0
    first, second = int(found["first"]), int(found["second"])
    part = float(f"0.{found['part'] or 0}")
    if found["third"] is not None:
        hours, minutes, seconds = first, second, int(found["third"])
    elif found["part"] is not None and not dated:  # as spreadsheets write minutes
        hours, minutes, seconds = 0, first, second
    elif dated or found["half"]:
        hours, minutes, seconds = first, second, 0
    else:
        raise ValueError("may be hours:minutes or minutes:seconds; write hours:minutes:seconds")
    if found["half"]:
        if not 1 <= hours <= 12:
            raise ValueError("is no time of day")
        hours = hours % 12 + (12 if found["half"].lower() == "p" else 0)
    if (minutes > 59 and found["third"] is not None) or seconds > 60 or (dated and hours > 24):
        raise ValueError("is no time of day")
    offset = 0
    if found["sign"]:
        offset = int(f"{found['sign']}1") * (3600 * int(found["zh"]) + 60 * int(found["zm"]))
    return 3600.0 * hours + 60.0 * minutes + seconds + part - offset
