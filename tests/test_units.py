"""Units where two records meet: what converts is converted and said, what does not is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.commissioning import measured_records
from quell.identification import Measured, read_record
from quell.identification.record_file import in_common_units
from quell.monitoring import Machine, rank
from quell.monitoring.windows import Signals as WindowSignals
from quell.quantities import AxesSignals, Quantity, Signals, conversion, in_one_unit
from quell.records.units import runs_in_common_units


@pytest.mark.parametrize(
    ("unit", "wanted", "value", "expected"),
    [
        ("°C", "K", 20.0, 293.15),
        ("K", "°F", 273.15, 32.0),
        ("degF", "°C", 212.0, 100.0),
        ("mm", "m", 1500.0, 1.5),
        ("µm", "in", 25400.0, 1.0),
        ("rev", "deg", 0.5, 180.0),
        ("rad", "deg", math.pi, 180.0),
        ("N m", "mN m", 0.2, 200.0),
        ("Nm", "N·mm", 0.2, 200.0),
        ("mV", "V", 12.0, 0.012),
        ("ms", "s", 12.0, 0.012),
        ("%", "1", 40.0, 0.4),
        ("rpm", "rad/s", 60.0, 2.0 * math.pi),
        ("m/s²", "mm/s^2", 9.81, 9810.0),
        ("°C/min", "K/s", 60.0, 1.0),
        ("V/(rad/s)", "V s rad⁻¹", 3.0, 3.0),
        ("left", "left", 3.0, 3.0),
    ],
)
def test_a_unit_converts_to_another_of_the_same_quantity(
    unit: str, wanted: str, value: float, expected: float
) -> None:
    """There and back; a temperature alone has an offset, a rate of it has none."""
    there, back = conversion(unit, wanted), conversion(wanted, unit)
    assert there is not None
    assert back is not None
    (found,) = there.of(np.array([value]))
    assert found == pytest.approx(expected, rel=1e-12)
    assert back.of(np.array([found]))[0] == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(
    ("unit", "wanted"),
    [("V", "rad"), ("°C", "%"), ("left", "right"), ("counts", "V"), ("", "V"), ("nm", "Nm"), ("(", "m")],
)  # fmt: skip
def test_other_units_do_not_convert(unit: str, wanted: str) -> None:
    """Other quantities, words that are no units, and none."""
    assert conversion(unit, wanted) is None


def test_a_record_without_a_unit_is_taken_as_the_others_and_that_is_said() -> None:
    """The first unit that there is holds for all."""
    given = {"a": Quantity("T", ""), "b": Quantity("T", "K"), "c": Quantity("T", "°C")}
    found, wanted, notes = in_one_unit(given, "y")
    assert [found[name].offset for name in "abc"] == [0.0, 0.0, 273.15]
    assert wanted == Quantity("T", "K")
    assert notes == [
        "y of a has no unit: taken as K, as in b",
        "y of c is converted from °C to K",
    ]
    with pytest.raises(ValueError, match=r"d: y is speed \[rpm\], in b it is T \[K\]: must be one"):
        in_one_unit(given | {"d": Quantity("speed", "rpm")}, "y")


def written(path: Path, header: str, y: Any, u: Any, r: Any = None) -> Path:
    """Write a table of t, u, y and perhaps r."""
    columns = [0.1 * np.arange(len(y)), u, y, *(() if r is None else (r,))]
    lines = [",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([header, *lines]), encoding="utf-8")
    return path


def test_the_units_of_a_table_are_those_of_its_line_of_names(tmp_path: Path) -> None:
    """In brackets or below the names; words in round brackets are none."""
    y = np.arange(20.0)
    first = read_record(written(tmp_path / "a.csv", "t [s],u [mV],oil temp (°C),r", y, y, y),
                        ("t", "u", "oil temp", "r"))  # fmt: skip
    assert first.signals == Signals(Quantity("oil temp", "°C"), Quantity("", "mV"))
    assert first.r == Quantity()
    second = written(tmp_path / "b.csv", "t,input (left),output,r\ns,V,rpm,rad/s", y, y, y)
    found = read_record(second, ("t", "input (left)", "output", "r"))
    assert found.signals == Signals(Quantity("", "rpm"), Quantity())
    assert found.r.unit == "rad/s"


def logs(seed: int, size: float) -> tuple[Any, Any, Any]:
    """Return y, u and r of a heater around 300 K."""
    noise = np.random.default_rng(seed).normal(size=3000)
    r = 300.0 + 5.0 * np.sign(np.sin(0.3 * np.arange(3000)))
    return r + size * noise, 0.01 * np.cumsum(noise), r


def test_logs_in_other_units_are_ranked_as_if_they_were_in_one(tmp_path: Path) -> None:
    """K, °F and an r in °C beside; other quantities are refused by the names of the columns."""
    first, second = logs(1, 1.0), logs(2, 0.8)
    plain = {"A": Measured(first[1], first[0], 0.1, first[2]),
             "B": Measured(second[1], second[0], 0.1, second[2])}  # fmt: skip
    expected = rank(plain).scores
    fahrenheit = [1.8 * each - 459.67 for each in (second[0], second[2])]
    columns = ("t", "u", "temp", "r")
    a = written(tmp_path / "a.csv", "t,u [%],temp [K],r [K]", first[0], first[1], first[2])
    b = written(tmp_path / "b.csv", "t,u [ppm],temp [°F],r [°C]", fahrenheit[0],
                1e4 * second[1], second[2] - 273.15)  # fmt: skip
    found = rank({"A": read_record(a, columns), "B": read_record(b, columns)})
    for name, scores in expected.items():
        assert found.scores[name].rms == pytest.approx(scores.rms, rel=1e-5)
        assert found.scores[name].effort == pytest.approx(scores.effort, rel=1e-4)
    assert "y of B is converted from °F to K" in found.notes
    assert "u of B is converted from ppm to %" in found.notes
    c = written(tmp_path / "c.csv", "t,u [%],temp [bar],r [bar]", *first)
    with pytest.raises(ValueError, match=r"C: y is temp \[bar\], in A it is temp \[K\]"):
        rank({"A": read_record(a, columns), "C": read_record(c, columns)})
    d = written(tmp_path / "d.csv", "t,u [%],temp [K],r [V]", *first)
    with pytest.raises(ValueError, match=r"r \[V\]|is r"):
        rank({"A": read_record(a, columns), "D": read_record(d, columns)})


def test_records_of_one_plant_are_read_in_one_unit(tmp_path: Path) -> None:
    """The u of the second is in mV, its y in °F; a warning says so."""
    y, u, _ = logs(3, 1.0)
    a = written(tmp_path / "a.csv", "t,u [V],y [K]", y, u)
    b = written(tmp_path / "b.csv", "t,u [mV],y [°F]", 1.8 * y - 459.67, 1000.0 * u)
    with pytest.warns(UserWarning, match="is converted from") as seen:
        first, second = measured_records([a, b])
    assert len(seen) == 2
    np.testing.assert_allclose(second.y, first.y, atol=1e-5)
    np.testing.assert_allclose(second.u, first.u, atol=1e-6)


def test_a_model_in_kelvin_is_validated_on_a_record_in_fahrenheit(
    tmp_path: Path, quell: Callable[..., Any]
) -> None:
    """The fit is that of one unit; without units in the header it is NOT valid, by line and code."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.integers(0, 2, 60), 10).astype(float)
    y = np.empty(u.size)
    y[0] = 300.0
    for k in range(u.size - 1):
        y[k + 1] = 300.0 + 0.95 * (y[k] - 300.0) + 0.5 * u[k]
    y += 0.01 * rng.normal(size=y.size)
    written(tmp_path / "a.csv", "t,u [%],y [K]", y, u)
    written(tmp_path / "f.csv", "t,u [%],y [°F]", 1.8 * y - 459.67, u)
    written(tmp_path / "n.csv", "t,u [%],y", -2.0 * y, u)
    model = ("identify", "a.csv", "--order", "1", "--no-figures", "--no-alternatives", "--validate")
    with pytest.warns(UserWarning, match="y of f.csv is converted from °F to K"):
        good = quell(*model, "f.csv")
    assert good.code == 0
    with pytest.warns(UserWarning, match="y of n.csv has no unit"):
        bad = quell(*model, "n.csv")
    assert bad.code == 9
    assert "NOT: on the record for validation the model is worse than the mean of its y" in bad.out


def test_a_watched_machine_keeps_its_units(tmp_path: Path) -> None:
    """Through its file; later records are converted or refused; of an axis v goes with y."""
    t = 0.01 * np.arange(2000)
    y, u = np.sin(3.0 * t) + 1e-3 * np.random.default_rng(0).normal(size=t.size), np.cos(3.0 * t)
    machine = Machine(window=5.0)
    machine.take(WindowSignals(u, y, None, None, {}, 0.01, "rad", "V"), "a.csv")
    machine.save(tmp_path / "state.json")
    again = Machine.load(tmp_path / "state.json")
    other = WindowSignals(1e3 * u, np.degrees(y), None, None, {}, 0.01, "deg", "mV")
    again.take(other, "b.csv")
    values = again.watch.values("noise")
    np.testing.assert_allclose(values[4:], values[:4], rtol=1e-9)
    assert "y of b.csv is converted from deg to rad" in again.describe()
    with pytest.raises(ValueError, match=r"c.csv: y is y \[m\], in the state it is y \[rad\]"):
        again.take(other._replace(y_unit="m"), "c.csv")
    axes = Machine(window=5.0)
    axes.take({"x": WindowSignals(u, y, None, u, {}, 0.01, "m"), "z": other}, "a")
    millimetres = WindowSignals(1e3 * u, 1e3 * y, None, 1e3 * u, {}, 0.01, "mm")
    axes.take({"x": millimetres, "z": other}, "b")
    for name in ("x: u_rms", "x: f_rms", "x: noise"):
        values = axes.watch.values(name)
        np.testing.assert_allclose(values[4:], values[:4], rtol=1e-9)


def test_runs_of_several_axes_come_into_one_unit() -> None:
    """Outputs and references with v and estimates; control signals by their own units."""
    axes = ql.Axes({"x": adrc(), "z": adrc()}, np.eye(2))
    plant = ql.plants.LinearPlant(-np.eye(2), np.eye(2), np.eye(2))
    run = ql.simulate(plant, axes, ql.Scenario(reference=(1.0, 2.0), duration=0.5))

    def known(x: str, u: str) -> AxesSignals:
        return AxesSignals.of(
            ["x", "z"], y=[f"way [{x}]", "way [m]"], u=[f"force [{u}]", "force [N]"]
        )

    one, other = replace(run, signals=known("mm", "kN")), replace(run, signals=known("m", "N"))
    found, notes = runs_in_common_units({"a": other, "b": one})
    assert found["a"] is other
    b = found["b"]
    np.testing.assert_allclose(b["y"], run["y"] * [1e-3, 1.0])
    np.testing.assert_allclose(b["r"], run["r"] * [1e-3, 1.0])
    np.testing.assert_allclose(b["v"], run["v"] * [1e-3, 1.0])
    np.testing.assert_allclose(b["u"], run["u"] * [1e3, 1.0])
    np.testing.assert_allclose(b["x.x_hat"], 1e-3 * run["x.x_hat"])
    np.testing.assert_allclose(b["z.f_residual"], run["z.f_residual"])
    assert notes == [
        "y of x, of b is converted from mm to m",
        "u1, of b is converted from kN to N",
    ]
    with pytest.raises(ValueError, match=r"c: y of x, is way \[V\]"):
        runs_in_common_units({"a": other, "c": replace(run, signals=known("V", "N"))})


def adrc() -> ql.ADRC:
    """A controller of an axis."""
    return ql.ADRC(ql.ESO.model_free(order=1, b0=1.0, omega_o=20.0, dt=0.01), omega_c=4.0)


def test_records_without_units_stay_as_they_are() -> None:
    """Nothing is converted and nothing is said."""
    y, u, r = logs(5, 1.0)
    given = {"a": Measured(u, y, 0.1, r), "b": Measured(u, y, 0.1, r)}
    found, notes = in_common_units(given, error=True)
    assert notes == []
    assert found["a"].y is y
