"""Frames with a tag: hostile packets, and what a tag costs.

    python benchmarks/authenticated_frames.py [--count 1000000] [--seed 1]

A device that waits for the commands of a session gets packets of those who do not know the key:
bits at random, frames with tags at random, recorded packets with bits changed, and packets of a
former session. None may be taken. Then the time to receive a packet with a tag beside one without,
from memory, by compiled code.
"""

from __future__ import annotations

import sys
import time
from typing import Any, NamedTuple

import numpy as np
from measured import options_of, parser_of, write
from numpy.typing import NDArray

from quell.kernels.dispatch import compiled, specialised
from quell.realtime import wire
from quell.realtime.authenticated import authenticated

PACKET = wire.LENGTH + 8


class Stored(NamedTuple):
    """A transport that reads packets from memory, and keeps the last one that was sent."""

    packets: NDArray[np.uint8]
    state: NDArray[np.int64]  # place of the next packet, how many there are, bytes of each (3,)
    sent: NDArray[np.uint8]  # (48,)


@wire.receive.register(Stored)
def _receive(stored: Stored, frame: wire.Buffer) -> int:
    state, size = stored.state, stored.state[2]
    if state[0] >= state[1]:
        return -1
    for i in range(size):
        frame.bytes[i] = stored.packets[state[0] * size + i]
    state[0] += 1
    return int(size)


@wire.send.register(Stored)
def _send(stored: Stored, frame: wire.Buffer) -> int:
    for i in range(frame.length[0]):
        stored.sent[i] = frame.bytes[i]
    return 0


@compiled
def take_all(transport: Any, frame: wire.Buffer, most: int) -> int:
    """Receive packets until there is none; return how many frames were taken."""
    taken = 0
    for _ in range(most):
        taken += 1 if wire.receive(transport, frame) > 0 else 0
    return taken


def stored(packets: NDArray[np.uint8]) -> Stored:
    """Return a transport with packets (n, bytes)."""
    state = np.array([0, len(packets), packets.shape[1] if packets.size else PACKET])
    return Stored(packets.ravel().copy(), state, np.zeros(PACKET, dtype=np.uint8))


def plain(kind: int, session: int, number: int) -> wire.Buffer:
    """Return a frame to send."""
    out = wire.buffer()
    wire.write_frame(out, kind, session, number, 0, 0, 0.25, 0)
    return out


def opened(key: NDArray[np.uint64], session: int) -> tuple[Any, Any, list[NDArray[np.uint8]]]:
    """Return both ends after a handshake, and the loop's packets until then."""
    empty = np.zeros((0, PACKET), dtype=np.uint8)
    loop = authenticated(stored(empty), key, is_device=False)
    device = authenticated(stored(empty), key, is_device=True)
    seen = []
    for _ in range(2):
        wire.send(loop, plain(wire.HELLO, session, 0))
        seen.append(loop.inner.sent.copy())
        device = device._replace(inner=stored(seen[-1][None]))
        wire.receive(device, wire.buffer())
        loop = loop._replace(inner=stored(device.inner.sent[None]))
        wire.receive(loop, wire.buffer())
    return loop, device, seen


def commands(loop: Any, session: int, count: int) -> NDArray[np.uint8]:
    """Return so many packets with commands."""
    found = np.zeros((count, PACKET), dtype=np.uint8)
    for i in range(count):
        wire.send(loop, plain(wire.COMMAND, session, i + 1))
        found[i] = loop.inner.sent
    return found


def hostile(
    rng: np.random.Generator, count: int, session: int, good: NDArray[np.uint8], old: Any
) -> NDArray[np.uint8]:
    """Return packets of those who do not know the key, drawn from four kinds."""
    bits = rng.integers(0, 256, (count, PACKET), dtype=np.uint8)
    which = rng.integers(0, 4, count)
    recorded = good[rng.integers(0, len(good), count)]
    tagged = recorded.copy()
    tagged[:, wire.LENGTH :] = bits[:, wire.LENGTH :]
    changed = recorded.copy()
    rows, places = np.arange(count), rng.integers(0, 8 * PACKET, count)
    changed[rows, places // 8] ^= (1 << (places % 8)).astype(np.uint8)
    former = old[rng.integers(0, len(old), count)]
    return np.choose(which[:, None], [bits, tagged, changed, former])


def main() -> None:
    """Send hostile packets, and measure."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    options = options_of(parser, count=2000)
    rng = np.random.default_rng(options.seed)
    key = rng.integers(0, 2**64, 2, dtype=np.uint64)
    session = 0x5EED0001
    former, _, first = opened(key, session)
    old = np.vstack([*(each[None] for each in first[1:]), commands(former, session, 50)])
    loop, device, _ = opened(key, session)  # the same session again: the nonce is another one
    good = commands(loop, session, 200)
    taken = 0
    frame = wire.buffer()
    for part in range(0, options.count, 100_000):
        count = min(100_000, options.count - part)
        packets = hostile(rng, count, session, good, old)
        here = device._replace(inner=stored(packets))
        taken += specialised(take_all, here, frame, count)(here, frame, count)
    here = device._replace(inner=stored(good))
    heard = specialised(take_all, here, frame, len(good))(here, frame, len(good))
    print(f"{options.count} hostile packets: {taken} taken; of {len(good)} good ones {heard}")
    seconds = []
    repeated = np.tile(good, (100, 1))
    for transport in (
        device._replace(inner=stored(repeated)),
        stored(np.ascontiguousarray(repeated[:, : wire.LENGTH])),
    ):
        inner = getattr(transport, "inner", transport)
        run = specialised(take_all, transport, frame, len(repeated))
        least = np.inf
        for _ in range(5):
            inner.state[0] = 0
            begin = time.process_time()
            run(transport, frame, len(repeated))
            least = min(least, time.process_time() - begin)
        seconds.append(least / len(repeated))
    cost = 1e6 * (seconds[0] - seconds[1])
    print(f"receiving a packet with a tag takes {cost:.2f} us more than one without")
    write(options, {"hostile": options.count, "taken": taken, "heard": heard, "cost us": cost})
    sys.exit(1 if taken or heard != len(good) or cost > 3.0 else 0)


if __name__ == "__main__":
    main()
