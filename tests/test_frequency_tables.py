"""Tables of frequencies: which files are some, poles and delay from G(jω), modes of a power spectrum."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quell.identification import frequency_table, identify_frequencies, modes_of_spectrum
from quell.tuning import identified_plants

from .commands import Shown

TURN = 2.0 * np.pi
OMEGA = TURN * np.geomspace(1.0, 300.0, 70)


def servo(omega: Any) -> Any:
    """Return G of a motor before a flexible load, late by 0.5 ms: gain 100 of s G."""
    s, pole, zero = 1j * omega, TURN * 80.0, TURN * 60.0
    num = 1.0 + 0.02 * s / zero + (s / zero) ** 2
    den = s * (1.0 + s / 9.0) * (1.0 + 0.02 * s / pole + (s / pole) ** 2)
    return 100.0 * num / den * np.exp(-5e-4 * s)


def noisy(G: Any, size: float, seed: int = 0) -> Any:
    """Return G with relative errors."""
    error = np.random.default_rng(seed).standard_normal((2, G.size))
    return G * (1.0 + size * (error[0] + 1j * error[1]))


@pytest.mark.parametrize(
    ("head", "mark", "columns"),
    [
        ("Frequency [Hz];Gain [dB];Phase [deg]", ";", "f dB deg"),
        ("Frequency (Hz),Trace 1: Gain: Magnitude (dB),Trace 1: Gain: Phase (°)", ",", "f dB deg"),
        ("# omega re im", " ", "w re im"),
        ("f [kHz]\tmag\tphase [rad]", "\t", "k size rad"),
        ("Freq,mag_db,phase_deg,coherence", ",", "f dB deg one"),
        ("f;|G|;phase\nHz;dB;°", ";", "f dB deg"),
        ("#,Frequency (Hz),Amplitude (Vpp),Gain (dB),Phase (°)", ",", "i f one dB deg"),
    ],
)
def test_a_table_is_known_by_the_names_of_its_columns(
    head: str, mark: str, columns: str, tmp_path: Path
) -> None:
    """Units, delimiters, decimal commas and comments as in records; G comes back to its digits."""
    G = servo(OMEGA)
    known = {
        "f": OMEGA / TURN,
        "k": OMEGA / TURN / 1e3,
        "w": OMEGA,
        "dB": 20.0 * np.log10(np.abs(G)),
        "size": np.abs(G),
        "deg": np.degrees(np.angle(G)),
        "rad": np.unwrap(np.angle(G)),
        "re": G.real,
        "im": G.imag,
        "one": np.ones(G.size),
        "i": np.arange(1.0, G.size + 1.0),
    }
    rows = zip(*(known[name] for name in columns.split()), strict=True)
    text = "\n".join([head, *(mark.join(f"{value:.9g}" for value in row) for row in rows)])
    file = tmp_path / "drive.csv"
    file.write_text(text.replace(".", ",") if mark == ";" else text, encoding="utf-8")
    table = frequency_table(file)
    assert table is not None
    np.testing.assert_allclose(table.omega, OMEGA, rtol=1e-7)
    np.testing.assert_allclose(table.response, G, rtol=1e-6)


def test_a_record_in_time_is_no_table_of_frequencies(tmp_path: Path) -> None:
    """Not even with a column of a frequency beside its times; asked for by name it is one."""
    rows = np.column_stack([np.arange(30.0), *np.random.default_rng(0).uniform(1.0, 9.0, (3, 30))])
    file = tmp_path / "run.csv"
    np.savetxt(file, rows, delimiter=",", header="t,u,frequency,gain", comments="")
    assert frequency_table(file) is None
    header = "frequency [Hz],power [W]"  # of a drive, without times
    np.savetxt(tmp_path / "drive.csv", rows[:, 1:3], delimiter=",", header=header, comments="")
    assert frequency_table(tmp_path / "drive.csv") is None
    asked = frequency_table(file, ["frequency", "gain"])
    assert asked is not None
    assert asked.power is not None


def test_columns_that_may_be_several_are_named_and_can_be_chosen(tmp_path: Path) -> None:
    """As the axes of a printer's resonance test."""
    f = np.linspace(5.0, 200.0, 60)
    file = tmp_path / "resonances.csv"
    rows = np.column_stack([f, f, f**2])
    np.savetxt(file, rows, delimiter=",", header="freq,psd_x,psd_y", comments="")
    with pytest.raises(ValueError, match="power spectrum may be psd_x, psd_y; name the columns"):
        frequency_table(file)
    for columns, power in (
        (["freq", "psd_y"], f**2),
        (["FREQ", "PSD_X"], f),
        (["1", "3"], f**2),
        (["1", "2"], f),
    ):
        table = frequency_table(file, columns)
        assert table is not None
        np.testing.assert_allclose(table.power, power)
        np.testing.assert_allclose(table.omega, TURN * f)
    for columns in (["1", "4"], ["0", "2"]):
        assert frequency_table(file, columns) is None


def test_lines_that_tell_nothing_are_left_out_and_counted(tmp_path: Path) -> None:
    """Zero frequency, little coherence, the same frequency twice, empty cells."""
    G = servo(OMEGA)
    rows = [f"{w / TURN:.8g},{g.real:.8g},{g.imag:.8g},1" for w, g in zip(OMEGA, G, strict=True)]
    rows += ["0,1,1,1", "7.5,99,99,0.1", rows[-1], "8.5,,1,1"]
    file = tmp_path / "table.csv"
    file.write_text("\n".join(["f,real,imag,coherence", *rows]), encoding="utf-8")
    table = frequency_table(file)
    assert table is not None
    assert table.omega.size == OMEGA.size
    assert table.notes[0].startswith("2 frequencies are left out")
    assert table.notes[1].startswith("1 frequencies are there twice")


@pytest.mark.trial
@pytest.mark.parametrize("size", [1e-4, 1e-2])
def test_order_poles_zeros_gain_and_delay_of_a_servo_come_back(size: float) -> None:
    """Exactly, and within three deviations of a table with errors of 1 %."""
    found = identify_frequencies(OMEGA, noisy(servo(OMEGA), size))
    assert found.shortcomings == ()
    assert (found.den.size - 1, found.num.size - 1, found.integrators) == (4, 2, 1)
    for value, (low, high), truth in (
        (found.gain, found.gain_interval, 100.0),
        (found.delay, found.delay_interval, 5e-4),
    ):
        assert abs(value - truth) < 1.5 * (high - low) < 0.3 * truth
    for roots, w in ((found.poles, TURN * 80.0), (found.zeros, TURN * 60.0)):
        truth = w * complex(-0.01, np.sqrt(1.0 - 1e-4))
        root = min(roots, key=lambda one: abs(one.value - truth))
        assert abs(root.value - truth) < 3.0 * root.deviation + 1e-6 * w
        assert root.deviation < 5.0 * size * w


def test_poles_and_zeros_of_a_servo_come_back_at_its_order() -> None:
    """Within a table's digits."""
    found = identify_frequencies(OMEGA, servo(OMEGA), 4, 2, integrators=1)
    assert found.shortcomings == ()
    assert found.gain == pytest.approx(100.0, rel=1e-4)
    assert found.delay == pytest.approx(5e-4, rel=1e-3)
    assert found.poles[-1].omega == pytest.approx(TURN * 80.0, rel=1e-5)
    assert found.zeros[-1].omega == pytest.approx(TURN * 60.0, rel=1e-5)


def test_what_is_given_is_kept() -> None:
    """Order, zeros, integrators, delay, and the hold of u."""
    s = 1j * OMEGA
    G = 3.0 / (1.0 + 0.02 * s) * np.exp(-2e-3 * s)
    hold = np.exp(-0.5e-3 * s) * np.sinc(OMEGA * 1e-3 / TURN)
    held = identify_frequencies(OMEGA, G * hold, 1, 0, dt=1e-3)
    assert held.delay == pytest.approx(2e-3, rel=1e-6)
    assert held.poles[0].value.real == pytest.approx(-50.0, rel=1e-6)
    np.testing.assert_allclose(held.response_at(OMEGA), G * hold, rtol=1e-6)
    given = identify_frequencies(OMEGA, G, 1, 0, integrators=0, delay=2e-3)
    assert (given.delay, given.integrators) == (2e-3, 0)
    assert given.num[-1] == pytest.approx(150.0, rel=1e-6)


def test_the_plants_for_tuning_have_the_intervals_of_the_table() -> None:
    """The model first; all of one gain, pole and delay within their joint intervals."""
    s = 1j * OMEGA
    G = noisy(3.0 / (1.0 + 0.02 * s) * np.exp(-2e-3 * s), 5e-3)
    found = identify_frequencies(OMEGA, G)
    plants, delays = identified_plants(found)
    assert len(plants) == len(delays) > 4
    np.testing.assert_allclose(plants[0][1], found.den)
    gains = [num[-1] / den[-1] for num, den in plants]
    assert min(gains) < found.gain_interval[0] < found.gain_interval[1] < max(gains)
    assert min(delays) < found.delay < max(delays)


@pytest.mark.trial
def test_a_table_that_no_order_explains_says_so() -> None:
    """White noise in place of a response."""
    noise = np.random.default_rng(3).standard_normal((2, 40))
    found = identify_frequencies(OMEGA[:40], noise[0] + 1j * noise[1])
    assert found.is_poor
    assert any("no order up to 8 explains the table" in text for text in found.shortcomings)


@pytest.mark.parametrize(
    ("omega", "response", "message"),
    [
        (OMEGA[:5], servo(OMEGA[:5]), "has 5 frequencies: must have at least 8"),
        (OMEGA[::-1], servo(OMEGA), "must rise"),
        (OMEGA, np.zeros(OMEGA.size), "response is zero at 6.28"),
        (OMEGA, servo(OMEGA[1:]), "must be 70 finite numbers"),
    ],
)
def test_what_is_no_table_is_refused(omega: Any, response: Any, message: str) -> None:
    """With the reason."""
    with pytest.raises(ValueError, match=message):
        identify_frequencies(omega, response)


def test_a_power_spectrum_has_frequency_and_damping_of_its_modes() -> None:
    """Two of them above a background, as averages of 40 periodograms show them."""
    f = np.linspace(5.0, 200.0, 400)
    S = 0.02 * (f / 50.0)
    for hertz, zeta, size in ((45.0, 0.04, 1.0), (110.0, 0.03, 0.3)):
        S = S + size * zeta**2 * 200.0 / (
            (1.0 - (f / hertz) ** 2) ** 2 + (2.0 * zeta * f / hertz) ** 2
        )
    S *= np.random.default_rng(2).gamma(40.0, 1.0 / 40.0, f.size)
    found = modes_of_spectrum(TURN * f, S)
    assert len(found.modes) == 2
    for mode, hertz, zeta in zip(found.modes, (45.0, 110.0), (0.04, 0.03), strict=True):
        low, high = mode.omega_interval
        assert low < TURN * hertz < high < 1.01 * low
        assert mode.damping == pytest.approx(zeta, rel=0.15)
    with pytest.raises(ValueError, match="no peak that stands out"):
        modes_of_spectrum(
            TURN * f, 0.02 * (f / 50.0) * np.random.default_rng(2).gamma(40.0, size=f.size)
        )


def test_a_peak_as_wide_as_the_lines_has_a_damping_of_at_most() -> None:
    """Its width is that of the window, perhaps."""
    f = np.linspace(5.0, 200.0, 100)
    S = 0.01 + 1e-3 / ((1.0 - (f / 60.0) ** 2) ** 2 + (0.04 * f / 60.0) ** 2)
    (mode,) = modes_of_spectrum(TURN * f, S).modes
    assert mode.damping_interval[0] == 0.0
    assert "damping at most" in str(mode)


def test_the_commands_take_a_table_as_a_record(quell: Callable[..., Shown], tmp_path: Path) -> None:
    """Identify prints, draws and writes; tune says in a line what is missing."""
    G = 3.0 / (1.0 + 0.02j * OMEGA)
    rows = np.column_stack([OMEGA / TURN, np.abs(G), np.degrees(np.unwrap(np.angle(G)))])
    np.savetxt(tmp_path / "g.csv", rows, delimiter=",", header="f,mag,phase", comments="")
    np.savetxt(tmp_path / "p.csv", rows[:, :2] ** 2, delimiter=",", header="f,psd", comments="")
    shown = quell("identify", "g.csv", "--json", "g.json", "--figures", "seen")
    assert shown.code == 0, shown.err
    assert "70 frequencies" in shown.out
    assert "taken as a factor" in shown.out
    assert "95 %: " in shown.out
    assert (tmp_path / "g.json").is_file()
    assert (tmp_path / "seen" / "identified.png").is_file()
    for options, message in (
        (("identify", "g.csv", "--horizon", "3"), "--horizon: is for a record in time"),
        (("identify", "p.csv", "--order", "3"), "--order: is for a table with phase"),
        (("tune", "g.csv"), "has no sample time"),
        (("tune", "p.csv", "--dt", "0.001"), "has no phase"),
    ):
        refused = quell(*options, "--no-figures")
        assert refused.code == 2
        assert message in refused.err
