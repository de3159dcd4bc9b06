"""Frames on a stream of bytes: consistent overhead byte stuffing (COBS).

A zero byte ends each packet, and no byte inside a packet is zero. A receiver that joins late, or
has lost or gained bytes, is synchronised again at the next zero. A packet is a sequence of blocks:
a code n, 1 … 255, followed by n − 1 non-zero bytes. The block stands for these bytes followed by a
zero; there is no zero after the last block and after blocks with n = 255. Up to 254 bytes become
one byte more, two with the final zero.

Source: S. Cheshire, M. Baker: Consistent Overhead Byte Stuffing. IEEE/ACM Transactions on
Networking 7 (1999) 159-172, section III.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import kernel

INVALID = -1  # returned by ``decode`` for bytes that are not a packet
# The largest code; its block has no zero after it (section III of the source).
_LONGEST = 255


@kernel
def encode(data: NDArray[np.uint8], size: int, out: NDArray[np.uint8]) -> int:
    """Write the packet of ``size`` bytes with its final zero to ``out``; return its length.

    ``out`` needs room for size + size // 254 + 2 bytes.
    """
    code_at, length = 0, 1
    for i in range(size):
        if data[i] != 0:
            out[length] = data[i]
            length += 1
        if data[i] == 0 or (length - code_at == _LONGEST and i < size - 1):
            out[code_at] = length - code_at
            code_at = length
            length += 1
    out[code_at] = length - code_at
    out[length] = 0
    return length + 1


@kernel
def decode(packet: NDArray[np.uint8], size: int, out: NDArray[np.uint8]) -> int:
    """Decode a packet of ``size`` bytes, without its final zero, to ``out``; return the length.

    Return ``INVALID`` if a block reaches beyond the end or a byte is zero.
    """
    i, length = 0, 0
    while i < size:
        code = int(packet[i])
        if code == 0 or i + code > size:
            return INVALID
        for j in range(i + 1, i + code):
            if packet[j] == 0:
                return INVALID
            out[length] = packet[j]
            length += 1
        i += code
        if code < _LONGEST and i < size:
            out[length] = 0
            length += 1
    return length
