"""Tables of a setup file as Pydantic models, made from the signatures of functions.

A table is a call: its key ``kind`` names a function, and every other key is a parameter of it. A
new learner, for example, needs no entry anywhere: its table is made from its signature.
"""

from __future__ import annotations

import inspect
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Union, get_args, get_origin

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    create_model,
    model_validator,
)
from pydantic_core import PydanticCustomError

from quell.setup.docstrings import is_reference, parameter_descriptions, summary

CONTEXT = ("dt", "observer", "learner", "guard", "trust")
"""Parameters that are no keys of a table: other tables of the file give them, or the user."""

_VARIABLE = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)


class Table(BaseModel):
    """A table: unknown keys are errors, types are not converted, values are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown(cls, data: Any) -> Any:
        keys = data if isinstance(data, Mapping) else ()
        unknown = [key for key in keys if key not in cls.model_fields]
        if unknown:
            context = {"keys": unknown, "known": [*cls.model_fields]}
            raise PydanticCustomError("unknown", "unknown", context)
        return data

    def written(self) -> dict[str, Any]:
        """Return the keys that the file has in this table, except ``kind``."""
        keys = (key for key in type(self).model_fields if key in self.model_fields_set)
        return {key: getattr(self, key) for key in keys if key != "kind"}


class CallTable(Table):
    """A table that is a call of a function."""

    function: ClassVar[Callable[..., Any]]
    kind_name: ClassVar[str]  # the value of its key ``kind``
    context: ClassVar[tuple[str, ...]]  # the parameters that other tables of the file give
    beside: ClassVar[tuple[str, ...]] = ()  # keys that are no arguments of the call

    def written(self) -> dict[str, Any]:
        """Return the arguments of the call that the file has."""
        return {key: value for key, value in super().written().items() if key not in self.beside}


def call_table(
    kind: str,
    function: Callable[..., Any],
    *,
    only: bool = False,
    forwards_to: Sequence[Callable[..., Any]] = (),
    types: Mapping[str, Any] | None = None,
    descriptions: Mapping[str, str] | None = None,
    without: Sequence[str] = (),
    beside: Mapping[str, tuple[Any, Any]] | None = None,
) -> type[CallTable]:
    """Return the model of a table whose keys are the parameters of ``function``.

    Parameters
    ----------
    only
        the table has no other kinds, and no key ``kind``.
    forwards_to
        functions that ``function`` forwards its ``**options`` to: their keyword-only parameters are
        keys, too.
    types, descriptions
        types of keys that are tables, and descriptions that are not in the docstring, by name.
    without
        parameters that are no keys.
    beside
        further keys, which are no arguments of the call: type and field of each.
    """
    fields: dict[str, Any] = {}
    if not only:
        fields["kind"] = (Literal[kind], Field(kind, description="which one."))
    known: dict[str, str] = {}
    for called in (*reversed(forwards_to), function):
        for key, text in parameter_descriptions(called).items():
            if key not in known or not is_reference(text):
                known[key] = text
    known |= descriptions or {}
    context = []
    for called in (function, *forwards_to):
        for key, parameter in inspect.signature(called).parameters.items():
            if key in fields or key in ("self", *without) or parameter.kind in _VARIABLE:
                continue
            if key in CONTEXT:
                context += [key] if called is function else []
            elif called is function or parameter.kind is parameter.KEYWORD_ONLY:
                kind_of_value = (types or {}).get(key) or _toml_type(_annotation(parameter, called))
                default = _default(parameter, kind_of_value)
                fields[key] = (kind_of_value, Field(default, description=known.get(key, "")))
    fields |= beside or {}
    model = create_model(kind, __base__=CallTable, __doc__=summary(function), **fields)
    model.kind_name = kind
    model.function = staticmethod(function)
    model.context = tuple(context)
    model.beside = tuple(beside or ())
    return model


def one_of(
    tables: Mapping[str, Any],
    default: str | None = None,
    *,
    number: bool = False,
    flag: bool = False,
    many: Any = None,
) -> Any:
    """Return the type of a table of one of several kinds; a text in its place is its kind.

    ``default`` is the kind of a table without the key ``kind``. In place of the table there may be
    a number if ``number``, true or false if ``flag``, and a list of ``many``, if it is given.
    """
    plain = "number" if number else "flag" if flag else None

    def tag(value: Any) -> str | None:
        if isinstance(value, CallTable):
            return value.kind_name
        if isinstance(value, Mapping):
            return value.get("kind", default)
        if isinstance(value, tuple) and many is not None:
            return "list"
        return plain

    choices: list[Any] = [Annotated[model, Tag(kind)] for kind, model in tables.items()]
    choices += [Annotated[float, Tag("number")]] if number else []
    choices += [Annotated[bool, Tag("flag")]] if flag else []
    choices += [Annotated[list_of(many), Tag("list")]] if many is not None else []
    return Annotated[_union(choices), Discriminator(tag), BeforeValidator(_text_to_table)]


def list_of(kind: Any) -> Any:
    """Return the type of a list of any length."""
    return tuple[kind, ...]


def _text_to_table(value: Any) -> Any:
    return {"kind": value} if isinstance(value, str) else value


def _annotation(parameter: inspect.Parameter, function: Callable[..., Any]) -> Any:
    """Return the type of a parameter; Any where only type checkers can evaluate the annotation."""
    annotation = parameter.annotation
    if not isinstance(annotation, str):
        return annotation
    is_class = isinstance(function, type)
    home = inspect.getattr_static(function, "__init__") if is_class else function
    try:
        return eval(annotation, inspect.unwrap(home).__globals__)
    except (NameError, AttributeError):
        return Any


def _default(parameter: inspect.Parameter, annotation: Any) -> Any:
    """Return the default of a key; None for a key that may be None: other tables may give it."""
    if parameter.default is not parameter.empty:
        return parameter.default
    return None if type(None) in get_args(annotation) else ...


def _union(kinds: Sequence[Any]) -> Any:
    return Union[tuple(kinds)]  # noqa: UP007  # there may be any number of them


def _toml_type(annotation: Any) -> Any:
    """Return the type of numbers, texts and lists of them; Any for all else."""
    if annotation in (float, int, bool, str, None, types.NoneType, ...):
        return annotation
    origin, inside = get_origin(annotation), [_toml_type(part) for part in get_args(annotation)]
    if Any in inside or not inside:
        return Any
    if origin in (Union, types.UnionType):
        return _union(inside)
    if origin is tuple:
        return tuple[tuple(inside)]  # type: ignore[misc]
    return list_of(inside[0]) if isinstance(origin, type) and issubclass(origin, Sequence) else Any
