"""Names and units of the signals of a loop: output y, control signal u, disturbances w, and f.

Units are texts. Where two records meet, ``in_one_unit`` compares the units of a signal: those that
convert are converted, as K, °C and °F, and others are refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

from quell import checks
from quell.types import Vector

_TEXT = re.compile(r"\s*([^\[\]]*?)\s*(?:\[([^\[\]]*)\])?\s*")
# A unit that needs brackets before "/s".
_COMPOUND = re.compile(r"[\s/*·]")
_SUPERSCRIPT = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


class Quantity(NamedTuple):
    """A name and a unit; both may be empty."""

    name: str = ""
    unit: str = ""

    def label(self, default: str) -> str:
        """Return the text for an axis: ``angle [rad]``; the ``default`` stands for no name."""
        name = self.name or default
        return f"{name} [{self.unit}]" if self.unit else name

    def __str__(self) -> str:
        return self.label("").strip()


class Signals(NamedTuple):
    """Names and units of the signals of a plant.

    ``Signals.of(y="angle [rad]", u="voltage [V]", w=["load torque [N m]"])`` makes it of texts.
    """

    y: Quantity = Quantity()
    u: Quantity = Quantity()
    w: tuple[Quantity, ...] = ()
    f: Quantity = Quantity()

    @classmethod
    def of(cls, y: Any = "", u: Any = "", w: Any = (), f: Any = "") -> Signals:
        """Return the signals of texts ``name [unit]``, of which w has one for each disturbance.

        f is the total disturbance as the controller estimates it.

        Raises
        ------
        ValueError
            for a text that is not like ``name [unit]``.
        """
        if isinstance(w, str | Quantity):
            w = (w,)
        if not isinstance(w, Iterable):
            raise ValueError(f"w = {w!r:.60}: must be a list of names with units")
        many = tuple(_quantity(f"w[{i}]", each) for i, each in enumerate(w))
        return cls(_quantity("y", y), _quantity("u", u), many, _quantity("f", f))

    @property
    def known(self) -> bool:
        """Whether any name or unit is given."""
        return any(each != Quantity() for each in (self.y, self.u, *self.w, self.f))

    def unit(self, of: str) -> str:
        """Return a unit in which ``y-unit``, ``u-unit`` and ``w-unit`` stand for those known.

        So does ``y-unit/s^n``, the unit of f.
        """
        if self.f.unit:
            of = of.replace("y-unit/s^n", self.f.unit)
        units = {"y-unit": self.y.unit, "u-unit": self.u.unit, "w-unit": self._common_unit}
        for placeholder, unit in units.items():
            if unit and placeholder in of:
                whole = of == placeholder
                text = f"({unit})" if _COMPOUND.search(unit) and not whole else unit
                of = of.replace(placeholder, text)
        return of

    def derivative(self, order: int) -> str:
        """Return the unit of a derivative of y by time; empty if that of y is unknown."""
        if not (self.y.unit and order):
            return self.y.unit
        power = str(order).translate(_SUPERSCRIPT) if order > 1 else ""
        return self.unit(f"y-unit/s{power}")

    def with_f(self, degree: int | None) -> Signals:
        """Return the signals with f in the unit of the derivative of y of this order."""
        unit = "" if degree is None else self.derivative(degree)
        return self._replace(f=Quantity("", unit)) if unit else self

    @property
    def _common_unit(self) -> str:
        units = {each.unit for each in self.w}
        return units.pop() if len(units) == 1 else ", ".join(each.unit or "1" for each in self.w)

    def texts(self) -> dict[str, Any]:
        """Return the arguments of ``of``: texts by signal, without those that are empty."""
        found: dict[str, Any] = {"y": str(self.y), "u": str(self.u), "w": [*map(str, self.w)]}
        found["f"] = str(self.f)
        return {key: value for key, value in found.items() if any(value)}


UNKNOWN = Signals()
"""The signals of a plant that has no names and units."""


class AxesSignals(NamedTuple):
    """Names and units of the signals of several axes.

    ``AxesSignals.of(["x", "y"], y=["way [mm]", ""], u=["force [N]", "force [N]"])`` makes it of
    texts.
    """

    axes: tuple[str, ...]  #: names of the axes
    y: tuple[Quantity, ...]  #: of each axis
    u: tuple[Quantity, ...]  #: of each actuator

    @classmethod
    def of(cls, axes: Any, y: Any, u: Any) -> AxesSignals:
        """Return the signals of names of axes and texts ``name [unit]``; empty ones are unknown.

        Raises
        ------
        ValueError
            for a text that is not like ``name [unit]``, or another number of them than of axes.
        """
        names = tuple(map(str, axes))
        if len(y) != len(names):
            raise ValueError(f"y = {y!r:.60}: must be one for each axis ({', '.join(names)})")
        pairs = zip(names, y, strict=True)
        many = tuple(_quantity(f"signal of {name}", each) for name, each in pairs)
        of_u = tuple(_quantity(f"actuators[{k}]", each) for k, each in enumerate(u))
        return cls(names, many, of_u)

    @property
    def known(self) -> bool:
        """Whether any name or unit is given."""
        return any(each != Quantity() for each in (*self.y, *self.u))

    def labels(self, name: str, width: int) -> list[str]:
        """Return what the entries of a channel are called: of axes and actuators by their names."""
        if name in OF_AXES and len(self.axes) == width:
            return list(self.axes)
        names = [each.name for each in self.u] if name in ("u", "u_wished") else []
        if len(names) != width or not all(names) or len(set(names)) < width:
            return [str(i) for i in range(width)]
        return names

    def units(self, name: str, unit: str, width: int) -> list[str]:
        """Return the unit of each entry of a channel, in which ``y-unit`` is that of its axis."""
        axis, _, channel = name.rpartition(".")
        if axis in self.axes and axis:
            own = Signals(self.y[self.axes.index(axis)])
            if channel == "x_hat" and own.y.unit:
                return [own.derivative(i) for i in range(width)]
            return [own.unit(unit)] * width
        if name in OF_AXES and len(self.y) == width:
            return [Signals(each).unit(unit) for each in self.y]
        if name in ("u", "u_wished") and len(self.u) == width:
            return [each.unit or unit for each in self.u]
        return [unit] * width

    def texts(self) -> dict[str, Any]:
        """Return the arguments of ``of``."""
        return {"axes": list(self.axes), "y": [*map(str, self.y)], "u": [*map(str, self.u)]}


OF_AXES = ("r", "y", "y_measured", "v")
"""Channels of several axes that have a number for each of them."""


def signals_from(texts: Any) -> Any:
    """Return the signals that ``texts`` gave; ``UNKNOWN`` for anything else."""
    try:
        if isinstance(texts, Mapping) and "axes" in texts:
            return AxesSignals.of(**texts)
        return Signals.of(**texts) if isinstance(texts, Mapping) else UNKNOWN
    except (ValueError, TypeError):
        return UNKNOWN


def _quantity(argument: str, given: Any) -> Quantity:
    if isinstance(given, Quantity):
        return given
    found = _TEXT.fullmatch(given) if isinstance(given, str) else None
    if found is None:
        raise ValueError(f"{argument} = {given!r:.60}: must be a name and a unit, like angle [rad]")
    checks.printable(argument, given)
    return Quantity(found[1], (found[2] or "").strip())


# ---- Conversion of units ----


class Conversion(NamedTuple):
    """The value in another unit is ``factor · value + offset``."""

    factor: float = 1.0
    offset: float = 0.0

    @property
    def changes(self) -> bool:
        """Whether it changes any value."""
        return self != Conversion()

    def of(self, values: Vector) -> Vector:
        """Return values in the other unit."""
        return self.factor * values + self.offset if self.changes else values


def conversion(unit: str, wanted: str) -> Conversion | None:
    """Return how values convert from a unit to another; None if they don't, or one is not known.

    Known are SI units and those that machines are logged in, with prefixes, products, quotients and
    powers: ``mN m``, ``Nm``, ``rad/s``, ``rpm``, ``m/s²``, ``°F``, ``%``, ``1``. A temperature
    alone converts with its offset, in ``°C/min`` as a difference.

    Examples
    --------
    >>> conversion("°C", "K")
    Conversion(factor=1.0, offset=273.15)
    >>> conversion("rev", "deg").factor
    360.0
    >>> conversion("V", "rad") is None
    True
    """
    one, other = (" ".join(each.split()) for each in (unit, wanted))
    if one == other:
        return Conversion()
    found, target = _known(one), _known(other)
    if found is None or target is None or found.powers != target.powers:
        return None
    factor, offset = found.factor / target.factor, (found.offset - target.offset) / target.factor
    # Factors such as 1000 and 0.001 are products of rounded ones.
    return Conversion(float(f"{factor:.15g}"), float(f"{offset:.15g}"))


def in_one_unit(
    given: Mapping[str, Quantity], signal: str
) -> tuple[dict[str, Conversion], Quantity, list[str]]:
    """Return how a signal of several records converts to one unit, that of the first that has one.

    Parameters
    ----------
    given
        name and unit of the signal in each record, by the record's name.
    signal
        what it is, for texts: y, u.

    Returns
    -------
    tuple
        the conversion of each record; name and unit of the signal in all of them; and what was
        converted, or assumed where a record has no unit.

    Raises
    ------
    ValueError
        for a unit that does not convert.
    """
    first = next((name for name, each in given.items() if each.unit), None)
    nothing = dict.fromkeys(given, Conversion())
    if first is None:
        return nothing, next(iter(given.values()), Quantity()), []
    wanted, found, notes = given[first], nothing, []
    for name, each in given.items():
        if not each.unit:
            notes.append(f"{signal} of {name} has no unit: taken as {wanted.unit}, as in {first}")
            continue
        known = conversion(each.unit, wanted.unit)
        if known is None:
            raise ValueError(
                f"{name}: {signal} is {each.label(signal)}, in {first} it is "
                f"{wanted.label(signal)}: must be one quantity in units that convert; choose other "
                "columns (--columns), or correct the unit in the header"
            )
        if known.changes:
            notes.append(f"{signal} of {name} is converted from {each.unit} to {wanted.unit}")
        found[name] = known
    return found, wanted, notes


class _Unit(NamedTuple):
    """A unit as powers of the base units, with its factor and offset to them."""

    factor: float
    powers: tuple[int, ...]  # of m, kg, s, A, K, rad, and counts
    offset: float = 0.0


_M, _KG, _S, _A, _K, _RAD, _COUNT = (
    _Unit(1.0, tuple(int(i == k) for i in range(7))) for k in range(7)
)
_ONE = _Unit(1.0, (0,) * 7)


def _times(one: _Unit, other: _Unit, power: int = 1) -> _Unit:
    powers = zip(one.powers, other.powers, strict=True)
    return _Unit(one.factor * other.factor**power, tuple(a + power * b for a, b in powers))


def _scaled(factor: float, unit: _Unit, offset: float = 0.0) -> _Unit:
    return _Unit(factor * unit.factor, unit.powers, offset)


_N = _times(_times(_KG, _M), _S, -2)
_PA, _J = _times(_N, _M, -2), _times(_N, _M)
_W = _times(_J, _S, -1)
_V = _times(_W, _A, -1)
_LITRE = _scaled(1e-3, _times(_times(_M, _M), _M))
_TURN = 2.0 * math.pi
# Units that take a prefix.
_PREFIXED = {
    **{"m": _M, "g": _scaled(1e-3, _KG), "s": _S, "A": _A, "K": _K, "rad": _RAD, "N": _N},
    **{"Nm": _J, "Pa": _PA, "J": _J, "W": _W, "V": _V, "Hz": _times(_ONE, _S, -1)},
    **{"bar": _scaled(1e5, _PA), "l": _LITRE, "L": _LITRE, "Ohm": _times(_V, _A, -1)},
}
_PREFIXES = {
    **{"n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1, "h": 1e2, "k": 1e3, "M": 1e6},
    "G": 1e9,
}
_UNITS = {
    **_PREFIXED,
    **{"1": _ONE, "%": _scaled(0.01, _ONE), "ppm": _scaled(1e-6, _ONE)},
    **{"min": _scaled(60.0, _S), "h": _scaled(3600.0, _S), "d": _scaled(86400.0, _S)},
    **{"in": _scaled(0.0254, _M), "ft": _scaled(0.3048, _M), "t": _scaled(1e3, _KG)},
    **{"deg": _scaled(_TURN / 360.0, _RAD), "rev": _scaled(_TURN, _RAD)},
    **{"rpm": _scaled(_TURN / 60.0, _times(_RAD, _S, -1)), "counts": _COUNT},
    **{"arcmin": _scaled(_TURN / 21600.0, _RAD), "arcsec": _scaled(_TURN / 1296000.0, _RAD)},
    **{"Nmm": _scaled(1e-3, _J), "Ncm": _scaled(1e-2, _J), "lpm": _scaled(1.0 / 60.0, _LITRE)},
    **{"psi": _scaled(6894.757293168, _PA), "lbf": _scaled(4.4482216152605, _N)},
    "°C": _scaled(1.0, _K, 273.15),
    "°F": _scaled(5.0 / 9.0, _K, 459.67 * 5.0 / 9.0),
}
_UNITS["lpm"] = _times(_UNITS["lpm"], _S, -1)
# Other ways to write a unit.
_ALIASES = {
    **dict.fromkeys(("degC", "degc", "celsius", "Celsius", "°c", "C", "ºC", "℃"), "°C"),
    **dict.fromkeys(("degF", "degf", "fahrenheit", "Fahrenheit", "°f", "F", "ºF", "℉"), "°F"),
    **dict.fromkeys(("kelvin", "Kelvin"), "K"),
    **dict.fromkeys(("°", "º", "degree", "degrees"), "deg"),
    **dict.fromkeys(("turn", "turns", "revolution", "revolutions", "cycles"), "rev"),
    **dict.fromkeys(("pct", "percent"), "%"),
    **dict.fromkeys(("volt", "volts", "Volt", "v"), "V"),
    **dict.fromkeys(("ampere", "amperes", "Ampere", "amp", "a"), "A"),
    **{"mv": "mV", "kv": "kV", "uv": "uV", "ma": "mA", "hz": "Hz", "khz": "kHz", "pa": "Pa"},
    **{"kpa": "kPa", "ohm": "Ohm", "Ω": "Ohm", "inch": "in", "inches": "in", '"': "in"},
    **{"w": "W", "kw": "kW", "n": "N", "rad_s": "rad/s", "m_s": "m/s", "count": "counts"},
    **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("hr", "hrs", "hour", "hours"), "h"),
    **dict.fromkeys(("minute", "minutes", "mins"), "min"),
    **dict.fromkeys(("metre", "metres", "meter", "meters"), "m"),
    **{"msec": "ms", "usec": "us", "day": "d", "days": "d", "-": "1"},
}
_SIGNS = str.maketrans({"·": "*", "⋅": "*", "×": "*", "µ": "u", "μ": "u"})
_POWERS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_PARTS = re.compile(r"\s*(\*\*|[*/()^]|-?\d+|[A-Za-z°ºΩ%\"℃℉]+|[⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+)\s*")


def is_known_unit(text: str) -> bool:
    """Return whether a text is a unit that ``conversion`` knows."""
    return _known(" ".join(text.split())) is not None


@lru_cache(maxsize=256)
def _known(text: str) -> _Unit | None:
    """Return the unit of a text; None if it is not known."""
    text = _ALIASES.get(text, text).translate(_SIGNS)
    if (alone := _symbol(text)) is not None:
        return alone
    parts, at = [], 0
    while at < len(text):
        if (part := _PARTS.match(text, at)) is None:
            return None
        parts.append(part[1])
        at = part.end()
    try:
        found = _product(parts)
    except (ValueError, IndexError):
        return None
    return None if parts else found


def _product(parts: list[str]) -> _Unit:
    """Take a product off the front of ``parts``; a quotient holds for the next factor."""
    found, sign = _factor(parts), 1
    while parts and parts[0] != ")":
        sign = 1
        if parts[0] in ("*", "/"):
            sign = 1 if parts.pop(0) == "*" else -1
        found = _times(found, _factor(parts), sign)
    return found


def _factor(parts: list[str]) -> _Unit:
    part = parts.pop(0)
    if part == "(":
        found = _product(parts)
        if parts.pop(0) != ")":
            raise ValueError(part)
    else:
        known = _symbol(part)
        if known is None:
            raise ValueError(part)
        found = known._replace(offset=0.0)
    power = ""
    if parts and parts[0] in ("^", "**"):
        parts.pop(0)
        power = parts.pop(0)
    elif parts and parts[0].translate(_POWERS) != parts[0]:
        power = parts.pop(0).translate(_POWERS)
    return _times(_ONE, found, int(power)) if power else found


def _symbol(text: str) -> _Unit | None:
    """Return the unit of a symbol, perhaps with a prefix."""
    text = _ALIASES.get(text, text)
    if text in _UNITS:
        return _UNITS[text]
    prefix, base = _PREFIXES.get(text[:1]), _PREFIXED.get(text[1:])
    return None if prefix is None or base is None else _scaled(prefix, base)
