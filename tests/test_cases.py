"""``tests.cases``: one test for many cases hides none of them."""

from __future__ import annotations

import pytest

from .cases import cases

SEEN: list[tuple[int, str]] = []


@cases("n", [1, 2, 3])
@cases(("letter", "number"), [("a", 0), ("b", 1)])
def record(n: int, letter: str, number: int) -> None:
    """Note the case; two of the six fail."""
    SEEN.append((n, letter))
    if n == 2:
        pytest.skip("not two")
    assert (n, number) != (3, 1)


def test_all_cases_run_and_those_that_fail_are_named() -> None:
    """A failure does not end the loop, skipped cases are left out, and the note names the case."""
    SEEN.clear()
    with pytest.raises(AssertionError) as caught:
        record()
    assert [(n, letter) for n in (1, 2, 3) for letter in "ab"] == SEEN
    notes = caught.value.__notes__
    assert "This is the case b-1. 1 of 2 cases fail" in notes[0]
    assert "This is the case 3. 1 of 3 cases fail" in notes[1]


def test_a_test_whose_cases_are_all_skipped_is_skipped() -> None:
    """As a test of its own would be."""

    @cases("n", [1, 2])
    def none(n: int) -> None:
        pytest.skip(f"not {n}")

    with pytest.raises(pytest.skip.Exception, match="not 1"):
        none()
