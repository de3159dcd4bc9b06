"""Frames for the page: a JSON header and arrays of float32, little endian.

A frame is the length of the header (4 bytes), the header in UTF-8, spaces up to a multiple of four
bytes, and the arrays one after the other; ``arrays`` in the header has name and length of each.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell.files import nonfinite_to_none
from quell.types import Vector

Indices = NDArray[np.intp]
_LENGTH = struct.Struct("<I")


def frame(header: Mapping[str, Any], arrays: Mapping[str, Any] | None = None) -> bytes:
    """Return a frame; numbers of the header that are not finite become ``null``."""
    parts = {name: np.asarray(part, dtype="<f4").ravel() for name, part in (arrays or {}).items()}
    about = dict(header) | {"arrays": [[name, part.size] for name, part in parts.items()]}
    return _framed(about, b"".join(part.tobytes() for part in parts.values()))


def file_frame(header: Mapping[str, Any], content: bytes) -> bytes:
    """Return a frame with the bytes of a file, in place of arrays."""
    return _framed(dict(header) | {"arrays": [], "bytes": len(content)}, content)


def _framed(header: dict[str, Any], content: bytes) -> bytes:
    text = json.dumps(nonfinite_to_none(header), allow_nan=False).encode()
    text += b" " * (-(len(text) + _LENGTH.size) % 4)
    return _LENGTH.pack(len(text)) + text + content


def parsed(data: bytes) -> tuple[dict[str, Any], dict[str, Vector], bytes]:
    """Return header, arrays and the bytes behind them of a frame; what the page does, in Python."""
    (length,) = _LENGTH.unpack_from(data)
    at = _LENGTH.size + length
    header = json.loads(data[_LENGTH.size : at])
    arrays = {}
    for name, size in header["arrays"]:
        arrays[name] = np.frombuffer(data, dtype="<f4", count=size, offset=at).astype(np.float64)
        at += 4 * size
    return header, arrays, data[at:]


class Columns:
    """Columns of pixels for ``samples`` samples: two points each, at its extrema.

    A curve drawn through these points covers the same pixels as one through all samples, because a
    column shows the range of the values in it.
    """

    def __init__(self, samples: int, columns: int) -> None:
        self.all = samples <= 2 * columns
        edges = np.linspace(0, samples, min(columns, samples) + 1).astype(np.intp)
        self._first = edges[:-1]
        self._places = np.stack([edges[:-1], (edges[:-1] + edges[1:]) // 2], axis=1).ravel()

    def times(self, t: Vector) -> Vector:
        """Return the times of the points."""
        return t if self.all else t[self._places]

    def points(self, values: Vector) -> Vector:
        """Return two points for each column; the extremum that is first in time stands first."""
        if self.all:
            return values
        low = np.minimum.reduceat(values, self._first)
        high = np.maximum.reduceat(values, self._first)
        last = np.append(self._first[1:], values.size) - 1
        rising = values[last] >= values[self._first]
        pairs = np.where(rising[:, None], np.stack([low, high], 1), np.stack([high, low], 1))
        return pairs.ravel()

    def low(self, values: Vector) -> Vector:
        """Return the least value of each column, twice."""
        return values if self.all else np.repeat(np.minimum.reduceat(values, self._first), 2)

    def high(self, values: Vector) -> Vector:
        """Return the largest value of each column, twice."""
        return values if self.all else np.repeat(np.maximum.reduceat(values, self._first), 2)
