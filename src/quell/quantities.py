"""Names and units of the signals of a loop: output y, control signal u, disturbances w, and f."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from quell import checks

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
