"""The JSON Schema of setup files, by which editors complete and check TOML.

It is made of the tables that loading uses: keys, types and descriptions from their models, ranges
and choices from the checks of the classes that the tables call. Each class is asked: it is called
with a value that every check refuses, and the error carries the rule (``checks.broken``).
"""

from __future__ import annotations

import json
import math
import types
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from itertools import chain, count
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue

from quell import checks
from quell.controllers.adrc import ADRC
from quell.observers.eso import ESO
from quell.plants.linear import LinearPlant
from quell.plants.registry import RUN_CODE
from quell.setup.axes import AxesDescription
from quell.setup.description import OF_AXES, Description
from quell.setup.loading import check_window
from quell.setup.schema import CallTable, parameters_of

DRAFT = "http://json-schema.org/draft-07/schema#"
"""The version of JSON Schema; the newest that editors of TOML read without exceptions."""

NONE = {"const": "none"}
"""Python's None, as a setup file writes it."""


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 7) of setup files, of one axis and of several.

    A file that breaks it is refused by ``quell.setup.load``. The opposite is not true: relations
    between values, files that a setup names, and nan are checked when a file is loaded
    (``benchmarks/setup_schema.py`` counts them).

    Examples
    --------
    >>> found = json_schema()["definitions"]["model-free"]["properties"]["omega_o"]
    >>> found["type"], found["exclusiveMinimum"]
    ('number', 0)
    """
    generator = _Generator(ref_template="#/definitions/{model}")
    inputs = [
        (model, "validation", model.__pydantic_core_schema__)
        for model in (Description, AxesDescription)
    ]
    roots, definitions = generator.generate_definitions(inputs)  # type: ignore[arg-type]
    one, several = (roots[model, "validation"] for model in (Description, AxesDescription))
    names = _Names([*map(str, definitions)])
    return {
        "$schema": DRAFT,
        "title": "Setup file of quell",
        **_if({"anyOf": [{"required": [key]} for key in OF_AXES]}, several, one),
        "definitions": {key: names.shortened(value) for key, value in definitions.items()}
        | names.added,
    }


def _if(condition: Any, then: Any, otherwise: Any) -> dict[str, Any]:
    """Return one of two schemas, by a condition: errors are then those of this one.

    Editors that complete keys, as Taplo does, look for them in ``anyOf``, but not behind a
    condition. Here it has the same schemas once more, and holds always.
    """
    return {"if": condition, "then": then, "else": otherwise, "anyOf": [{}, then, otherwise]}


class _Names:
    """Names of unions of tables, which have many places but one definition."""

    def __init__(self, definitions: Sequence[str]) -> None:
        self.added: dict[str, Any] = {}
        self._known: dict[str, str] = {}
        self._used = set(definitions)

    def shortened(self, schema: Any, name: str = "") -> Any:
        """Return a schema with references in place of unions; ``name`` is the key that it is of."""
        if isinstance(schema, list):
            return [self.shortened(part, name) for part in schema]
        if not isinstance(schema, dict):
            return schema
        found = {
            key: {each: self.shortened(part, each) for each, part in value.items()}
            if key == "properties"
            else self.shortened(value, name)
            for key, value in schema.items()
        }
        union = {key: value for key, value in found.items() if key in _UNION}
        if len(union) < len(_UNION) or name == "":
            return found
        text = json.dumps(union, sort_keys=True)
        if text not in self._known:
            place = next(n for n in _numbered(f"{name}-of-any-kind") if n not in self._used)
            self._used.add(place)
            self._known[text], self.added[place] = place, union
        rest = {key: value for key, value in found.items() if key not in _UNION}
        return {**rest, "allOf": [{"$ref": f"#/definitions/{self._known[text]}"}]}


_UNION = ("if", "then", "else", "anyOf")


def _numbered(name: str) -> Iterator[str]:
    return chain((name,), (f"{name}-{i}" for i in count(2)))


class _Generator(GenerateJsonSchema):
    """Pydantic's generator, with what a setup file has of its own."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False

    def nullable_schema(self, schema: Any) -> JsonSchemaValue:
        found = self.generate_inner(schema["schema"])
        if "else" in found:  # a table of several kinds
            return {**found, "else": {"anyOf": [*found["else"]["anyOf"], NONE]}}
        if "$ref" in found:
            return _if(NONE, NONE, found)
        choices = found["anyOf"] if [*found] == ["anyOf"] else [found]
        return {"anyOf": [*choices, NONE]}

    def null_schema(self, schema: Any) -> JsonSchemaValue:
        return dict(NONE)

    def float_schema(self, schema: Any) -> JsonSchemaValue:
        return {"type": list(_NUMBER)}

    def str_schema(self, schema: Any) -> JsonSchemaValue:
        return {**super().str_schema(schema), "not": NONE}

    def default_schema(self, schema: Any) -> JsonSchemaValue:
        found = super().default_schema(schema)
        value = found.get("default")
        if isinstance(value, float) and not math.isfinite(value):
            del found["default"]  # JSON has no such number
        if "default" in found and value is None:
            del found["default"]  # the description says what a missing key means
        return found

    def tuple_schema(self, schema: Any) -> JsonSchemaValue:
        found = super().tuple_schema(schema)
        if "prefixItems" in found:  # a word of later drafts
            found["items"] = found.pop("prefixItems")
            found["additionalItems"] = False
        return found

    def tagged_union_schema(self, schema: Any) -> JsonSchemaValue:
        """Return a table of one of several kinds; a text is the kind of a table without keys."""
        tables, default = schema["discriminator"].tables, schema["discriminator"].default
        table: list[JsonSchemaValue] = []
        others: list[JsonSchemaValue] = []
        for kind, choice in schema["choices"].items():
            inner = self.generate_inner(choice)
            if kind in tables:
                same: JsonSchemaValue = {"properties": {"kind": {"const": kind}}}
                same |= {"required": ["kind"]} if kind != default else {}
                table.append({"if": same, "then": inner})
            else:  # a number, a flag or a list; numbers alone are no sum of signals
                a_sum = kind == "list" and "number" in schema["choices"]
                signal = {"contains": {"type": ["object", "string"]}}
                others.append({**inner, **(signal if a_sum else {})})
        short = [
            kind
            for kind in tables
            if not any(field.is_required() for field in tables[kind].model_fields.values())
        ]
        if short:
            others.append({"enum": short})
        needed = {} if default in tables else {"required": ["kind"]}
        kinds = {"properties": {"kind": {"enum": [*tables], "description": "which one."}}}
        then = {"type": "object", **needed, **kinds, "allOf": table}
        found = _if({"type": "object"}, then, {"anyOf": others or [{"type": "object"}]})
        return {**found, "anyOf": [{}, *(each["then"] for each in table)]}

    def model_schema(self, schema: Any) -> JsonSchemaValue:
        """Return the keys of a table, with the rules of the class that it calls."""
        found = super().model_schema(schema)
        table = schema["cls"]
        found.pop("title", None)
        properties = found.setdefault("properties", {})
        for key, field in table.model_fields.items():
            if key in properties:
                properties[key] = _joined(properties[key], _rule(table, key), field.default is None)
        return found


def _joined(written: JsonSchemaValue, rule: Mapping[str, Any], optional: bool) -> JsonSchemaValue:
    """Return the schema of a key with a rule; a key whose default is None may be ``none``."""
    if not rule:
        return written
    if written.get("type") == list(_NUMBER) and "maximum" in rule:
        written = {**written, "type": "number"}  # it must be finite
    if "enum" in rule:
        rule = {"enum": [*rule["enum"], *(["none"] if optional else [])]}
        if "anyOf" in written:  # a text, or lists of them
            others = [each for each in written["anyOf"] if each.get("type") != "string"]
            rule = {"anyOf": [*others, rule]}
        return {**{key: written[key] for key in written if key not in _OF_TEXT}, **rule}
    if rule.get("type") == checks.NUMBERS["type"]:  # of a key whose type its annotation leaves open
        if written.keys() & {"type", "anyOf", "$ref", "if"}:
            return written
        return {**written, **({"anyOf": [rule, NONE]} if optional else rule)}
    # Rules of numbers hold for numbers only, and rules of items for lists only.
    rule = {key: value for key, value in rule.items() if key != "type"}
    return {**written, "allOf": [rule]} if "items" in rule else {**written, **rule}


# Some editors, as Taplo, have null in the place of inf, which JSON cannot write.
_NUMBER = ("number", "null")
# Words of the type of a text, which its choices replace.
_OF_TEXT = ("type", "not", "anyOf")


# ---- The rules of a class, from its checks ----


def _rule(table: type[BaseModel], key: str) -> Mapping[str, Any]:
    """Return the rule of a key in JSON Schema; empty if no check tells one."""
    if table in (Description, AxesDescription) and key == "dt":
        return _told(lambda: checks.positive("dt", math.nan), "dt")
    if not issubclass(table, CallTable) or table.function in RUN_CODE or key in table.beside:
        return {}
    return _rules(table).get(key, {})


@cache
def _rules(table: type[CallTable]) -> dict[str, Mapping[str, Any]]:
    """Return the rules of a table's keys.

    A rule that depends on other arguments is left out: it is asked for with several sets of them.
    """
    takes = parameters_of(table.function)
    function = check_window if "self" in takes else table.function
    found: dict[str, Mapping[str, Any]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sets = [_settled(function, given) for given in _arguments(table)]
        for key, field in table.model_fields.items():
            for probe in _refused(field.annotation) if key != "kind" else ():
                calls = (partial(function, **{**arguments, key: probe}) for arguments in sets)
                rules = [_told(call, key) for call in calls]
                rules = [rule for rule in rules if rule]
                if rules and all(rule == rules[0] for rule in rules):
                    of_entries = _kinds(field.annotation) <= {tuple, types.NoneType}
                    is_named = not rules[0].keys() & {"items", "type", "enum"}
                    rule = {"items": rules[0]} if of_entries and is_named else rules[0]
                    found[key] = {**found.get(key, {}), **rule}
    return found


def _told(call: Callable[[], Any], key: str) -> Mapping[str, Any]:
    """Return the rule that the error of a call tells of an argument; empty if it tells none."""
    name, rule = _error_of(call)
    if name.startswith(f"{key}["):  # of an entry
        return {"items": rule}
    return rule if name == key else {}


def _error_of(call: Callable[[], Any]) -> tuple[str, Mapping[str, Any]]:
    try:
        call()
    except Exception as error:  # of arguments that fit nothing, any kind
        name, rule = getattr(error, "rule", ("", {}))
        return name, rule
    return "", {}


def _refused(annotation: Any) -> tuple[Any, ...]:
    """Return values of a type, or nearly, that checks refuse."""
    kinds = _kinds(annotation)
    if float in kinds:
        return (math.nan, 0.0, (-1.0,)) if tuple in kinds else (math.nan, 0.0)
    if int in kinds:
        return (0.5,)
    if tuple in kinds and str not in kinds:
        return ((-1.0,), (math.nan, math.nan))
    return ("\x00",)  # a text, or numbers


def _kinds(annotation: Any) -> set[Any]:
    """Return the types that an annotation allows, without their contents."""
    origin = get_origin(annotation)
    if origin in (Union, types.UnionType):
        return {kind for part in get_args(annotation) for kind in _kinds(part)}
    return {origin or annotation}


# Parameters of a class by type, in two sets that have no number in common.
_VALUES: tuple[Mapping[Any, Any], ...] = (
    {float: 1.0, int: 2, bool: False, tuple: (1.0, 2.0), str: "\x00"},
    {float: 1.37, int: 3, bool: False, tuple: (1.37, 2.7, 3.1), str: "\x00"},
)


def _arguments(table: type[CallTable]) -> Iterator[dict[str, Any]]:
    """Yield sets of arguments that fit the types of a table's keys.

    The last one has numbers for the optional keys, too.
    """
    for number, whole in ((0, False), (1, False), (1, True)):
        values = _VALUES[number]
        made: dict[str, Any] = {}
        for key, field in table.model_fields.items():
            kinds = _kinds(field.annotation)
            known = next((values[kind] for kind in values if kind in kinds), 1.0)
            if field.is_required():
                part = _part(field.annotation, number)
                made[key] = plant(number) if key == "plant" else known if part is None else part
            elif whole and type(field.default) in (int, float) and math.isfinite(field.default):
                step = 1 if isinstance(field.default, int) else 0.37 * field.default
                made[key] = field.default + step
        takes = parameters_of(table.function)
        context = {"dt": values[float] * 1e-3, "plant": plant(number), "observer": observer(number)}
        context["axes"] = {"one": ADRC(observer(number), omega_c=1.0)}
        needed = {key: context[key] for key in context.keys() & takes.keys()}
        made = {**needed, **made}
        made.pop("kind", None)
        yield made


def _part(annotation: Any, number: int) -> Any:
    """Return the object of a table within a table; None for other types."""
    if isinstance(annotation, type) and issubclass(annotation, CallTable):
        return annotation.function(**[*_arguments(annotation)][number])
    return None


def plant(number: int) -> LinearPlant:
    """Return a plant for questions: a chain of two or three integrators."""
    order = 2 + number
    A = [[float(j == i + 1) for j in range(order)] for i in range(order)]
    ends = [float(i == order - 1) for i in range(order)]
    return LinearPlant(A, ends, ends[::-1])


def observer(number: int) -> ESO:
    """Return an observer for questions."""
    return ESO.model_free(2 + number, b0=1.0, omega_o=10.0, dt=1e-3)


def _settled(function: Callable[..., Any], arguments: dict[str, Any]) -> dict[str, Any]:
    """Return arguments that keep the rules that the function tells, one by one."""
    arguments = dict(arguments)
    for _ in range(len(arguments)):
        key, rule = _error_of(lambda: function(**arguments))
        if key not in arguments:
            break
        value = _allowed(rule, arguments[key])
        if value is None:
            break
        arguments[key] = value
    return arguments


def _allowed(rule: Mapping[str, Any], value: Any) -> Any:
    """Return a value that a rule allows; None if that is not clear."""
    if "enum" in rule:
        return rule["enum"][0]
    if rule.get("type") == "integer":
        return rule.get("minimum")
    if rule.get("type") == ["number", "array"]:
        return [1.0, 2.0]
    return None
