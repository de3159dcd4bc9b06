"""Names in C for names in Python."""

from __future__ import annotations

import re

from quell.export.translate.values import TranslationError

# Keywords of C99 and C++, and names that <math.h>, <string.h> or compilers already have.
KEYWORDS = """auto break case char const continue default do double else enum extern float for goto
    if inline int long register restrict return short signed sizeof static struct switch
    typedef union unsigned void volatile while _Bool _Complex _Imaginary alignas alignof
    and and_eq asm bitand bitor bool catch char16_t char32_t char8_t class co_await
    co_return co_yield compl concept const_cast consteval constexpr constinit decltype
    delete dynamic_cast explicit export false friend mutable namespace new noexcept not
    not_eq nullptr operator or or_eq private protected public reinterpret_cast requires
    static_assert static_cast template this thread_local throw true try typeid typename
    using virtual wchar_t xor xor_eq"""
# Headers of C99, POSIX and C++ that a file of this name would hide, on Windows in any spelling.
_HEADERS = """algorithm array assert atomic bit complex ctype errno fenv float fstream functional
    inttypes iomanip ios iostream iso646 limits list locale map math memory new random regex set
    setjmp signal stack stdalign stdarg stdatomic stdbool stddef stdint stdio stdlib stdnoreturn
    string strings tgmath thread threads time tuple uchar unistd utility vector wchar wctype"""
# External names of more characters are no problem for today's linkers; files are.
_LONGEST = 63
_TAKEN = """abs acos asin atan ceil clear copysign cos cosh erf exp fabs floor fmax fmin fmod gamma
    hypot index j0 j1 jn log log2 logb main memcpy memset modf pow read remainder remove
    rename rint round signal sin sinh sqrt tan tanh tgamma trunc write y0 y1 yn"""


def checked_name(name: str) -> str:
    """Return the name of a controller or model, which begins all its public names in C.

    Raises
    ------
    TranslationError
        if it is no identifier, a keyword of C or C++, or the name of a standard header.
    """
    if not (isinstance(name, str) and re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name)):
        rule = "must be a C identifier: a letter, and then letters, digits and _"
        raise TranslationError(f"name = {name!r}: {rule}")
    if len(name) > _LONGEST:
        raise TranslationError(f"name = {name!r}: must have {_LONGEST} characters at most")
    if name in KEYWORDS.split() or name in ("NULL", "main"):
        raise TranslationError(f"name = {name!r}: is a keyword of C or C++; choose another name")
    if name.lower() in _HEADERS.split():
        rule = f"{name}.h would hide the standard header; choose another name"
        raise TranslationError(f"name = {name!r}: {rule}")
    return name


def identifier(name: str) -> str:
    """Return a name that C allows for a variable, a field or a parameter."""
    return f"{name}_" if name in KEYWORDS.split() else name


def function_name(name: str) -> str:
    """Return a name that C allows for a function of this program."""
    name = name.lstrip("_")
    return f"{name}_" if name in f"{KEYWORDS} {_TAKEN}".split() else name


def snake_case(name: str) -> str:
    """Return ``GuardMemory`` as ``guard_memory``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.lstrip("_")).lower()


def unique(name: str, taken: set[str]) -> str:
    """Return ``name``, with a number if it is taken, and add it to ``taken``."""
    found, number = name, 2
    while found in taken:
        found, number = f"{name}_{number}", number + 1
    taken.add(found)
    return found
