"""The results of the commit that made the golden corpus are those of today.

A failing test names each case that changed and says where. If a change is meant:
``python -m tests.golden.make --part loops --only '017*' --reason "why"``.
"""

from __future__ import annotations

from typing import Any

import pytest

from tests.in_c import needs_gcc

from . import corpus, make, parts

pytestmark = pytest.mark.filterwarnings("ignore")


def check(part: str, share: tuple[int, int] = (0, 1), only: Any = ("*",)) -> None:
    """Run a share of the cases of a part; fail with a line for each that changed."""
    found, cases = [], parts.chosen(part, only, share)
    assert cases
    for case in cases:
        told = parts.changes(part, case, parts.run(part, case))
        found += [f"{part} {case['name']}: {line}" for line in told]
    assert not found, "\n" + "\n".join(found)


# Parts that take turns in the gate (.ci/steps/corpus.sh), as they take longest.
TURNS = 3
# Ten that are quick: laws, learners, guards, limits, several axes, single precision.
QUICK = ("001*", "006*", "023*", "047*", "120*", "175*", "190*", "225*", "250*", "290*")


@pytest.mark.parametrize("i", range(5))
def test_some_loops_have_the_stored_bits(i: int) -> None:
    """A sample of the corpus, so that a change of bits is seen by the quick tests."""
    check("loops", only=QUICK[i::5])


@pytest.mark.trial
@pytest.mark.parametrize("i", range(6))
def test_interpreted_loops_have_the_stored_bits(i: int) -> None:
    """Each channel of each log; of those with a ``why`` some numbers."""
    check("loops", (i, 6))


@pytest.mark.trial
@pytest.mark.parametrize("i", range(2))
def test_driven_controllers_have_the_stored_bits(i: int) -> None:
    """With NaN in r and y, manual operation, starts, limits that change and memory images."""
    check("driven", (i, 2))


@pytest.mark.trial
@needs_gcc
@pytest.mark.parametrize("i", range(4))
def test_exported_controllers_have_the_stored_bits(i: int) -> None:
    """Their C code gives u and all that it knows as the interpreted kernels did.

    Where it did not, as with ``expf`` of the C library, it gives what it gave itself.
    """
    found, cases = [], [case for case in corpus.cases_of("driven") if case["c"]][i::4]
    for case in cases:
        stored = {**case, "stored": case.get("stored_in_c", case["stored"])}
        told = parts.changes("driven", stored, parts.run_in_c(case))
        found += [f"{case['name']} in C: {line}" for line in told]
    assert cases
    assert not found, "\n" + "\n".join(found)


@pytest.mark.trial
@pytest.mark.compiled
@pytest.mark.parametrize("i", range(TURNS))
def test_compiled_loops_have_the_stored_numbers(i: int) -> None:
    """Within 1e-9 of the largest: compiled code contracts products and sums."""
    check("compiled", (i, TURNS))


@pytest.mark.trial
@pytest.mark.parametrize("i", range(TURNS))
def test_tunings_have_the_stored_results(i: int) -> None:
    """Numbers within 1e-6; verdicts, warnings and refusals word by word."""
    check("tuned", (i, TURNS))


@pytest.mark.trial
def test_identifications_have_the_stored_results() -> None:
    """Models, gains and their deviations from made records; refusals word by word."""
    check("identified")


@pytest.mark.trial
@pytest.mark.parametrize("i", range(2))
def test_commands_have_the_stored_results(i: int) -> None:
    """Exit codes, verdicts, errors, results in JSON, and the files that are written."""
    check("commands", (i, 2))


@pytest.mark.trial
def test_memory_images_of_then_go_on_now() -> None:
    """Images of the commit that made the corpus: their next 50 samples, running and after a start."""
    check("memory")


@pytest.mark.trial
def test_setup_files_of_then_give_the_stored_runs() -> None:
    """Files of all kinds load, and their loops have the stored bits."""
    check("setups")


def test_a_difference_says_where_it_is() -> None:
    """One bit of one sample of one channel is found, and named with its quarter."""
    log = {"y": [[0.1 * k] for k in range(40)], "u": [[1.0] for _ in range(40)]}
    log = {name: corpus.np.array(values) for name, values in log.items()}
    before = corpus.outcome_of(log, 0)
    assert not corpus.differences(before, corpus.outcome_of(log, 0))
    log["y"][25, 0] = corpus.np.nextafter(log["y"][25, 0], 9.0)
    (told,) = corpus.differences(before, corpus.outcome_of(log, 0))
    assert "quarter 3 of 4" in told
    assert "in y;" in told
    assert not corpus.differences(before, corpus.outcome_of(log, 0), why="the machine")
    log["y"][39, 0] *= 1.0 + 1e-8
    (told,) = corpus.differences(before, corpus.outcome_of(log, 0), why="the machine")
    assert "1e-08" in told
    (told,) = corpus.differences(before, corpus.outcome_of(log, 4), why="")[:1]
    assert told == "status is 4, was 0"


def test_trees_differ_where_a_number_or_a_text_does() -> None:
    """A path, and both values; numbers within the tolerance do not count."""
    stored: Any = {"a": [1.0, 2.0], "text": "NOT so", "none": None}
    assert not [*corpus.tree_differences(stored, {**stored, "a": [1.0, 2.0 + 1e-7]}, 1e-6)]
    now: Any = {"a": [1.0, 2.1], "text": "NOT that", "new": True}
    told = [*corpus.tree_differences(stored, now, 1e-6)]
    assert [each.split()[0] for each in told] == ["a[1]", "text", "none", "new"]


def test_results_are_written_with_a_reason_only(capsys: pytest.CaptureFixture[str]) -> None:
    """A part without a reason, and a reason without a part, are refused."""
    for arguments in (["--part", "loops"], ["--reason", "because of it"], ["--only", "001*"]):
        with pytest.raises(SystemExit) as ended:
            make.main(arguments)
        assert ended.value.code == 2
    assert "--reason: missing" in capsys.readouterr().err
    reasons = [each for part in parts.PARTS for each in corpus.read(part)["written"]]
    assert all({"date", "names", "reason", "with"} <= each.keys() for each in reasons)


def test_every_case_has_a_name_of_its_own_and_a_result() -> None:
    """So that one case can be named; the data stay below two megabytes."""
    for part in parts.PARTS:
        cases = corpus.cases_of(part)
        assert len({case["name"] for case in cases}) == len(cases), part
        assert all("stored" in case for case in cases), part
    assert sum(file.stat().st_size for file in corpus.DATA.glob("*.json")) < 2e6
