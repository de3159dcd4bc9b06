"""Frames on a stream of bytes: consistent overhead byte stuffing.

A byte that is zero ends each packet, and no byte inside of one is zero: a receiver that joins late, or has missed or invented bytes, is in
step again at the next zero. A packet is a sequence of blocks; each is a code n, 1 … 255, and n − 1 bytes that are not zero, and stands for
these bytes and, but for n = 255 and for the last one, a zero behind them. n ≤ 254 bytes become n + 1, and n + 2 with the zero at the end.

Source: S. Cheshire, M. Baker: Consistent Overhead Byte Stuffing. IEEE/ACM Transactions on Networking 7 (1999) 159-172, section III.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import kernel

# What ``decode`` returns for bytes that are no packet.
INVALID = -1
_LONGEST = 255


@kernel
def encode(data: NDArray[np.uint8], size: int, out: NDArray[np.uint8]) -> int:
    """Write the packet for the first ``size`` bytes into ``out``, the zero at its end included; return its length.

    ``out`` has room for size + size // 254 + 2 bytes.
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
    """Write what a packet of ``size`` bytes, without the zero at its end, stands for into ``out``; return how many bytes that is.

    ``BROKEN`` where it is no packet: a block reaches beyond the end, or a byte is zero.
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
