"""Status."""

import re

from quell import Status


def test_every_flag_has_a_message_that_says_what_to_do_or_what_was_done() -> None:
    """No status is a bare code: each has sentences of its own."""
    messages = [flag.message for flag in Status]
    assert len(set(messages)) == len(Status)
    for message in messages:
        assert re.fullmatch(r"[A-Z][^.]*(: |; | and )[^.]*[a-z0-9]\.", message), message


def test_messages_of_several_flags_add_up_and_ok_is_well() -> None:
    """Flags are reported together; none is good news."""
    both = Status.MEASUREMENT_HELD | Status.SATURATED
    assert Status.MEASUREMENT_HELD.message in both.message
    assert Status.SATURATED.message in both.message
    assert Status.OK.message == "No step reported a problem."
