"""The ACC benchmark: its plants, samples, criteria, designs and command."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from scipy.integrate import solve_ivp

import quell as ql
from quell.analysis import analyse, linear_law
from quell.analysis.loop import closed_loop_matrix
from quell.cli.app import app
from quell.cli.reproduce import _print_cases
from quell.experiments import acc
from quell.experiments.acc import DT, CaseResult, designs, interval, judge, study, unstable
from quell.experiments.acc.loops import BOX, MB, MF, boxed, free_poles, generated
from quell.plants import lagged_two_mass_spring, two_mass_spring
from quell.plants.base import advance

from .cases import cases

HEADER = "m1,m2,k_lin,k_nonlin,lambda,tau\n"
SOFT = (0.9, 1.1, 1.05, -0.25, 0.95, 0.03)


def run_by_hand(dt: float, seconds: float, u: float) -> np.ndarray:
    """Advance a softening plant from an impulse on m2, interpreted, under constant u and w."""
    x, scratch = np.array([0.0, 0.0, 0.0, 1.0 / SOFT[1], 0.0]), np.zeros(30)
    model = lagged_two_mass_spring(*SOFT).sampled(dt)
    for k in range(round(seconds / dt)):
        advance(model, x, scratch, k * dt, u, np.array([0.1, -0.05]))
    return x


def test_the_cubic_plant_obeys_its_equations_to_second_order_in_dt() -> None:
    """Against scipy's integrator; a sample ten times shorter is a hundred times as exact."""
    m1, m2, k, k_cubic, effectiveness, lag = SOFT

    def rate(t: float, x: np.ndarray) -> list[float]:
        force = k * (x[0] - x[1]) + k_cubic * (x[0] - x[1]) ** 3
        return [
            x[2],
            x[3],
            (-force + effectiveness * x[4] + 0.1) / m1,
            (force - 0.05) / m2,
            (0.3 - x[4]) / lag,
        ]

    exact = solve_ivp(
        rate, (0.0, 5.0), [0.0, 0.0, 0.0, 1.0 / m2, 0.0], method="LSODA", rtol=1e-12, atol=1e-13
    ).y[:, -1]
    coarse, fine = (np.max(np.abs(run_by_hand(dt, 5.0, 0.3) - exact)) for dt in (0.05, 0.005))
    assert 60.0 < coarse / fine < 140.0
    assert np.max(np.abs(run_by_hand(DT, 5.0, 0.3) - exact)) < 2e-5


def test_without_its_cubic_part_the_spring_makes_a_linear_plant() -> None:
    """And with hardly any the two are the same."""
    linear, almost = (
        lagged_two_mass_spring(lag=0.02),
        lagged_two_mass_spring(lag=0.02, k_cubic=1e-9),
    )
    assert isinstance(linear, ql.plants.LinearPlant)
    what = ql.Scenario(duration=5.0, x0=[0.0, 0.0, 0.0, 1.0, 0.0])
    one, other = (ql.simulate(plant, designs()[MF], what)["y"] for plant in (linear, almost))
    np.testing.assert_allclose(one, other, atol=1e-7)


@cases("argument", ["m1", "m2", "k", "effectiveness", "lag"])
def test_what_must_be_positive_in_the_plant_is_named(argument: str) -> None:
    """One line with argument and value."""
    with pytest.raises(
        ValueError, match=rf"{argument} = -1.0: must be finite and greater than zero"
    ):
        lagged_two_mass_spring(**{argument: -1.0})


def test_samples_are_read_by_name_whatever_their_order(tmp_path: Path) -> None:
    """Names as published, or ours; further columns and blank lines are left alone."""
    (tmp_path / "a.csv").write_text(
        "\\theta_1,\\theta_2,\\theta_3,\\theta_4,\\theta_5,\\theta_6\n1,2,3,-4,5,6\n"
    )
    (tmp_path / "b.csv").write_text(
        "tau, note, lambda, k_nonlin, k_lin, m2, m1\n6,x,5,-4,3,2,1\n\n"
    )
    for name in ("a.csv", "b.csv"):
        np.testing.assert_array_equal(acc.read(tmp_path / name), [[1.0, 2.0, 3.0, -4.0, 5.0, 6.0]])


@cases(
    ("text", "told"),
    [
        ("m1,m2,k_lin,lambda,tau\n1,1,1,1,0.01\n", r"column k_nonlin \(or theta_4\) is missing"),
        (
            "m1,m1,m2,k_lin,k_nonlin,lambda,tau\n1,1,1,1,0,1,0.01\n",
            r"column m1 \(or theta_1\) is there more than once",
        ),
        (
            HEADER + "1,1,1,0,1,0.01\n1,-0.5,1,0,1,0.01\n",
            r"line 3: m2 = -0.5: must be finite and greater than zero \[kg\]",
        ),
        (
            HEADER + "1,1,1,0,1,0\n",
            r"line 2: tau = 0.0: must be finite and greater than zero \[s\]",
        ),
        (HEADER + "1,1,1,nan,1,0.01\n", r"line 2: k_nonlin = nan: must be a finite number"),
        (HEADER + "1,1,stiff,0,1,0.01\n", r"line 2: k_lin = 'stiff': must be a number"),
        (HEADER + "1,1,1\n", r"line 2: k_nonlin = '': must be a number"),
        (
            HEADER + "1,1,1,0,1,1e-300\n",
            r"line 2: tau = 1e-300: must be between 1e-09 and 1e[+]06, is the unit right",
        ),
        (
            HEADER + "1,1,1e200,0,1,0.01\n",
            r"line 2: k_lin = 1e[+]200: must be between 1e-06 and 1e[+]06",
        ),
        (HEADER + "1,1,1_0,0,1,0.01\n", r"line 2: k_lin = '1_0': must be a number"),
        (HEADER + "1" * 200_000 + ",1,1,0,1,0.01\n", "is no CSV file .field larger"),
        (HEADER, "at least one sample"),
        ("", "at least one sample"),
    ],
)
def test_each_mistake_in_a_file_of_samples_has_an_error_of_its_own(
    tmp_path: Path, text: str, told: str
) -> None:
    """It names file, line and column."""
    (tmp_path / "bad.csv").write_text(text)
    with pytest.raises(ValueError, match=rf"samples = .*bad.csv'.*{told}"):
        acc.read(tmp_path / "bad.csv")
    with pytest.raises(ValueError, match="can't be read as a text file"):
        acc.read(tmp_path / "none.csv")


def test_drawn_samples_are_of_the_published_kind_and_repeatable() -> None:
    """Medians and the ends of the quantiles; a spread of 3 is three times as wide; all plants can be built."""
    small, wide = acc.generated(2000), acc.generated(2000, 3.0)
    np.testing.assert_array_equal(small, acc.generated(2000))
    assert np.any(small != acc.generated(2000, seed=1))
    np.testing.assert_allclose(
        np.median(small, axis=0), [1.017, 1.008, 1.012, 0.019, 0.999, 0.0079], atol=0.01
    )
    assert np.corrcoef(small[:, 2], small[:, 3])[0, 1] > 0.7
    np.testing.assert_allclose(np.log(wide[:, 0]), 3.0 * np.log(small[:, 0]))
    np.testing.assert_allclose(wide[:, 3], 3.0 * small[:, 3])
    for row in wide[:50]:
        acc.plant(row, cubic=True)
    with pytest.raises(ValueError, match=r"spread = 9.0: must be at most 5"):
        acc.generated(10, 9.0)


def test_a_plant_fails_for_any_of_four_reasons_and_passes_on_the_limits() -> None:
    """Late |y|, |u| at any time, a run that ended early, a loop that is unstable; early |y| is free."""
    t = np.array([0.0, 14.99, 15.0, 20.0])
    y = np.array(
        [
            [9.0, 9.0, 0.1, -0.1],
            [0.0, 0.0, 0.0, 0.101],
            [0.0] * 4,
            [0.0, 0.0, np.nan, np.nan],
            [0.0] * 4,
        ]
    )
    u = np.array(
        [
            [0.5, -0.5, 0.0, 0.0],
            [0.0] * 4,
            [0.0, -0.51, 0.0, 0.0],
            [0.0, 0.0, np.nan, np.nan],
            [0.0] * 4,
        ]
    )
    found = judge(t, y, u, np.array([False, False, False, False, True]))
    assert found.fails.tolist() == [False, True, True, True, True]
    row = found.to_json()
    assert (row["failure_rate"], row["late"], row["beyond_u"]) == (0.8, 3, 1)


def test_the_interval_of_no_failure_is_the_rule_of_three() -> None:
    """Clopper & Pearson in closed form where nothing fails: 1 − 0.025^(1/n)."""
    low, high = interval(0, 1000)
    assert low == 0.0
    assert high == pytest.approx(1.0 - 0.025**0.001)


def test_the_law_of_a_controller_is_the_one_it_runs() -> None:
    """As long as no limit holds, the linear loop and the driver agree to rounding."""
    plant, controller = lagged_two_mass_spring(lag=0.02), designs(most_u=1e3)[MF]
    run = ql.simulate(plant, controller, ql.Scenario(duration=5.0, x0=[0.0, 0.0, 0.0, 1e-3, 0.0]))
    sampled, law = plant.sampled(DT), linear_law(controller)
    loop = closed_loop_matrix(
        sampled.transition, sampled.input, sampled.output, law, law.A + np.outer(law.B_u, law.C)
    )
    x = np.zeros(loop.shape[0])
    x[3] = 1e-3
    for y in run["y"]:
        assert x[1] == pytest.approx(y, abs=1e-12)
        x = loop @ x


def test_a_spring_five_times_as_stiff_makes_the_loop_unstable() -> None:
    """And the nominal one does not."""
    found = unstable([lagged_two_mass_spring(), lagged_two_mass_spring(k=5.0)], designs()[MF])
    assert found.tolist() == [False, True]


def test_every_controller_of_the_benchmark_has_margins() -> None:
    """A PID on the nominal plant has a response at half the sampling rate whose imaginary part is rounding: no reason to fail."""
    for controller in designs().values():
        low, high = analyse(ql.plants.two_mass_spring(), controller).margins.gain
        assert 0.1 < low < 1.0 < high


def test_a_case_that_is_lost_is_called_unstable_and_one_that_does_not_settle_never() -> None:
    """In the printed table: a size in metres is no time that never comes."""
    margins = analyse(two_mass_spring(), designs()[MB]).margins
    lost = CaseResult(margins, np.inf, 12.0, 0.6, 2.1, 0.1, np.inf, np.inf)
    console = Console(file=io.StringIO(), width=120)
    _print_cases(console, SimpleNamespace(cases={MB: lost}))  # type: ignore[arg-type]
    rows = [line for line in console.file.getvalue().splitlines() if line.strip()]  # type: ignore[attr-defined]
    told = {
        line.split(":")[0].strip() + line.split()[-1] for line in rows if line.strip()[0] in "13"
    }
    assert {"1never", "112.0", "3unstable"} <= told
    assert "3never" not in told


@pytest.mark.trial
def test_the_command_writes_what_programs_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The keys are fixed, rates lie in their intervals; with one controller of ours and one plant, as Python."""
    loop = analyse(two_mass_spring(), designs()[MF])
    case = CaseResult(loop.margins, 9.0, 9.5, 0.4, 2.1, 0.1, 0.5, np.inf)
    monkeypatch.setattr(study, "designs", lambda dt: {MF: designs(dt)[MF]})
    monkeypatch.setattr(study, "study_cases", lambda: {MF: case})
    (tmp_path / "few.csv").write_text(HEADER + "0.9,1.1,0.95,-0.1,0.9,0.02\n")
    where = ["--json", str(tmp_path / "out.json"), "--no-figures"]
    with pytest.raises(SystemExit, match="0"):
        app(["reproduce", "acc", "--samples", str(tmp_path / "few.csv"), *where])
    found = json.loads((tmp_path / "out.json").read_text())
    names = {"published nominal", "published SP1(0.05)", "published SP2", "MF-ESO"}
    for spring in ("linear", "cubic"):
        assert set(found[spring]) == names
        for row in found[spring].values():
            low, high = row["ci95"]
            assert 0.0 <= low <= row["failure_rate"] <= high <= 1.0
    assert found["cases"][MF]["settled_at"] == 9.0
    assert found["cases"][MF]["load_remains"] is None
    assert found["runs_per_second"] > 0.0
    assert "published SP2" in capsys.readouterr().out
    with pytest.raises(ValueError, match="must exist"):
        app(
            [
                "reproduce",
                "acc",
                "--samples",
                str(tmp_path / "few.csv"),
                "--json",
                str(tmp_path / "no" / "out.json"),
                "--no-figures",
            ]
        )


def test_a_sweep_of_the_cubic_part_may_go_through_zero() -> None:
    """All plants of a batch are of one kind then, each with its own value."""
    cubic = np.linspace(-0.2, 0.2, 5)
    swept = ql.plants.batch(lagged_two_mass_spring, k_cubic=cubic)
    assert {type(swept[i]) for i in range(5)} == {type(lagged_two_mass_spring(k_cubic=0.3))}
    np.testing.assert_allclose([swept[i].k_cubic for i in range(5)], cubic)


def test_samples_are_read_or_drawn(tmp_path: Path) -> None:
    """Not both."""
    from quell.cli.reproduce import acc

    (tmp_path / "a.csv").write_text(HEADER + "1,1,1,0,1,0.01\n")
    with pytest.raises(
        ValueError, match="--samples reads plants, --count, --spread and --seed are for drawing"
    ):
        acc(samples=tmp_path / "a.csv", count=5)


def test_a_box_is_filled_evenly_by_masses_and_stiffness() -> None:
    """They are independent and uniform in their ranges; the other columns are those of a spread of 3."""
    found, wide = boxed(4000, 5), generated(4000, 3.0, 5)
    np.testing.assert_array_equal(found[:, 3:], wide[:, 3:])
    for column, (low, high) in zip(found[:, :3].T, BOX, strict=True):
        assert low <= column.min() < low + 0.01 * (high - low)
        assert np.mean(column) == pytest.approx(0.5 * (low + high), abs=0.02 * (high - low))
        assert np.std(column) == pytest.approx((high - low) / math.sqrt(12.0), rel=0.03)
    related = np.corrcoef(found[:, [0, 1, 2, 4]].T) - np.eye(4)
    assert np.max(np.abs(related)) < 0.06
    np.testing.assert_array_equal(boxed(10, 5), boxed(10, 5))


def test_the_search_for_the_box_begins_at_mf_eso_and_may_reach_its_result() -> None:
    """The structure's start has the same gains; the result is within the poles' and the noise's bounds."""
    made, ours = study.build(), designs()[MF]
    start = made(study.start(made))
    np.testing.assert_allclose(start.parameters.law, ours.parameters.law, rtol=1e-9)
    np.testing.assert_allclose(start.parameters.eso.gain, ours.parameters.eso.gain, rtol=1e-9)
    tuned, noise = free_poles(), study.TooMuchNoise()
    loop = analyse(two_mass_spring(), tuned)
    assert noise(ours) == pytest.approx(-math.log(10.0))
    assert -0.1 < noise(tuned) < 0.0
    assert loop.margins.modulus > analyse(two_mass_spring(), ours).margins.modulus
    observer = np.eye(5) - np.outer(tuned.parameters.eso.gain, np.eye(5)[0])
    poles = np.log(np.linalg.eigvals(observer @ tuned.parameters.eso.transition).astype(complex))
    assert np.max(np.abs(poles)) < 0.5


@pytest.mark.trial
def test_the_score_of_the_search_counts_failures_and_ranks_by_late_motion() -> None:
    """A plant that fails scores about 1, another about 0, and more where it moves more late; ``.ci/run`` has 60 plants."""
    samples = boxed(6, 9)[1::2]
    judged = acc.judge_sampled(designs()[MF], samples, cubic=True, workers=1)
    (scores,) = study.scores(designs()[MF], list(samples))
    assert np.array_equal(np.round(scores), judged.fails)
    assert set(judged.fails) == {False, True}
    settled = ~judged.fails
    order = np.argsort(judged.late_peak[settled])
    assert np.all(np.diff(scores[settled][order]) >= 0.0)
    assert scores[settled].max() > scores[settled].min()


def test_a_box_has_its_own_ranges() -> None:
    """No spread and no file beside it."""
    for other in (["--spread", "2"], ["--samples", "a.csv"]):
        with pytest.raises(ValueError, match="--box draws the plants with a spread of its own"):
            app(["reproduce", "acc", "--box", *other])
