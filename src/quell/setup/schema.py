"""Tables of a setup file: TOML, schema from signatures, errors, builders, plants.

Descriptions from docstrings: of a function, and of its parameters.

Errors of a setup file: one line each, with file, path of the key, value and rule.

Tables of a setup file as Pydantic models, made from the signatures of functions.

A table is a call: its key ``kind`` names a function, and every other key is a parameter of it. A
new learner, for example, needs no entry anywhere: its table is made from its signature.

A builder: objects from tables.

Plants from tables: the one place where a plant is made of what a user wrote.

Setup files, rigs, twins and the command line all use it.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import re
import tomllib
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial, reduce
from operator import add
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Union, get_args, get_origin

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    create_model,
    model_validator,
)
from pydantic_core import PydanticCustomError

from quell import checks
from quell.checks import nearest
from quell.features.base import Features
from quell.files import begin_of, encoding_of, kind_of, whole_text
from quell.plants import registry as plants
from quell.plants.base import Plant as AnyPlant
from quell.plants.base import is_several, labelled
from quell.plants.linearise import linear_model
from quell.plants.registry import RUN_CODE
from quell.signals.shapes import Signal

# ---- Descriptions from docstrings ----

# A line of names, and the indented lines that describe them.
_ENTRY = re.compile(r"^(\S[^\n]*)\n((?:[ ]+[^\n]*\n?|\n)+)", re.MULTILINE)
_PARAMETERS = re.compile(r"^Parameters\n-+\n(.*?)(?=^\w[^\n]*\n-+\n|\Z)", re.MULTILINE | re.DOTALL)


def summary(function: Callable[..., Any]) -> str:
    """Return the first paragraph of a docstring."""
    return " ".join((inspect.getdoc(function) or "").split("\n\n")[0].split())


def parameter_descriptions(function: Callable[..., Any]) -> dict[str, str]:
    """Return the description of each parameter; a class inherits those of its bases."""
    if not isinstance(function, type):
        return _parameters(inspect.getdoc(function) or "")
    found: dict[str, str] = {}
    for cls in reversed(function.__mro__[:-1]):
        found |= _parameters(inspect.cleandoc(cls.__dict__.get("__doc__") or ""))
    return found


def is_reference(description: str) -> bool:
    """Return whether a description only refers to another one."""
    return description.startswith("as for")


def _parameters(docstring: str) -> dict[str, str]:
    section = _PARAMETERS.search(docstring)
    return {
        name.strip().lstrip("*"): " ".join(re.sub(r"\s*\[\d+\]_", "", text).split())
        for names, text in (_ENTRY.findall(section[1] + "\n") if section else ())
        for name in names.split(",")
    }


# ---- Tables of a setup file as Pydantic models, made from the signatures of functions ----

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

    tag.__dict__.update(tables=tables, default=default)  # for the JSON Schema
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


# ---- Errors of a setup file ----

# Pydantic's names of type errors, and the type that is expected.
_TYPES = {
    **{"float_type": "a number", "int_type": "a whole number", "bool_type": "true or false"},
    **{"string_type": "a text", "tuple_type": "a list", "model_type": "a table"},
}


# What to add where a table or key is missing, by its path; {} is the name of the file.
_REMEDIES = {
    "controller": "give tables [controller] and [observer]; quell tune {} --out tuned.toml finds "
    "both for the plant",
    "dt": "give the sample time of the loop [s] at the top of the file, dt = 0.001",
}


class SetupError(ValueError):
    """A setup that cannot be used; ``mistakes`` has a line for each error."""

    def __init__(self, mistakes: Sequence[str]) -> None:
        super().__init__("\n".join(mistakes))
        self.mistakes = tuple(mistakes)


def with_path(name: str, path: str, error: Exception, keys: Sequence[str]) -> SetupError:
    """Return an error with the file's name and the path in front.

    The path includes the key that the message begins with, where that is one of ``keys``.
    """
    text = " ".join(str(error).split())
    begins = any(text.startswith((f"{key} ", f"{key}[", f"{key}:")) for key in keys)
    return SetupError([f"{name}: {path}{'.' if begins and path else ': ' if path else ''}{text}"])


def from_validation(name: str, error: ValidationError, data: Any) -> SetupError:
    """Return the errors in the tables and keys of the file ``name``, which holds ``data``."""
    lines: list[str] = []
    expected: dict[str, list[str]] = {}
    for found in error.errors():
        kind, value, context = found["type"], found["input"], found.get("ctx", {})
        path = _path(found["loc"], data, absent=kind == "missing")
        if kind in _TYPES:
            one_of_many = kind == "tuple_type" and isinstance(value, Mapping)
            types = expected.setdefault(f"{path} = {_short(value)}: must be", [])
            types.append(f"[[{path}]]" if one_of_many else _TYPES[kind])
        elif kind == "unknown":
            start, known = f"{path}." if path else "", context["known"]
            lines += [
                f"{start}{key}: unknown; {_hint(path, key, known)}" for key in context["keys"]
            ]
        elif kind == "missing":
            remedy = f"; {_REMEDIES[path].format(name)}" if path in _REMEDIES else ""
            lines.append(f"{path}: missing{remedy}")
        elif kind == "union_tag_invalid" and isinstance(value, Mapping):
            hint = nearest(str(value["kind"]), _tags(context))
            if str(value["kind"]) in plants.AXES_PLANTS and path.rpartition(".")[2] == "plant":
                hint = "it has several signals, and is for a setup with a table [[axis]] for each"
            lines.append(f"{path}.kind = {_short(value['kind'])}: unknown; {hint}")
        elif kind == "union_tag_not_found" and isinstance(value, Mapping):
            lines.append(f"{path}.kind: missing")
        elif kind in ("union_tag_not_found", "union_tag_invalid"):
            lines.append(f"{path} = {_short(value)}: must be a table")
        elif kind == "value_error" and str(context.get("error")).startswith(f"{path} = "):
            lines.append(str(context["error"]))
        else:
            lines.append(f"{path} = {_short(value)}: {found['msg']}")
    lines += [f"{line} {' or '.join(dict.fromkeys(names))}" for line, names in expected.items()]
    return SetupError([f"{name}: {line}" for line in lines])


# Limits of u, which a tuning keeps, and the bounds of [tune] that are named like them.
_LIMITS_OF_U = {"u_min": ("u_max", "|u|"), "rate_limit": ("rate_max", "|u'|")}


def _hint(path: str, key: str, known: Sequence[str]) -> str:
    bound, of = _LIMITS_OF_U.get(key, ("", ""))
    if path == "tune" and bound in known:
        return (
            "limits of u are u_min, u_max and rate_limit in [controller]; "
            f"tune.{bound} bounds {of} in the response to the load or the reference"
        )
    if key in CONTEXT:
        top = f"{key} belongs at the top of the file"
        if key == "trust":
            return "a file can't ask for trust; give --trust"
        return top if key == "dt" else f"[{key}] is a table of its own"
    return nearest(key, known)


def _tags(context: Mapping[str, Any]) -> list[str]:
    tags = [tag.strip().strip("'") for tag in str(context.get("expected_tags", "")).split(",")]
    return [tag for tag in tags if tag not in ("number", "list", "flag")]


def _path(loc: Sequence[str | int], data: Any, absent: bool) -> str:
    """Return the path of a key in the file, from the location that Pydantic reports.

    A location also has the names of choices, which are no keys of ``data``. The last key may be
    absent from ``data``.
    """
    path = ""
    for i, step in enumerate(loc):
        if isinstance(data, Mapping) and (step in data or (absent and i + 1 == len(loc))):
            path += f".{step}" if path else str(step)
            data = data.get(step)
        elif isinstance(step, int) and isinstance(data, Sequence):
            path += f"[{step}]"
            data = data[step] if step < len(data) else None  # it may be absent
    return path


def _short(value: Any) -> str:
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= 60 else f"{text[:57]}..."


# ---- TOML files as dictionaries, within limits of size and depth ----

# Tables and lists within each other: setups have up to six; signals that follow each other may have
# more. Chosen by hand, below what Python and Pydantic can follow.
_DEEPEST = 50
# A key of more parts than that. Reading one takes a time of the order of their number squared.
_PART = r"(?:[\w-]++|\"[^\"\n]*+\"|'[^'\n]*+')[ \t]*+"
_DEEP_KEY = re.compile(rf"(?<![\w-]){_PART}(?:\.[ \t]*+{_PART}){{{_DEEPEST}}}")


def read(path: str | os.PathLike[str]) -> tuple[str, dict[str, Any]]:
    """Return the name of a TOML file, for messages, and its content.

    Raises
    ------
    SetupError
        for a file that cannot be read, or is not TOML; for a record it names the commands that take
        one.
    """
    name = Path(path).name
    try:
        return name, parsed(name, whole_text(path))
    except OSError as error:
        raise SetupError([f"{path}: can't be read ({error.strerror})"]) from None
    except UnicodeDecodeError as error:
        fault = SetupError([f"{name}: not TOML: byte {error.start} is not UTF-8"])
    except SetupError as error:
        fault = error
    except ValueError as error:  # too long
        fault = SetupError([f"{name}: not a setup: {error}"])
    raise _of_another_kind(path, name) or fault


def _of_another_kind(path: str | os.PathLike[str], name: str) -> SetupError | None:
    """Return an error that says what a file is that is no setup, None if that is not known."""
    # It takes longer to import than a setup to read.
    from quell.identification.record_layout import seems_record

    begin = begin_of(path)
    kind = kind_of(begin)
    text = begin.decode(encoding_of(begin), errors="replace")
    if Path(path).suffix.lower() in (".mcap", ".nc") or seems_record(text.splitlines()[:-1]):
        rule = f"quell identify {name} finds a model in it, quell tune {name} --out tuned.toml a "
        rule += f"controller, as a setup, and quell b0 {name} the gain of the input"
        return SetupError([f"{name}: is a record, not a setup: {rule}"])
    if kind is not None:
        return SetupError([f"{name}: is {kind.what}, not a setup; give a file in TOML"])
    return None


def parsed(name: str, text: str) -> dict[str, Any]:
    """Return the content of the text of a file called ``name``; raise as ``read``."""
    try:
        if _DEEP_KEY.search(text):
            raise RecursionError
        data = tomllib.loads(text)
        _check_depth(data)
        return data
    except tomllib.TOMLDecodeError as error:
        raise SetupError([f"{name}: not TOML: {error}"]) from None
    except RecursionError:
        raise SetupError([f"{name}: not a setup: tables or lists are nested too deeply"]) from None
    except ValueError as error:  # a number of more digits than Python reads
        raise SetupError([f"{name}: not a setup: {error}"]) from None


def _check_depth(data: Any) -> None:
    """Raise a ``RecursionError`` if tables or lists are deeper than those of any setup."""
    level = [data]
    for _ in range(_DEEPEST):
        level = [
            part
            for each in level
            if isinstance(each, dict | list)
            for part in (each.values() if isinstance(each, dict) else each)
        ]
    if level:
        raise RecursionError


def immutable(value: Any) -> Any:
    """Return a value with tuples in place of lists, and None in place of the text ``none``."""
    if isinstance(value, Mapping):
        return {key: immutable(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return tuple(immutable(part) for part in value)
    return None if value == "none" else value


# ---- A builder ----

# Keys whose plant is a model: only its linear part is used.
_MODELS = ("observer.plant", "controller.plant", "guard.certified_for")


@cache
def parameters_of(function: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Return the parameters of a function by name."""
    return dict(inspect.signature(function).parameters)


class Builder:
    """A builder of the tables of one file, whose ``name`` stands at the beginning of its errors.

    With ``trust`` it runs the Python files and FMUs that plants are in.
    """

    def __init__(self, name: str, trust: bool = False) -> None:
        self.name = name
        self.trust = trust

    def build(self, table: CallTable, path: str, **context: Any) -> Any:
        """Return the object that a table describes; ``path`` is its place in the file.

        ``context`` has objects of other tables, None for a missing one. Those that the table's
        function takes, and that the table does not have itself, become arguments.
        """
        takes = parameters_of(table.function)
        if table.function in RUN_CODE and not self.trust:
            rule = "would run this program; give --trust (in Python trust=True) if you trust it"
            raise SetupError(
                [f"{self.name}: {path}: path = {table.written().get('path')!r}: {rule}"]
            )
        context["trust"] = self.trust
        arguments = {
            key: value for key, value in context.items() if key in takes and value is not None
        }
        inner: dict[str, Any] = {key: context[key] for key in ("dt", "plant") if key in context}
        for key, value in table.written().items():
            arguments[key] = self.value(value, f"{path}.{key}", key != "disturbances", inner)
        for key, parameter in takes.items():
            needed = parameter.default is parameter.empty
            if needed and key not in arguments and parameter.kind is not parameter.VAR_KEYWORD:
                raise SetupError([f"{self.name}: {path}: {key} is missing; give a table [{key}]"])
        made = self.attempt(path, [*arguments], partial(table.function, **arguments))
        signals = getattr(table, "signals", None) if "signals" in table.beside else None
        if signals is None:
            return made
        return self.attempt(f"{path}.signals", "yuw", partial(labelled, made, **signals.written()))

    def attempt(
        self, path: str, keys: Sequence[str], action: Callable[..., Any], *arguments: Any
    ) -> Any:
        """Return ``action(*arguments)``; an error names the path and, if possible, the key."""
        try:
            return action(*arguments)
        except ValueError as error:
            raise with_path(self.name, path, error, keys) from None
        except ArithmeticError as error:
            beyond = ValueError(f"these numbers are beyond what can be computed ({error})")
            raise with_path(self.name, path, beyond, keys) from None

    def value(self, value: Any, path: str, add_up: bool, context: dict[str, Any]) -> Any:
        """Build the tables in a value; add up the features or signals of a list if ``add_up``."""
        if isinstance(value, CallTable):
            built = self.build(value, path, **context)
            return linear_model(built) if path.partition("[")[0] in _MODELS else built
        if not isinstance(value, tuple):
            return value
        entries = enumerate(value)
        parts = tuple(self.value(part, f"{path}[{i}]", True, context) for i, part in entries)
        if add_up and any(isinstance(part, Features | Signal) for part in parts):
            return self.attempt(path, (), reduce, add, parts)
        return parts


# ---- Plants from tables ----


class SignalNames(Table):
    """Names and units: ``angle [rad]``."""

    y: str = Field("", description="output.")
    u: str = Field("", description="control signal.")
    w: tuple[str, ...] = Field((), description="disturbances.")


_BESIDE = {
    "uncertain": (
        dict[str, tuple[float, float]] | None,
        Field(None, description="ranges [low, high] of its keys, for `quell tune` and sweeps."),
    ),
    "signals": (
        SignalNames | None,
        Field(
            None,
            description="names and units, `{y = 'angle [rad]', u = 'voltage [V]', w = ['load "
            "[N m]']}`, for plots, tables and files.",
        ),
    ),
}
# A plant may contain a plant: its type is a name until all tables exist.
_TYPES_PLANTS = {
    "plant": "Plant",
    "path": str,
    "start": dict[str, float | int | bool | str] | None,
    "parameters": dict[str, float] | None,
    "operating_point": dict[str, Any] | None,
}
PLANTS: dict[str, type[CallTable]] = {
    kind: call_table(kind, function, types=_TYPES_PLANTS, beside=_BESIDE)
    for kind, function in plants.PLANTS.items()
}
if TYPE_CHECKING:
    Plant = CallTable
else:
    Plant: Any = one_of(PLANTS)
for _model in PLANTS.values():
    _model.model_rebuild(_types_namespace={"Plant": Plant})
AXES_PLANTS: dict[str, type[CallTable]] = {
    kind: call_table(kind, function, types={**_TYPES_PLANTS, "plant": "AxesPlant"})
    for kind, function in plants.AXES_PLANTS.items()
}
if TYPE_CHECKING:
    AxesPlant = CallTable
else:
    AxesPlant: Any = one_of(AXES_PLANTS)
for _model in AXES_PLANTS.values():
    _model.model_rebuild(_types_namespace={"AxesPlant": AxesPlant})


# Keys of plants that name a file, by kind.
_FILES = {"python": "source", "identified": "path", "fmu": "path"}


class _File(Table):
    plant: Plant


class _FileOfAxes(Table):
    plant: AxesPlant


def plant_of(
    table: Mapping[str, Any] | str,
    dt: float,
    *,
    name: str = "plant",
    trust: bool = False,
    several: bool = False,
) -> AnyPlant:
    """Return the plant that a table describes, as ``[plant]`` of a setup file does.

    Parameters
    ----------
    table
        ``{"kind": "two-mass", "m1": 2.0}``, with a name of ``PLANTS`` and its keys; or the name.
    dt
        sample time of the loop [s], for delays.
    name
        of the file, for messages.
    trust
        whether Python files that the table names may be run.
    several
        whether it may be a plant of several signals, as in a file with [[axis]].

    Raises
    ------
    SetupError
        with a line for each error.

    Examples
    --------
    >>> plant_of({"kind": "linear", "num": [50.0], "den": [1.0, 22.0, 40.0, 0.0]}, dt=1e-3).order
    3
    """
    values = immutable({"plant": table})
    try:
        found = (_FileOfAxes if several and _is_of_axes(table) else _File).model_validate(values)
    except ValidationError as error:
        raise from_validation(name, error, values) from None
    builder = Builder(name, trust)
    dt = builder.attempt("", (), checks.positive, "dt", dt, "s")
    made: AnyPlant = builder.build(found.plant, "plant", dt=dt)
    if not several:
        check_single(name, made)
    return made


def _is_of_axes(table: Any) -> bool:
    """Return whether a plant is of a kind that has several signals only."""
    kind = table.get("kind") if isinstance(table, Mapping) else None
    return isinstance(kind, str) and kind in AXES_PLANTS and kind not in PLANTS


def check_single(name: str, plant: Any) -> None:
    """Raise a ``SetupError`` for a plant with several signals where one axis is meant."""
    if is_several(plant):
        raise SetupError(
            [
                f"{name}: plant: has several signals: must have one u and one y; several axes have "
                "a setup with a table [[axis]] for each, which quell run simulates"
            ]
        )


def contents_of(tables: Any) -> Iterator[tuple[str, str]]:
    """Yield the files that plants in some tables are made of, and hashes of their contents."""
    if isinstance(tables, Mapping):
        key = _FILES.get(str(tables.get("kind")))
        text = tables.get(key) if key else None
        if isinstance(text, str):
            with suppress(OSError):
                content = Path(text.rpartition(":")[0] if key == "source" else text).read_bytes()
                yield text, hashlib.sha256(content).hexdigest()
    if isinstance(tables, Mapping | list | tuple):
        for part in tables.values() if isinstance(tables, Mapping) else tables:
            yield from contents_of(part)


def plant_given(
    text: str, dt: float, *, argument: str = "plant", trust: bool = False, several: bool = False
) -> AnyPlant:
    """Return the plant that a text on the command line stands for.

    Parameters
    ----------
    text
        one of

        * the name of a plant: ``torsional``,
        * a setup file with a table ``[plant]``: ``setup.toml``,
        * a file of ``quell identify --json``: ``model.json``,
        * an FMU: ``motor.fmu``,
        * a Python function that returns a plant: ``motor.py:motor``, only with ``trust``,
        * the table itself: ``{kind = "linear", num = [1.0], den = [1.0, 1.0]}``.
    dt
        sample time [s].
    argument
        what messages call the text.
    trust, several
        as for ``plant_of``.

    Raises
    ------
    ValueError
        for any other text, and as ``plant_of``.
    """
    table: Any = text
    name, suffix = argument, Path(text).suffix
    if text.lstrip().startswith("{"):
        table = parsed(argument, f"plant = {text}").get("plant")
    elif suffix == ".toml":
        name, data = read(text)
        if "plant" not in data:
            raise SetupError([f"{name}: plant: missing; give a table [plant]"])
        table = data["plant"]
    elif suffix in (".json", ".fmu"):
        table = {"kind": "identified" if suffix == ".json" else "fmu", "path": text}
    elif ".py:" in text:
        table = {"kind": "python", "source": text}
    elif text not in PLANTS:
        raise ValueError(
            f"{argument} = {text!r}: must be one of {', '.join(plants.TESTBEDS)}, a setup file "
            "(.toml), an identified model (.json), an FMU (.fmu), file.py:name, or a table "
            "{kind = ...}"
        )
    return plant_of(table, dt, name=name, trust=trust, several=several)
