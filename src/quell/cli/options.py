"""Arguments that the commands read alike."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter, Token


def whole(kind: Any, tokens: Sequence[Token]) -> int:
    """Read a whole number; the parser's own conversion would round 1.5 to 2 without a word."""
    text = tokens[0].value
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"{tokens[0].keyword} = {text!r}: must be a whole number") from None


Whole = Annotated[int, Parameter(converter=whole)]
WholeOrNone = Annotated[int | None, Parameter(converter=whole)]
JsonFile = Annotated[Path | None, Parameter(name="--json")]
Figures = Annotated[Path | None, Parameter(negative_none="no-")]
