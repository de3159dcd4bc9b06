"""The memory image of a controller: its state as bytes that outlive the process and the target.

An image has the whole running state of a controller. It is the same in Python (``memory`` and
``restore`` of a controller) and in exported C (``NAME_save`` and ``NAME_load``), for a controller
of the same layout and precision. All numbers are little-endian:

========  ==========  =============================================================================
offset    type        content
========  ==========  =============================================================================
0         4 bytes     ``QLLM``
4         uint16      version of the format, 1
6         uint16      bytes of a number: 8 in double precision, 4 in single
8         uint32      bytes of the image
12        int32       encoder count from which positions are counted (``NAME_step_counts``), or 0
16        uint64      hash of the layout
24        uint64      hash of the design
32        numbers     the state: each array in order of the state's fields, its entries row by row
at end    uint64      check of all that is before it
========  ==========  =============================================================================

*Layout*: what the numbers need so that they mean the same. Names and shapes of the arrays, kinds
of controller, learner and guard, dt, b0 (of several axes B0, of a function its name), the model's
coefficients a, names and order of the axes, and those parameters of the learner that
``learners.base.meaning`` returns: its features, scales and orders. Gains may change between
two starts of a machine: omega_o, omega_c, limits, the guard and times of forgetting are not in it.
So a product whose loop is tuned again keeps its map.

*Design*: all parameters but the limits of u. An image continues a running loop only where these are
the same, too. Both hashes are of numbers with 9 digits (6 in single precision), because another
machine may have designed the last ones differently.

*Check*: FNV-1a with 64 bits (Fowler, Noll & Vo, IETF draft-eastlake-fnv) over the 32-bit words in
place of bytes::

    h_0 = 14695981039346656037,    h_(i+1) = (h_i xor w_i) · 1099511628211 mod 2⁶⁴

A step is one-to-one in h and in w, so damage within one word is always found; other damage passes
with a chance of about 2⁻⁶⁴. A CRC of 32 bits would let one of 4·10⁹ damaged images pass, and takes
ten times as long on a Cortex-M4 without a large table.

*Numbers* are finite. What is not finite in a state is saved as zero: in a loop that works it is in
places that are written again before they are read, such as features before their scale is known.
Work space (``Scratch``, ``Work``) is not in an image.

*Meaning of a start*. After the power was off, the plant is not where the state says: the loop
starts from rest, with all that was learned (θ, covariance, maps, frequencies, the guard's account).
The running state is for a process that is replaced between two samples.
"""

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.controllers.allocation import ActuatorLimits
from quell.controllers.base import Limits, reset_loop
from quell.controllers.law import AdrcDesign, AdrcState
from quell.kernels.dispatch import as_python
from quell.kernels.sized import work_fields
from quell.kernels.user_functions import origin_of
from quell.learners.base import meaning

MAGIC, VERSION = b"QLLM", 1
HEADER = struct.Struct("<4sHHIiQQ")
"""Magic, version, bytes of a number, bytes of the image, origin, layout, design."""
CHECK = struct.Struct("<Q")
CHECK_BEGIN, CHECK_FACTOR = 14695981039346656037, 1099511628211
_WORD = 2**64 - 1

# ---- What an image contains ----


class Layout(NamedTuple):
    """The layout of a controller's images.

    Attributes
    ----------
    arrays
        the arrays of its state by name, in the order of the image.
    width
        bytes of a number.
    layout, design
        the two hashes.
    zeros
        numbers of the image that are zero in any image: flags that are set during a call alone.
    before
        the layout of images that were saved when the guard had fewer arrays; None if there is none.
    """

    arrays: dict[str, NDArray[Any]]
    width: int
    layout: int
    design: int
    zeros: tuple[int, ...]
    before: Layout | None = None

    @property
    def numbers(self) -> int:
        """Number of numbers in an image."""
        return sum(array.size for array in self.arrays.values())

    @property
    def size(self) -> int:
        """Bytes of an image."""
        return HEADER.size + self.width * self.numbers + CHECK.size


class Leaf(NamedTuple):
    """An array of a state.

    Attributes
    ----------
    name
        dotted, as images have it.
    path
        fields of NamedTuples, and places in other tuples, that lead to it.
    array
        itself.
    is_work
        whether no later sample reads it.
    """

    name: str
    path: tuple[str | int, ...]
    array: NDArray[Any]
    is_work: bool


# In an image the axes, and the drives below compensators, are pairs of one and those behind it: the
# kind of a pair, what it calls the first one, and the kind of the end.
_PAIRS = {"axes": ("AxisDesigns", "axis", "NoAxis"), "drives": ("Drives", "controller", "NoDrive")}


# Flags that say which parts there are, by the kind of parameters: the parts say it, too. The rates
# of a guard say how many samples its account takes together.
_RESTATED = {
    "GuardDesign": ("every", "spread", "turns"),
    "AdrcDesign": ("guarded", "scheduled", "has_safe_set", "has_held", "has_model", "nonlinear"),
    "AxesDesign": ("learns_of_all", "has_bands", "gain_moves", "takes_controls"),
}


def leaves(state: Any, name: str = "", path: tuple[str | int, ...] = ()) -> Iterator[Leaf]:
    """Yield the arrays of a nested NamedTuple in the order of an image."""
    work = work_fields(type(state))
    for field, part in zip(state._fields, state, strict=True):
        here = (*path, field)
        if not isinstance(part, tuple):
            yield Leaf(f"{name}{field}", here, part, field in work)
        elif hasattr(part, "_fields"):
            yield from leaves(part, f"{name}{field}.", here)
        else:
            behind, first = f"{name}{field}.", _PAIRS.get(field, ("", "", ""))[1]
            for i, each in enumerate(part):
                yield from leaves(each, f"{behind}{first or i}.", (*here, i))
                behind += "others." if first else ""


def named_arrays(state: Any) -> dict[str, NDArray[Any]]:
    """Return the arrays of a nested NamedTuple by dotted name, ``Scalars`` as a vector."""
    return {leaf.name: _as_vector(leaf.array) for leaf in leaves(state)}


def _as_vector(array: NDArray[Any]) -> NDArray[Any]:
    return array if array.dtype.names is None else array.view(array.dtype[0])


def kept_arrays(state: Any) -> dict[str, NDArray[Any]]:
    """Return the arrays of an image: without work space, and each place in memory once."""
    kept: dict[str, NDArray[Any]] = {}
    taken: list[tuple[int, int]] = []
    for leaf in leaves(state):
        begin = leaf.array.__array_interface__["data"][0]
        end = begin + leaf.array.nbytes
        if not leaf.is_work and all(end <= low or begin >= high for low, high in taken):
            kept[leaf.name] = _as_vector(leaf.array)
            if leaf.array.size:
                taken.append((begin, end))
    return kept


# Arrays that came later, in this order. They begin with zeros, and so does an image without them.
_LATER = ("guard.trial", "guard.interval", "guard.suspect")


def images_of(parameters: Any, state: Any, dt: float, names: Sequence[str] = ()) -> Layout:
    """Return the layout of the images of a controller, given by its kernels' parameters.

    ``names`` are those of its axes: an image with the axes in another order is of another one.
    """
    arrays = kept_arrays(state)
    older = {name: each for name, each in arrays.items() if not name.endswith(_LATER)}
    known = _layout_of(older, parameters, state, dt, names)
    for i in range(len(_LATER)):
        kept = {name: each for name, each in arrays.items() if not name.endswith(_LATER[i + 1 :])}
        if len(kept) > len(known.arrays):
            known = _layout_of(kept, parameters, state, dt, names)._replace(before=known)
    return known


def _layout_of(
    arrays: dict[str, NDArray[Any]], parameters: Any, state: Any, dt: float, names: Sequence[str]
) -> Layout:
    """Return the layout of images with some arrays of a state."""
    single = any(array.dtype == np.float32 for array in arrays.values())
    shapes = [(name, array.shape) for name, array in arrays.items()]
    if names:  # behind the last axis was an empty array, which is in the hash
        last = max(i for i, (name, _) in enumerate(shapes) if name.startswith("axes."))
        shapes.insert(last + 1, (f"axes.{'others.' * len(names)}nothing", (0,)))
    digits, width = (6, 4) if single else (9, 8)
    what = _what(parameters), float(dt), tuple(shapes), *names
    layout, design = _hash(what, digits), _hash((what, parameters), digits)
    return Layout(arrays, width, layout, design, _zero_places(state, arrays))


def _what(design: Any) -> Any:
    """Return kinds and parameters without which the numbers of a state mean something else."""
    if isinstance(design, AdrcDesign):
        kinds = (type(design.learner).__name__, type(design.guard).__name__)
        return kinds, meaning(design.learner), design.b0, design.cancel, design.cancel_f
    if hasattr(design, "axes"):  # several axes: what they learn is relative to B0
        together = (meaning(design.learning),) if design.learning else ()
        kind, _, end = _PAIRS["axes"]
        inner: Any = end, "NoneType", ()
        for axis in reversed(design.axes):
            inner = kind, "NoneType", (_what(axis), inner)
        shapers = [
            getattr(each, "prefilter", None) for each in getattr(design.given, "shapers", ())
        ]
        shaped = tuple(type(each).__name__ for each in shapers)
        return type(design).__name__, meaning(design.gain), *together, *shaped, inner
    inner = tuple(_what(each) for each in _inside(design))
    return type(design).__name__, type(getattr(design, "prefilter", None)).__name__, inner


def _inside(whole: Any) -> tuple[Any, ...]:
    """Return the controllers inside of a wrapper or of axes, by their parameters or states."""
    names = ("controller", "compensator")
    inner = tuple(getattr(whole, name) for name in names if hasattr(whole, name))
    return (*inner, *getattr(whole, "axes", ()))


def _adrc_states(state: Any) -> list[AdrcState]:
    """Return the states of the ADRCs and compensators in a state."""
    if isinstance(state, AdrcState):
        return [state]
    return [found for each in _inside(state) for found in _adrc_states(each)]


def _zero_places(state: Any, arrays: dict[str, NDArray[Any]]) -> tuple[int, ...]:
    """Return the numbers of the image that are flags of manual operation."""
    found, at = [], 0
    loops = [each.loop for each in _adrc_states(state)]
    loops += [state.loop] if hasattr(state, "axes") else []
    for array in arrays.values():
        for loop in loops:
            if np.shares_memory(array, loop):
                found.append(at + [*(loop.dtype.names or ())].index("manual"))
        at += array.size
    return tuple(found)


def _hash(value: Any, digits: int) -> int:
    text = _text(value, digits)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


def _text(value: Any, digits: int) -> str:
    """Return numbers, texts, arrays and tuples of them as a text that is the same everywhere."""
    if isinstance(value, Limits | ActuatorLimits):
        return "limits"
    if isinstance(value, np.ndarray):
        entries = ",".join(_text(entry, digits) for entry in value.ravel().tolist())
        return f"{value.shape}[{entries}]"
    if isinstance(value, tuple):
        kind = type(value).__name__ if hasattr(value, "_fields") else ""
        fields = getattr(value, "_fields", range(len(value)))
        left_out = _RESTATED.get(kind, ())
        parts = (
            _text_of_pairs(part, digits, *_PAIRS[field])
            if field in _PAIRS and type(part) is tuple
            else _text(part, digits)
            for field, part in zip(fields, value, strict=True)
            if field not in left_out
        )
        return f"{kind}({','.join(parts)})"
    if isinstance(value, str) or value is None:
        return repr(value)
    if (origin := origin_of(value)) is not None:  # the address of a function of the user
        return repr(origin.c_function or origin.function.__qualname__)
    # 1 and 1.0 are the same number: whether a value is an integer does not survive all ways.
    return f"{float(value) + 0.0:.{digits}g}"


def _text_of_pairs(parts: tuple[Any, ...], digits: int, kind: str, _: str, end: str) -> str:
    text = f"{end}()"
    for part in reversed(parts):
        text = f"{kind}({_text(part, digits)},{text})"
    return text


def check_of(data: bytes) -> int:
    """Return the check of bytes, a multiple of four of them."""
    found = CHECK_BEGIN
    for (word,) in struct.iter_unpack("<I", data):
        found = (found ^ word) * CHECK_FACTOR & _WORD
    return found


# ---- Writing and reading ----


def written_image(known: Layout, origin: int = 0) -> bytes:
    """Return the image of a state, given by the layout of its controller."""
    head = HEADER.pack(MAGIC, VERSION, known.width, known.size, origin, known.layout, known.design)
    kind = "<f4" if known.width == 4 else "<f8"
    parts = [np.asarray(array, dtype=kind) for array in known.arrays.values()]
    finite = (np.where(np.isfinite(part), part, 0.0).astype(kind) for part in parts)
    data = b"".join([head, *(part.tobytes() for part in finite)])
    return data + CHECK.pack(check_of(data))


# An image is tens of kilobytes, seldom megabytes. A file beyond that is something else.
_MOST_BYTES = 100_000_000


def file_content(path: str | os.PathLike[str]) -> bytes:
    """Return the bytes of a file that may be an image; a ``ValueError`` says why there are none."""
    try:
        size = Path(path).stat().st_size
        if size > _MOST_BYTES:
            raise ValueError(f"the file has {size} bytes: it is no memory image of quell")
        return Path(path).read_bytes()
    except OSError as error:
        raise ValueError(f"the file can't be read ({error.strerror or error})") from None


_AS_SAVED = "use the file as it was saved"


def read_image(known: Layout, image: Any, *, running: bool) -> dict[str, NDArray[Any]]:
    """Return the arrays of an image by name, for a controller with the layout ``known``.

    Raises
    ------
    ValueError
        saying what is wrong with the image, and what to do.
    """
    try:
        data = bytes(memoryview(image))
    except TypeError:
        raise ValueError(f"image = {type(image).__name__}: must be bytes from memory()") from None
    least = HEADER.size + CHECK.size
    if len(data) < least or data[:4] != MAGIC:
        raise ValueError(
            f"image of {len(data)} bytes: is no memory image of quell, which begins with QLLM and "
            f"has at least {least} bytes; take bytes from memory() or NAME_save"
        )
    _, version, width, size, origin, layout, design = HEADER.unpack_from(data)
    if version != VERSION:
        raise ValueError(
            f"image has version {version}: this quell reads version {VERSION}; save it again with "
            "this version, or let the controller learn anew"
        )
    if len(data) != size:
        raise ValueError(f"image has {len(data)} bytes, not {size}: it is cut; {_AS_SAVED}")
    if size % 4 or CHECK.unpack(data[-CHECK.size :])[0] != check_of(data[: -CHECK.size]):
        raise ValueError(f"image is damaged: its check is wrong; {_AS_SAVED}")
    if width != known.width:
        names = {4: "single", 8: "double"}
        raise ValueError(
            f"image is in {names.get(width, 'unknown')} precision: must be in "
            f"{names[known.width]}, as the controller is; restore it into one of its own precision"
        )
    arrays = known.arrays
    while known.before is not None and (layout, size) != (known.layout, known.size):
        known = known.before
    missing = {
        name: np.zeros_like(each) for name, each in arrays.items() if name not in known.arrays
    }
    if layout != known.layout or size != known.size:
        raise ValueError(
            "image is of another controller: kind, orders, features and scales of the learner, dt, "
            "b0, model, and names and order of axes must be those of the controller that has saved "
            "it; make the controller as that one was made, or let it learn anew"
        )
    if running and design != known.design:
        raise ValueError(
            "image is of a controller with other parameters: a running loop continues only with "
            "all of them, but for the limits of u; leave running=True out to start from rest with "
            "what was learned"
        )
    if running and origin != 0:
        raise ValueError(
            f"image counts positions from the encoder count {origin}, which only NAME_step_counts "
            "in C does; leave running=True out to start from rest with what was learned"
        )
    kind = "<f4" if width == 4 else "<f8"
    numbers = np.frombuffer(data, kind, known.numbers, HEADER.size)
    if not np.all(np.isfinite(numbers)):
        raise ValueError("image has numbers that are not finite; let the controller learn anew")
    if any(numbers[place] != 0.0 for place in known.zeros):
        raise ValueError("image was saved in the middle of a sample; let the controller learn anew")
    found, at = missing, 0
    for name, array in known.arrays.items():
        found[name] = numbers[at : at + array.size].reshape(array.shape)
        at += array.size
    return found


def start_from_rest(parameters: Any, state: Any) -> None:
    """Set a state to rest with what was learned: ``reset_loop``, without compiling it."""
    with np.errstate(all="ignore"), as_python():
        reset_loop(parameters, state)


# ---- The state at rest with what was learned, for exports ----

_LEARNED = ("learner", "guard", "watch")


class _Part(NamedTuple):
    """A part of a state."""

    part: Any


def learned_state(controller: Any) -> Any:
    """Return a state at rest before the first sample, with what a controller has learned.

    That is ``initial_state()`` with learner, guard and what watches them of the running state.
    """
    state = controller.initial_state()
    fresh, running = _learned_arrays(state), _learned_arrays(getattr(controller, "_state", None))
    pairs = [*zip(fresh, running, strict=False)]
    if any(not np.array_equal(*pair) for pair in pairs):
        for array, learned in pairs:
            array[...] = learned
        start_from_rest(controller.parameters, state)
    return state


def _learned_arrays(state: Any) -> list[NDArray[Any]]:
    """Return what ADRCs, compensators, and axes together, have learned in a state, in order."""
    parts = [getattr(each, part) for each in _adrc_states(state) for part in _LEARNED]
    parts += [state.learning] if hasattr(state, "learning") else []
    return [
        array
        for part in parts
        for array in named_arrays(_Part(part)).values()
        if array.dtype.kind == "f"
    ]
