"""The JSON Schema of setup files says what loading says, as far as a schema can."""

from __future__ import annotations

import json
import math
import tomllib
from typing import Any

import jsonschema
import pytest

from quell.setup import EXAMPLES, registry
from quell.setup.json_schema import json_schema

from .benchmark_module import benchmark
from .cases import cases

pytestmark = pytest.mark.trial

trial = benchmark("setup_schema")


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    """The schema; it takes some seconds."""
    return json_schema()


def test_it_is_json_and_a_schema_of_draft_7(schema: dict[str, Any]) -> None:
    """Without Infinity, which Python's writer of JSON would write."""
    jsonschema.Draft7Validator.check_schema(json.loads(json.dumps(schema, allow_nan=False)))


def test_200_changed_setups_are_judged_as_by_loading() -> None:
    """No setup that loading takes is refused, and what only loading refuses is of a class that no schema expresses."""
    verdicts, faults, only_loading = trial.run(count=200, seed=5)
    assert faults == []
    assert trial.OTHER not in only_loading, only_loading
    assert verdicts["refused by the schema, refused by quell"] > 120
    assert verdicts["taken by the schema, taken by quell"] > 30


@cases(
    ("where", "value", "message"),
    [
        (("observer", "omega_0"), 9.0, "'omega_0' was unexpected"),
        (("observer", "omega_o"), -9.0, "-9.0 is less than or equal to the minimum of 0"),
        (("observer", "order"), 9, "9 is greater than the maximum of 8"),
        (("observer", "form"), "curent", "'curent' is not one of"),
        (("learner", "kind"), "kallman", "'kallman' is not one of"),
        (("dt",), "2 ms", "'2 ms' is not of type 'number'"),
    ],
)
def test_an_error_is_one_line_at_its_key(
    schema: dict[str, Any], where: tuple[str, ...], value: Any, message: str
) -> None:
    """Not at the whole file, as with plain unions: editors mark the key."""
    data = tomllib.loads((EXAMPLES / "two_mass.toml").read_text(encoding="utf-8"))
    table = data
    for key in where[:-1]:
        table = table[key]
    table[where[-1]] = value
    errors = [*jsonschema.Draft7Validator(schema).iter_errors(data)]
    told = [error for error in errors if message in error.message]
    assert len(errors) == len(told) == 1, [error.message for error in errors]
    assert tuple(told[0].absolute_path) in (where, where[:-1])


def test_every_kind_has_its_keys_with_descriptions(schema: dict[str, Any]) -> None:
    """Those of the registries, so that an editor can complete them; most rules come from the checks."""
    definitions = schema["definitions"]
    found = {
        (table["properties"]["kind"]["const"], *table["properties"])
        for table in definitions.values()
        if "const" in table.get("properties", {}).get("kind", {})
    }
    for tables in (registry.LEARNERS, registry.CONTROLLERS, registry.PLANTS, registry.SIGNALS):
        for kind, table in tables.items():
            assert (kind, *table.model_fields) in found
    assert definitions["torsional"]["properties"]["belt"]["description"]
    bits = definitions["torsional"]["properties"]["dac_bits"]
    assert (bits["minimum"], bits["maximum"]) == (2, 32)


def test_what_some_editors_write_for_inf_is_no_error(schema: dict[str, Any]) -> None:
    """Taplo hands on null; a limit may be inf, a bandwidth not."""
    data = tomllib.loads((EXAMPLES / "two_mass.toml").read_text(encoding="utf-8"))
    judge = jsonschema.Draft7Validator(schema)
    data["controller"]["u_max"] = None
    assert judge.is_valid(data)
    data["controller"]["omega_c"] = None
    assert not judge.is_valid(data)


def test_a_limit_may_be_infinite_where_loading_takes_it(schema: dict[str, Any]) -> None:
    """``most_error = inf`` is the default, and zero none."""
    data = tomllib.loads((EXAMPLES / "two_mass.toml").read_text(encoding="utf-8"))
    judge = jsonschema.Draft7Validator(schema)
    for name in ("most_error", "most_f"):
        for value, taken in ((float("inf"), True), ([float("inf"), 1.0], True), (0.0, False)):
            data["rig"] = {"device": "twin", "safety": {name: value}}
            assert judge.is_valid(data) == taken, (name, value)


def test_limits_that_may_be_infinite_are_so_in_the_schema(schema: dict[str, Any]) -> None:
    """``rate_limit = inf`` and ``largest_u = inf`` are taken by both, zero and less by none."""
    judge = jsonschema.Draft7Validator(schema)
    data = tomllib.loads((EXAMPLES / "two_mass.toml").read_text(encoding="utf-8"))
    band = {"y_max": 5.0, "alpha": 4.0, "f_rate": 0.1}
    for value, taken in ((math.inf, True), (30.0, True), (0.0, False), (-1.0, False)):
        data["controller"]["rate_limit"] = value
        assert judge.is_valid(data) == taken
        assert (trial.refusal("two_mass.toml", data) is None) == taken
    data["controller"]["rate_limit"] = math.inf
    for value, taken in ((math.inf, True), (0.0, False), (-1.0, False)):
        data["controller"]["safe_set"] = {**band, "largest_u": value}
        assert judge.is_valid(data) == taken
        told = trial.refusal("two_mass.toml", data)
        assert ("largest_u" not in (told or "")) == taken
