"""A table of a setup file is a call: ``kind`` says of what, every other key is a parameter under the name that it has in Python.

The models of the tables are made from signatures, so that what can be called can be written: a new
learner works by existing.
"""

from __future__ import annotations

import inspect
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
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

from quell.setup.docstrings import described, refers, summary

# Parameters for which a table has no key: the rest of the file has them.
CONTEXT = ("dt", "observer", "learner", "guard")


class Table(BaseModel):
    """What all tables have in common: no key that nothing uses, no text taken for a number, nothing changed after reading."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    @model_validator(mode="before")
    @classmethod
    def _know(cls, data: Any) -> Any:
        unknown = (
            [key for key in data if key not in cls.model_fields]
            if isinstance(data, Mapping)
            else []
        )
        if unknown:
            raise PydanticCustomError(
                "unknown", "unknown", {"keys": unknown, "known": [*cls.model_fields]}
            )
        return data

    def given(self) -> dict[str, Any]:
        """Return what the file has in this table, but for ``kind``."""
        return {
            key: getattr(self, key)
            for key in type(self).model_fields
            if key in self.model_fields_set and key != "kind"
        }


class Call(Table):
    """A table that is a call."""

    make: ClassVar[Callable[..., Any]]
    """Of what."""
    called: ClassVar[str]
    """The name of its kind."""
    context: ClassVar[tuple[str, ...]]
    """Those of its parameters that the rest of the file has."""


def call(
    kind: str,
    make: Callable[..., Any],
    *,
    sole: bool = False,
    passed_on: Sequence[Callable[..., Any]] = (),
    types: Mapping[str, Any] | None = None,
    words: Mapping[str, str] | None = None,
    without: Sequence[str] = (),
) -> type[Call]:
    """Return the model of a table whose keys are the parameters of ``make``.

    Parameters
    ----------
    kind
        its name.
    make
        what is called.
    sole
        whether it is the only kind of its table, which then has no key ``kind``.
    passed_on
        what it passes its ``**options`` on to: their keyword-only parameters are keys too.
    types
        of the keys that are tables themselves, by name.
    words
        on keys of which the docstring says nothing, by name.
    without
        parameters that are not for files.
    """
    found: dict[str, Any] = (
        {} if sole else {"kind": (Literal[kind], Field(kind, description="which one."))}
    )
    context: list[str] = []
    told = {
        key: text
        for function in (*reversed(passed_on), make)
        for key, text in described(function).items()
        if not refers(text)
    }
    told |= words or {}
    for function in (make, *passed_on):
        for parameter in _parameters(function):
            key = parameter.name
            if (
                key in found
                or key in ("self", *without)
                or parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
            ):
                continue
            if key in CONTEXT:
                context += [key] if function is make else []
            elif function is make or parameter.kind is parameter.KEYWORD_ONLY:
                annotation = (
                    types[key]
                    if types and key in types
                    else _plain(_evaluated(parameter.annotation, function))
                )
                text = told.get(key) or described(function).get(key, "")
                found[key] = (annotation, Field(_default(parameter, annotation), description=text))
    model = create_model(kind, __base__=Call, __doc__=summary(make), **found)
    model.called = kind
    model.make = staticmethod(make)
    model.context = tuple(context)
    return model


def one_of(
    tables: Mapping[str, Any],
    default: str | None = None,
    *,
    number: bool = False,
    several: Any = None,
) -> Any:
    """Return the type of a table of one of several kinds; a text in its place is the kind of a table without other keys.

    Parameters
    ----------
    tables
        by kind.
    default
        the kind of a table that does not say.
    number
        whether a number may stand in its place.
    several
        what may stand in a list in its place.
    """

    def tag(value: Any) -> str | None:
        if isinstance(value, Call):
            return value.called
        if isinstance(value, Mapping):
            return value.get("kind", default)
        return (
            "list"
            if isinstance(value, tuple) and several is not None
            else "number"
            if number
            else None
        )

    choices: list[Any] = [Annotated[model, Tag(kind)] for kind, model in tables.items()]
    choices += [Annotated[float, Tag("number")]] if number else []
    choices += [Annotated[list_of(several), Tag("list")]] if several is not None else []
    return Annotated[_union(choices), Discriminator(tag), BeforeValidator(_table)]


def list_of(kind: Any) -> Any:
    """Return the type of a list of any length."""
    return tuple[kind, ...]


def _table(value: Any) -> Any:
    return {"kind": value} if isinstance(value, str) else value


def _parameters(function: Callable[..., Any]) -> Iterable[inspect.Parameter]:
    return inspect.signature(function).parameters.values()


def _evaluated(annotation: Any, function: Callable[..., Any]) -> Any:
    """Return an annotation that is a text as what it means; Any where only type checkers know that."""
    if not isinstance(annotation, str):
        return annotation
    written = (
        inspect.getattr_static(function, "__init__")
        if isinstance(function, type)
        else inspect.unwrap(function)
    )
    try:
        return eval(annotation, written.__globals__)
    except (NameError, AttributeError):
        return Any


def _default(parameter: inspect.Parameter, annotation: Any) -> Any:
    """Return the default of a key; what the rest of the file may have, and its type says so, is not asked for."""
    if parameter.default is not parameter.empty:
        return parameter.default
    return None if type(None) in get_args(annotation) else ...


def _union(kinds: Sequence[Any]) -> Any:
    return Union[tuple(kinds)]  # noqa: UP007  # there may be any number of them


def _plain(annotation: Any) -> Any:
    """Return the type of a number, a text or a list of such as it is, and Any for all else: what is called looks at that itself."""
    if annotation in (float, int, bool, str, None, types.NoneType, ...):
        return annotation
    origin, inside = get_origin(annotation), [_plain(part) for part in get_args(annotation)]
    if Any in inside or not inside:
        return Any
    if origin in (Union, types.UnionType):
        return _union(inside)
    if origin is tuple:
        return tuple[tuple(inside)]  # type: ignore[misc]
    return list_of(inside[0]) if isinstance(origin, type) and issubclass(origin, Sequence) else Any
