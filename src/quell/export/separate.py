"""The arrays of a controller's state as objects of their own, for a second run of a proof.

The analysis takes the state for one object: a pointer into one of its arrays may run into the next
one unseen, as ``memory_get_all`` does that copies 4 numbers into an array of 3. Here the header of
the exported controller is written with pointers in place of these arrays, and with a function that
gives each of them an array of its own, of the same length; the file with the code stays as it is
delivered. An index that leaves an array then leaves an object, which the analysis knows.

``memset`` of a struct would clear the pointers, so a macro clears what they point to. What is in a
union stays in it, as its members have the same memory.
"""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from quell.export.c_files import CSource

HEADER = "separate.h"
"""End of the file's name, which stands for the header of the controller."""

_STRUCT = re.compile(r"typedef struct \{\n(.*?)\n\} (\w+);", re.S)
_UNION = re.compile(r"^    union \{\n(.*?)\n    \} (\w+);", re.M | re.S)
_MEMBER = re.compile(r"^\s*(?:const )?(\w+) (\**)(\w+)((?:\[\d+\])*);", re.M)


class _Member(NamedTuple):
    """A member of a struct, with the lengths of its array if it is one."""

    kind: str
    name: str
    lengths: tuple[int, ...]
    pointer: bool


class Separated(NamedTuple):
    """A header in which arrays are pointers, how many they are, and which are left as they were."""

    header: str
    number: int
    left: tuple[str, ...]


def separated(source: CSource) -> Separated:
    """Return the header with the arrays of the state as objects of their own.

    Arrays of structs that the code has as variables, too, or that are in the parameters, are left:
    there an array has to be one. So are those in a union, whose members have the same memory. The
    indices of these are known from the text alone.
    """
    name = source.name
    structs: dict[str, list[_Member]] = {}
    unions: dict[str, list[_Member]] = {}
    for body, kind in _STRUCT.findall(source.header):
        code = re.sub(r"/\*.*?\*/", "", body, flags=re.S)
        structs[kind] = _members(_UNION.sub(r"    union \2;", code))
        unions |= {f"{kind}.{union}": _members(inside) for inside, union in _UNION.findall(code)}
    state = f"{name}_state"
    shared = {kind for inside in unions.values() for each in inside
              for kind in _reached(structs, each.kind)}  # fmt: skip
    kept = shared | _reached(structs, f"{name}_parameters") | {
        kind for kind in structs if kind != state
        and re.search(rf"^\s+(?:const )?{kind} \w+(?: =|;|\[)", source.source, re.M)
    }  # fmt: skip
    changed = _reached(structs, state) - kept
    header = _STRUCT.sub(
        lambda found: _with_pointers(found[0]) if found[2] in changed else found[0], source.header
    )
    arrays: list[str] = []
    places: list[str] = []
    _give(structs, changed, state, "state->", arrays, places)
    reached = (_reached(structs, state) | shared) & kept
    known = {kind: structs[kind] for kind in reached & structs.keys()} | unions
    left = [f"{kind}.{each.name}" for kind in sorted(known)
            for each in known[kind] if each.lengths]  # fmt: skip
    with_arrays = [kind for kind in structs
                   if kind in changed and _has_arrays(structs, changed, kind)]  # fmt: skip
    text = [
        f"/* {name}.h with the arrays of the state as objects of their own, see prove.sh. */",
        "#include <string.h>",
        header,
        *arrays,
        "",
        f"static void separate_arrays({state} *state)",
        "{",
        *(f"    {each}" for each in places),
        "}",
        *(line for kind in with_arrays for line in _clear(structs, changed, kind)),
        "",
        "#define SEPARATE_ARRAYS",
        "#define memset(place, value, size) ( \\",
        *(f"    __builtin_types_compatible_p(__typeof__(place), {kind} *) \\\n"
          f"        ? clear_{kind}((void *)(place)) : \\" for kind in with_arrays),
        "    (memset)((void *)(place), value, size))",
        "",
    ]  # fmt: skip
    return Separated("\n".join(text), len(arrays), tuple(left))


def _members(body: str) -> list[_Member]:
    return [
        _Member(kind, member, tuple(map(int, re.findall(r"\d+", sizes))), bool(star))
        for kind, star, member, sizes in _MEMBER.findall(body)
    ]


def _reached(structs: dict[str, list[_Member]], kind: str) -> set[str]:
    """Return the structs that are in one, and itself."""
    found = {kind}
    for member in structs.get(kind, []):
        if member.kind in structs and not member.pointer:
            found |= _reached(structs, member.kind)
    return found


def _has_arrays(structs: dict[str, list[_Member]], changed: set[str], kind: str) -> bool:
    return any(each.lengths or (each.kind in changed and not each.pointer
                                and _has_arrays(structs, changed, each.kind))
               for each in structs[kind])  # fmt: skip


def _with_pointers(struct: str) -> str:
    """Return a struct whose arrays are pointers: ``double z[3]`` becomes ``double (*z)``."""
    return re.sub(r"^(    \w+ )(\w+)\[\d+\]((?:\[\d+\])*;)", r"\1(*\2)\3", struct, flags=re.M)


def _give(
    structs: dict[str, list[_Member]], changed: set[str], kind: str, path: str,
    arrays: list[str], places: list[str],
) -> None:  # fmt: skip
    """Write the arrays of a struct at a path, and the statements that give them to it."""
    for each in structs[kind]:
        inner = each.kind in changed and not each.pointer
        if each.lengths:
            own = f"separate_{len(arrays)}"
            sizes = "".join(f"[{length}]" for length in each.lengths)
            arrays.append(f"static {each.kind} {own}{sizes};")
            places.append(f"{path}{each.name} = {own};")
            if inner and _has_arrays(structs, changed, each.kind):
                for k in range(each.lengths[0]):
                    _give(structs, changed, each.kind, f"{own}[{k}].", arrays, places)
        elif inner:
            _give(structs, changed, each.kind, f"{path}{each.name}.", arrays, places)


def _clear(structs: dict[str, list[_Member]], changed: set[str], kind: str) -> list[str]:
    """Return the function that does what ``memset`` with 0 does to a struct with its arrays."""
    lines = ["", f"static void *clear_{kind}({kind} *place)", "{"]  # fmt: skip
    for each in structs[kind]:
        inner = each.kind in changed and not each.pointer
        inner = inner and _has_arrays(structs, changed, each.kind)
        if each.lengths and inner:
            lines += [f"    clear_{each.kind}(&place->{each.name}[{k}]);"
                      for k in range(math.prod(each.lengths))]  # fmt: skip
        elif each.lengths:
            count = math.prod(each.lengths)
            lines.append(
                f"    (void)(memset)(place->{each.name}, 0, {count} * sizeof({each.kind}));"
            )
        elif inner:
            lines.append(f"    clear_{each.kind}(&place->{each.name});")
        else:
            lines.append(f"    (void)(memset)(&place->{each.name}, 0, sizeof place->{each.name});")
    return [*lines, "    return place;", "}"]
