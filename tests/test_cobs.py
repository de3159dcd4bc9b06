"""Packets on a stream of bytes."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from quell.realtime import transports, wire
from quell.realtime.transports import FRAME_BITS

from .cases import cases


def encoded(data):
    """What ``cobs`` makes of bytes."""
    out = np.zeros(len(data) + len(data) // 254 + 2, dtype=np.uint8)
    return out[: transports.encode(np.frombuffer(data, dtype=np.uint8), len(data), out)].tobytes()


def decoded(packet):
    """What it makes of a packet without its zero; None where that is none."""
    out = np.zeros(len(packet) + 1, dtype=np.uint8)
    size = transports.decode(np.frombuffer(packet, dtype=np.uint8), len(packet), out)
    return None if size == transports.INVALID else out[:size].tobytes()


def plainly_decoded(packet):
    """The same, written as the paper explains it."""
    data = b""
    while packet:
        code, packet = packet[0], packet[1:]
        block, packet = packet[: code - 1], packet[code - 1 :]
        data += block + (b"\0" if code < 255 and packet else b"")
    return data


@cases(
    ("data", "packet"),
    [
        # The head of an IP packet, as in figure 3 of Cheshire and Baker.
        ("45 00 00 2c 4c 79 00 00 40 06 4f 37", "02 45 01 04 2c 4c 79 01 05 40 06 4f 37"),
        ("", "01"),
        ("00", "01 01"),
        ("00 00", "01 01 01"),
        ("11 22 00 33", "03 11 22 02 33"),
        ("11 22 33 44", "05 11 22 33 44"),
        ("11 00 00 00", "02 11 01 01 01"),
    ],
)
def test_packets_are_those_of_cheshire_and_baker(data, packet):
    """Code by code, with the zero that ends them."""
    assert encoded(bytes.fromhex(data)) == bytes.fromhex(packet) + b"\0"


def test_a_run_of_254_bytes_has_a_code_of_its_own():
    """255 stands for 254 bytes without a zero behind them, whatever follows."""
    run = bytes(range(1, 255))
    assert encoded(run) == b"\xff" + run + b"\0"
    assert encoded(run + b"\0") == b"\xff" + run + b"\1\1\0"
    assert encoded(b"\0" + run) == b"\1\xff" + run + b"\0"
    assert encoded(run + b"\xff") == b"\xff" + run + b"\2\xff\0"


@given(
    st.one_of(
        st.binary(max_size=600), st.lists(st.sampled_from([0, 1, 255]), max_size=600).map(bytes)
    )
)
def test_what_is_encoded_is_decoded(data):
    """No byte inside is zero, at most one in 254 is added, and a plain decoder agrees."""
    packet = encoded(data)
    assert packet[-1] == 0
    assert 0 not in packet[:-1]
    assert len(packet) <= len(data) + 1 + max(math.ceil(len(data) / 254), 1)
    assert decoded(packet[:-1]) == data == plainly_decoded(packet[:-1])


@given(st.binary(max_size=60))
def test_any_bytes_decode_to_no_more_than_there_are_or_are_refused(packet):
    """Nothing is read or written outside: a block that reaches beyond the end is no packet."""
    found = decoded(packet)
    assert found is None or len(found) <= max(len(packet) - 1, 0)
    if found is not None:
        assert 0 not in packet


def test_a_frame_takes_42_bytes_whatever_is_in_it():
    """The figure by which rates are checked."""
    for fill in (0, 1, 255):
        assert len(encoded(bytes([fill]) * wire.LENGTH)) * 10 == FRAME_BITS
