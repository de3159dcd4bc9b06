"""Results of a translation of a program, for the next one.

The translator assumes as much as possible to be constant. Where it finds the opposite, it notes
that here, and the program is translated again, until nothing new is found.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from quell.export.translate.values import Number


@dataclass
class Findings:
    """Numbers and parameters that are not constant.

    Attributes
    ----------
    numbers
        kind of each number in a record of the state that changes, by struct and field.
    parameters
        function and position of each parameter that gets different values.
    is_new
        whether something was found in this translation.
    """

    numbers: dict[tuple[str, str], Number] = field(default_factory=dict)
    parameters: set[Any] = field(default_factory=set)
    is_new: bool = False

    def add_number(self, member: tuple[str, str], kind: Number) -> None:
        """Note that a number changes, and its kind."""
        if self.numbers.get(member) is not kind:
            self.numbers[member] = kind
            self.is_new = True

    def add_parameter(self, key: Any) -> None:
        """Note that a parameter gets different values."""
        if key not in self.parameters:
            self.parameters.add(key)
            self.is_new = True
