"""Numba types of arguments that tell the compiler what does not change while a loop runs.

Numba's types of arrays do not contain shapes, so LLVM can neither unroll a loop over four states
nor keep them in registers: the same loop in C takes 1.4 times as long if its sizes are variables.
Here the type of an array that is a field of a NamedTuple contains its shape, and the type of an
integer that is annotated with ``Size`` or ``Flag`` contains its value. An array that is annotated
with ``Buffer`` has a type without shape, because each length would be compiled for:

::

    class Design(NamedTuple):
        a: Matrix
        order: Size
        past: Buffer

Kernels do not see any of it. Such an array is passed as one pointer instead of seven words or more,
which makes compilation quicker, too. Numba does not know these types of values by itself: call an
entry point by ``specialised`` (``kernels/dispatch.py``).

Named scalars of a state: an array of one record, read by name in compiled and interpreted code.

::

    class Loop(Scalars):
        u: float
        samples: int

    class State(NamedTuple):
        loop: NDArray[Loop]

    state = State(Loop.zeros())
    state.loop[0].u = 1.0           # the same statement in a kernel and in Python
    loop = state.loop[0]            # refers to the record, does not copy it

If all fields are floats, ``state.loop.view(np.float64)`` is the record as a vector; the saved state
of a controller uses that. ``single_dtype`` is the same record in single precision. A field must not
have the name of an attribute that NumPy needs (``dtype``, ``view``, ``copy`` …).
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from itertools import repeat
from math import prod
from operator import itemgetter
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, Self, TypeAlias

import numba
import numpy as np
from numba import types as nb_types
from numba.extending import (
    NativeValue,
    intrinsic,
    lower_cast,
    models,
    overload,
    register_model,
    unbox,
)
from numpy.typing import NDArray

from quell.kernels.linking import KERNEL_OPTIONS, OPTIONS
from quell.kernels.numba_internals import DataModel, ir, memset

Size: TypeAlias = Annotated[int, "constant"]
"""Annotates an integer field of a NamedTuple that is a constant in compiled code."""

Flag: TypeAlias = Annotated[bool, "constant"]
"""Annotates a flag in a NamedTuple that is a constant in compiled code."""

Buffer: TypeAlias = Annotated[NDArray[np.float64], "variable"]
"""Annotates an array in a NamedTuple whose length is a parameter: its shape is no constant."""

Scratch: TypeAlias = Annotated[NDArray[np.float64], "scratch"]
"""Annotates an array in a state that one call fills and only the same call reads: exported code has
a local variable in its place. A kernel gives it a name before it uses it."""

Work: TypeAlias = Annotated[NDArray[np.float64], "work"]
"""Annotates an array in a state whose numbers no later sample reads: a memory image is without."""

# Larger arrays are passed in Numba's own way: loops over them are not unrolled, and buffers of
# many lengths would each be compiled for. 16 × 16 is a Kalman learner with 16 features.
_MOST_ELEMENTS = 256

_PLAIN = (float, int, bool)

_types: dict[Any, nb_types.Type] = {}


class SizedArray(nb_types.Array):
    """The type of arrays of one shape."""

    def __init__(self, array: np.ndarray) -> None:
        plain = numba.typeof(array)
        self.lengths, self.steps = array.shape, array.strides
        name = f"{plain}, {self.lengths}, {self.steps}"
        super().__init__(
            *(plain.dtype, plain.ndim, plain.layout),
            readonly=not plain.mutable,
            name=name,
            aligned=plain.aligned,
        )
        self.itemsize = array.itemsize

    @property
    def key(self) -> Any:
        """Values in which equal types agree."""
        return (*super().key, self.lengths, self.steps)

    @property
    def mangling_args(self) -> Any:
        """Parts of the name of a function that is compiled for it."""
        name, arguments = super().mangling_args
        return name, [*arguments, *self.lengths, *self.steps]


class Constant(nb_types.IntegerLiteral):
    """The type of one integer."""


class ConstantFlag(nb_types.BooleanLiteral):
    """The type of ``True``, or of ``False``."""


@register_model(SizedArray)
class _SizedArrayModel(models.ArrayModel):
    """As an argument, the pointer to the data."""

    def get_argument_type(self) -> Any:
        return self._model_of("data").get_argument_type()

    def as_argument(self, builder: Any, value: Any) -> Any:
        return self.get(builder, value, "data")

    def from_argument(self, builder: Any, value: Any) -> Any:
        kind = self._fe_type
        word = ir.IntType(64)
        known = {
            "nitems": ir.Constant(word, prod(kind.lengths)),
            "itemsize": ir.Constant(word, kind.itemsize),
            "shape": _words(kind.lengths),
            "strides": _words(kind.steps),
            "meminfo": self._null("meminfo"),
            "parent": self._null("parent"),
            "data": value,
        }
        array = ir.Constant(self.get_value_type(), ir.Undefined)
        for name, part in known.items():
            array = self.set(builder, array, part, name)
        return array

    def _model_of(self, name: str) -> Any:
        return self.get_model(self.get_field_position(name))

    def _null(self, name: str) -> Any:
        return ir.Constant(self._model_of(name).get_value_type(), None)


class _ConstantModel(DataModel):
    """As an argument, nothing."""

    def get_argument_type(self) -> Any:
        return ()

    def as_argument(self, builder: Any, value: Any) -> Any:
        return ()

    def from_argument(self, builder: Any, value: Any) -> Any:
        return ir.Constant(self.get_value_type(), int(self._fe_type.literal_value))


@register_model(Constant)
class _ConstantIntegerModel(_ConstantModel, models.IntegerModel):
    """A whole number."""


@register_model(ConstantFlag)
class _ConstantFlagModel(_ConstantModel, models.BooleanModel):
    """True or false."""


@unbox(Constant)
@unbox(ConstantFlag)
def _unbox_constant(kind: Any, value: Any, compiler: Any) -> NativeValue:
    word = compiler.context.get_value_type(kind)
    return NativeValue(ir.Constant(word, int(kind.literal_value)))


@lower_cast(SizedArray, nb_types.Array)
def _forget_shape(context: Any, builder: Any, kind: Any, other: Any, value: Any) -> Any:
    return value


def _words(numbers: tuple[int, ...]) -> Any:
    word = ir.IntType(64)
    return ir.Constant(ir.ArrayType(word, len(numbers)), [ir.Constant(word, n) for n in numbers])


def layout_of(value: Any, sized: bool = False, arrays: list[NDArray[Any]] | None = None) -> Any:
    """Return, hashable, what the type of an argument depends on; quicker than to make the type.

    Arrays have known shapes if they are ``sized``, which those in a NamedTuple are. Those that are
    not empty are appended to ``arrays``.
    """
    kind: Any = type(value)
    if kind in _PLAIN:
        return kind
    if kind is np.ndarray:
        flags = value.flags
        if value.size and arrays is not None:
            arrays.append(value)
        if _has_known_shape(value, sized):
            return value.shape, value.strides, value.dtype, flags.aligned, flags.writeable
        order = "C" if flags.c_contiguous else "F" if flags.f_contiguous else "A"
        return value.ndim, order, value.dtype, flags.aligned, flags.writeable
    if isinstance(value, tuple):
        notes = _annotations(kind)
        constants = [(type(value[i]), value[i]) for i in notes.constants]
        are_sized = notes.sized or repeat(True)
        parts = map(layout_of, value, are_sized, repeat(arrays))
        return kind, *constants, *parts
    return numba.typeof(value)


def _has_known_shape(array: NDArray[Any], sized: bool) -> bool:
    return sized and array.size <= _MOST_ELEMENTS


def type_of(value: Any, sized: bool = False) -> nb_types.Type:
    """Return the type of an argument; see ``layout_of``."""
    layout = layout_of(value, sized)
    found = _types.get(layout)
    if found is None:
        found = _types[layout] = _make_type(value, sized)
    return found


def _make_type(value: Any, sized: bool) -> nb_types.Type:
    if isinstance(value, np.ndarray) and _has_known_shape(value, sized):
        return SizedArray(value)
    if not isinstance(value, tuple):
        return numba.typeof(value)
    notes = _annotations(type(value))
    parts = [
        _constant_type(part) if i in notes.constants else type_of(part, sized)
        for i, (part, sized) in enumerate(zip(value, notes.sized or repeat(True), strict=False))
    ]
    if not hasattr(value, "_fields"):
        return nb_types.BaseTuple.from_types(parts)
    if parts and not notes.constants and parts.count(parts[0]) == len(parts):
        return nb_types.NamedUniTuple(parts[0], len(parts), type(value))
    return nb_types.NamedTuple(parts, type(value))


def _constant_type(value: Any) -> nb_types.Type:
    return ConstantFlag(value) if isinstance(value, bool) else Constant(int(value))


class _Annotations(NamedTuple):
    """Roles of the fields of a NamedTuple, by their annotations."""

    constants: tuple[int, ...]  # indices of constants
    sized: tuple[bool, ...]  # for each field, whether an array in it has a known shape
    scratch: tuple[int, ...]  # indices of arrays that no later call reads
    work: tuple[int, ...]  # indices of arrays that no later sample reads


def remade(value: tuple[Any, ...], parts: Iterable[Any]) -> Any:
    """Return a tuple of the type of ``value``, a NamedTuple or a plain one, with other entries."""
    return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)


def constant_fields(kind: type) -> tuple[str, ...]:
    """Return the names of the fields of a NamedTuple that are annotated with Size or Flag."""
    names = getattr(kind, "_fields", ())
    return tuple(names[i] for i in _annotations(kind).constants)


def scratch_fields(kind: type) -> tuple[str, ...]:
    """Return the names of the fields of a NamedTuple that are annotated with Scratch."""
    names = getattr(kind, "_fields", ())
    return tuple(names[i] for i in _annotations(kind).scratch)


def work_fields(kind: type) -> tuple[str, ...]:
    """Return the names of the fields of a NamedTuple that are work space, with Scratch or Work."""
    names = getattr(kind, "_fields", ())
    return tuple(names[i] for i in (*_annotations(kind).scratch, *_annotations(kind).work))


@functools.cache
def _annotations(kind: Any) -> _Annotations:
    notes = getattr(kind, "__annotations__", {})
    fields = [notes.get(name) for name in getattr(kind, "_fields", ())]
    names = [getattr(note, "__forward_arg__", note) for note in fields]
    constants = tuple(i for i, name in enumerate(names) if name in ("Size", "Flag", Size, Flag))
    sized = tuple(name not in ("Buffer", Buffer) for name in names)
    scratch = tuple(i for i, name in enumerate(names) if name in ("Scratch", Scratch))
    work = tuple(i for i, name in enumerate(names) if name in ("Work", Work))
    return _Annotations(constants, sized, scratch, work)


if TYPE_CHECKING:
    _Record = np.generic  # NumPy's stubs forbid subclasses of np.void, NumPy itself does not
else:
    _Record = np.void

_DTYPES = {"float": np.float64, "int": np.int64}


class Scalars(_Record):
    """Base class of a record; a subclass annotates its fields with ``float`` or ``int`` (64 bits).

    Annotations must be postponed (``from __future__ import annotations``).
    """

    _dtype: ClassVar[np.dtype[Any]]

    def __init_subclass__(cls) -> None:
        # With np.record instead of these properties, interpreted loops take up to twice as long.
        for name in cls.__annotations__:
            setattr(cls, name, _field(name))
        fields = [(name, _DTYPES[kind]) for name, kind in cls.__annotations__.items()]
        cls._dtype = np.dtype((cls, fields))

    @classmethod
    def zeros(cls) -> NDArray[Self]:
        """Return an array (1,) whose record is zero in all fields."""
        return np.zeros(1, cls._dtype)


def _field(name: str) -> property:
    def write(record: Any, value: float) -> None:
        record[name] = value

    return property(itemgetter(name), write)


def single_dtype(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the type of the same record with its floats in single precision."""
    names = dtype.names or ()
    kinds = {name: np.float32 if dtype[name] == np.float64 else dtype[name] for name in names}
    return np.dtype((dtype.type, list(kinds.items())))


def clear(scalars: NDArray[Any]) -> None:
    """Set all fields of a record to zero."""
    scalars.view(np.uint8)[:] = 0


# Numba compiles a view of a record as float64 in 0.2 s; this takes a millisecond.
@overload(clear, strict=False, jit_options=OPTIONS | KERNEL_OPTIONS)
def _clear(scalars: Any) -> Any:
    return lambda scalars: _set_to_zero(scalars)


@intrinsic
def _set_to_zero(typing_context: Any, scalars: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        array = context.make_array(scalars)(context, builder, values[0])
        size = context.get_constant(nb_types.intp, scalars.dtype.size)
        memset(builder, array.data, size, 0)
        return context.get_dummy_value()

    return nb_types.void(scalars), generate
