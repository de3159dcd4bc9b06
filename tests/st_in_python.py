"""Structured Text as Python: what ``ql.export.st`` writes, line by line, for tests without a compiler of PLCs."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

_TOKEN = re.compile(
    r"\s*(?:(?P<flags>DWORD#16#[0-9A-F]+)|(?P<number>\d+\.\d+(?:E[+-]?\d+)?)|(?P<count>\d+)"
    r"|(?P<name>\w+)|(?P<sign><>|<=|>=|[-+*/=<>()\[\],]))"
)
_LEVELS = (("OR",), ("AND",), ("=", "<>"), ("<", ">", "<=", ">="), ("+", "-"), ("*", "/", "MOD"))
_PYTHON = {"OR": "|", "AND": "&", "=": "==", "<>": "!=", "MOD": "%"}


class _Expression:
    """An expression of Structured Text, written as Python with all parentheses."""

    def __init__(self, text: str) -> None:
        self.tokens = [(m.lastgroup, m[m.lastgroup]) for m in _TOKEN.finditer(text)]
        assert "".join(token for _, token in self.tokens) == text.replace(" ", ""), text

    def next(self) -> str:
        return self.tokens.pop(0)[1]

    def peek(self) -> str:
        return self.tokens[0][1] if self.tokens else ""

    def binary(self, level: int = 0) -> str:
        if level == len(_LEVELS):
            return self.unary()
        left = self.binary(level + 1)
        while self.peek() in _LEVELS[level]:
            sign = self.next()
            left = f"({left} {_PYTHON.get(sign, sign)} {self.binary(level + 1)})"
        return left

    def unary(self) -> str:
        if self.peek() in ("-", "NOT"):
            return f"(-{self.unary()})" if self.next() == "-" else f"(not {self.unary()})"
        kind, token = self.tokens.pop(0)
        if kind == "number":
            return f"real({token})"
        if kind == "flags":
            return f"0x{token[9:]}"
        if kind == "count":
            return token
        if token == "(":
            inside = self.binary()
            assert self.next() == ")"
            return f"({inside})"
        if token in ("TRUE", "FALSE"):
            return token.title()
        place = f"v[{token.lower()!r}]"
        if self.peek() in ("(", "["):
            given, end = [], {"(": ")", "[": "]"}[self.next()]
            while not given or self.peek() == ",":
                if given:
                    self.next()
                given.append(self.binary())
            assert self.next() == end
            arguments = ", ".join(given)
            return f"{token}({arguments})" if end == ")" else f"{place}[{arguments}]"
        return place


def _python(text: str) -> str:
    reader = _Expression(text)
    written = reader.binary()
    assert not reader.tokens, text
    return written


class FunctionBlock:
    """A function block; ``call(r=1.0, y=0.0)`` is a cycle, ``v`` has its variables in lower case."""

    def __init__(self, text: str) -> None:
        text = re.sub(r"\(\*.*?\*\)", "", text, flags=re.S)
        head, _, body = text.partition("END_VAR\n\n")
        self.real: Any = np.float32 if " : REAL" in head else float
        self.v: dict[str, Any] = {}
        self.initial: dict[str, Any] = {}
        for section, declared in re.findall(
            r"(VAR\w*(?: CONSTANT)?)\n(.*?)(?:END_VAR|\Z)", head, re.S
        ):
            declared = re.sub(r"\s+", " ", declared)
            for name, kind, value in re.findall(r"(\w+) : ([^;]*?)(?: := ([^;]*))?;", declared):
                assert name.lower() not in self.v, f"{name} is declared twice"
                self.v[name.lower()] = self._value(kind, value)
                if section == "VAR_TEMP":
                    self.initial[name.lower()] = self.v[name.lower()]
        self.code = compile(self._body(body), "function block", "exec")

    def _value(self, kind: str, value: str) -> Any:
        array = re.fullmatch(r"ARRAY\[(.*)\] OF (\w+)", kind)
        if array:
            shape = [int(each.split("..")[1]) + 1 for each in array[1].split(", ")]
            dtype = self.real if array[2].endswith("REAL") else int
            numbers = value.strip("[]").split(",") if value else [0.0] * int(np.prod(shape))
            return np.array([float(each) for each in numbers], dtype=dtype).reshape(shape)
        if kind == "BOOL":
            return value == "TRUE"
        if kind in ("DWORD", "DINT"):
            return int(value.removeprefix("DWORD#16#"), 16 if "#" in value else 10) if value else 0
        return self.real(value or 0.0)

    def _body(self, text: str) -> str:
        lines, depth = [], 0
        for line in (each.strip() for each in text.splitlines()):
            if line.startswith(("END_IF", "END_FOR", "END_WHILE", "ELSE", "ELSIF")):
                depth -= 1
            if line in ("", "END_FUNCTION_BLOCK") or line.startswith("END_"):
                continue
            written, opens = self._line(line)
            lines.append("    " * depth + written)
            depth += opens
        return "\n".join(lines)

    def _line(self, line: str) -> tuple[str, bool]:
        if found := re.fullmatch(r"(IF|ELSIF|WHILE) (.*) (?:THEN|DO)", line):
            word = {"ELSIF": "elif"}.get(found[1], found[1].lower())
            return f"{word} {_python(found[2])}:", True
        if line == "ELSE":
            return "else:", True
        if found := re.fullmatch(r"FOR (\w+) := (\d+) TO (\d+)(?: BY (-?\d+))? DO", line):
            name, first, last, step = (
                found[1].lower(),
                int(found[2]),
                int(found[3]),
                int(found[4] or 1),
            )
            return (
                f"for v[{name!r}] in range({first}, {last + (1 if step > 0 else -1)}, {step}):",
                True,
            )
        if line in (";", "EXIT;"):
            return {";": "pass", "EXIT;": "break"}[line], False
        target, _, value = line.removesuffix(";").partition(" := ")
        return f"{_python(target)} = {_python(value)}", False

    def call(self, **inputs: Any) -> None:
        """Run a cycle with these inputs; others stay as they are."""
        for name, value in inputs.items():
            assert name in self.v, name
            with np.errstate(over="ignore"):
                self.v[name] = value if isinstance(value, bool) else self.real(value)
        self.v |= self.initial
        known = {"v": self.v, "real": self.real, "ABS": abs, "SEL": lambda which, no, yes: yes if which else no,
                 "SQRT": np.sqrt, "EXPT": pow}  # fmt: skip
        with np.errstate(all="ignore"):
            exec(self.code, known)
