"""Setup files: what they describe is built, and what is wrong in them is said in a line each."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.setup import EXAMPLES, SetupError, load, made, varied
from quell.setup.loading import changed, keys, markdown
from quell.setup.registry import CONTROLLERS, FEATURES, LEARNERS, OBSERVERS, PLANTS, SIGNALS

from .cases import cases
from .setups import TWO_MASS


def setup(more: str = "", *, without: tuple[str, ...] = ()) -> Any:
    """Build the base with more in it: keys are added to a table of the same kind, and take the place of one of another."""
    data = copy.deepcopy(tomllib.loads(TWO_MASS))
    for key in without:
        del data[key]
    for key, value in tomllib.loads(more).items():
        old = data.get(key)
        alike = (
            isinstance(value, dict)
            and isinstance(old, dict)
            and value.get("kind", old.get("kind")) == old.get("kind")
        )
        data[key] = old | value if alike else value
    return made("rig.toml", data)


@pytest.mark.trial
@pytest.mark.compiled
def test_the_example_is_the_python_of_the_first_example() -> None:
    """The same run, bit for bit, as from the objects of examples/01_step.py."""
    read = load(EXAMPLES / "two_mass.toml")
    plant = ql.plants.two_mass_spring(m1=1.0, m2=0.5, k=2.0)
    observer = ql.ESO.model_free(order=4, b0=ql.canonical(plant).b, omega_o=12.0, dt=2e-3)
    scenario = ql.Scenario(
        reference=ql.signals.Sinusoid(omega=0.8).until(60.0, then=ql.signals.Step(at=60.0)),
        disturbances=(0.0, ql.signals.Step(height=0.5, at=90.0)),
        noise=ql.signals.BandLimitedNoise(power=1e-12, sample_time=0.01),
        duration=120.0,
        rest_at=(60.0,),
    )
    assert read.scenario == scenario
    ours = ql.simulate(read.plant, read.controller, read.scenario)
    theirs = ql.simulate(
        plant, ql.ADRC(observer, omega_c=1.2, learner=ql.learners.Kalman()), scenario
    )
    np.testing.assert_array_equal(ours.log, theirs.log)
    assert [ours.metrics(**window) for window in read.windows] == [
        theirs.metrics(60.0, 90.0),
        theirs.metrics(90.0),
    ]


@cases(
    ("text", "message"),
    [
        ("[observer]\nomega_0 = 1.0", "observer.omega_0: unknown; did you mean omega_o?"),
        ("[controler]\nomega_c = 1.0", "controler: unknown; did you mean controller?"),
        ("[plant]\nmass = 1.0", "plant.mass: unknown; must be one of kind, m1, m2, k, c1, c2"),
        (
            "[observer]\nkind = 'model-fre'",
            "observer.kind = 'model-fre': unknown; did you mean model-free?",
        ),
        ("learner = 'kallman'", "learner.kind = 'kallman': unknown; did you mean kalman?"),
        (
            "[tune]\nu_min = -0.64",
            "tune.u_min: unknown; limits of u are u_min, u_max and rate_limit in [controller]; "
            "tune.u_max bounds |u| in the response to the load or the reference",
        ),
        (
            "[tune]\nrate_limit = 3.0",
            "tune.rate_limit: unknown; limits of u are u_min, u_max and rate_limit in "
            "[controller]; tune.rate_max bounds |u'| in the response to the load or the reference",
        ),
        ("learner = 3", "learner = 3: must be a table"),
        (
            "[observer]\nomega_o = -1.0",
            "observer.omega_o = -1.0: must be finite and greater than zero [rad/s]",
        ),
        ("[observer]\norder = 4.5", "observer.order = 4.5: must be a whole number"),
        ("[observer]\nb0 = 'one'", "observer.b0 = 'one': must be a number"),
        ("[controller]\nfeedforward = 1", "controller.feedforward = 1: must be true or false"),
        ("[controller]\nomega_c = true", "controller.omega_c = True: must be a number"),
        ("[observer]\ndt = 0.01", "observer.dt: unknown; dt belongs at the top of the file"),
        (
            "[controller]\nlearner = 'rls'",
            "controller.learner: unknown; [learner] is a table of its own",
        ),
        ("dt = -1.0", "dt = -1.0: must be finite and greater than zero [s]"),
        (
            "[learner]\nkind = 'kalman'\nstate_bandwidth = 'x'",
            "learner.state_bandwidth = 'x': must be a number or a list",
        ),
        (
            "[learner]\nkind = 'rls'\nfeatures = ['state', 'inputs']",
            "learner.features[1].kind = 'inputs': unknown; did you mean input?",
        ),
        (
            "[learner]\nkind = 'rls'\nfeatures = ['input', 'state']",
            "learner.features: features: Input() must be the last",
        ),
        (
            "[learner]\nkind = 'rls'\nfeatures = [{kind = 'polynomial', degree = 1}]",
            "learner.features[0].degree = 1: must be a whole number of at least 2",
        ),
        (
            "scenario = {disturbances = [{kind = 'step', hight = 1.0}]}",
            "scenario.disturbances[0].hight: unknown; did you mean height?",
        ),
        (
            "scenario = {disturbances = [0.0, 0.0, 1.0]}",
            "scenario.disturbances has 3 signals: the plant has 2 disturbance inputs",
        ),
        (
            "scenario = {reference = {kind = 'step', until = 1.0}}",
            "scenario.reference: only one of until and then",
        ),
        (
            "scenario = {duration = 0.0}",
            "scenario.duration = 0.0: must be finite and greater than zero [s]",
        ),
        ("metrics = {start = 1.0}", "metrics = {'start': 1.0}: must be [[metrics]]"),
        (
            "[[metrics]]\nstart = -1.0",
            "metrics[0].start = -1.0: must be finite and not negative [s]",
        ),
        ("[[metrics]]\nband = 0.0", "metrics[0].band = 0.0: must be finite and greater than zero"),
        (
            "[[metrics]]\n[[metrics]]\nstart = 3.0\nstop = 1.0",
            "metrics[1].start = 3.0, stop = 1.0: start must be less than stop",
        ),
        ("[prefilter]\nkind = 'zv'", "prefilter.omega: missing"),
        (
            "[plant]\nkind = 'linear'\nnum = [1.0]",
            "plant: given: num; must be num and den, or A, B and C",
        ),
        (
            "[plant]\nkind = 'delayed'\nplant = 'dc-motor'\ndelay = 0.015",
            "plant.delay = 0.015 s with dt = 0.01 s: must be a whole number",
        ),
        (
            "[plant]\nkind = 'two-mass'\nuncertain = { m1 = [0.6, 1.4], mass = [0.5, 2.0] }",
            "plant.uncertain: plant.mass: unknown; must be one of m1, m2, k",
        ),
        (
            "plant = {kind = 'delayed', plant = 'two-mass', delay = 0.02, "
            "uncertain = {'plant.k2' = [0.5, 2.0]}}",
            "plant.uncertain: plant.plant.k2: unknown; did you mean k?",
        ),
        (
            "[controller]\nkind = 'pid'\nkp = 1.0",
            "observer: a controller of the kind pid does not use it",
        ),
        ("learner = {kind = 'harmonic', limits = [0.1]}", "learner.limits[1]: missing"),
        (
            "learner = {kind = 'rls', features = [{kind = 'polynomial', degree = 100000000}]}",
            "controller: degree = 100000000: has 4.17e+30 monomials of 4 states",
        ),
    ],
)
def test_a_mistake_gives_a_line_with_file_key_and_rule(text: str, message: str) -> None:
    """Whether a table finds it, or the constructor that is called in the end."""
    with pytest.raises(SetupError) as caught:
        setup(text)
    assert len(caught.value.mistakes) == 1
    assert caught.value.mistakes[0].startswith(f"rig.toml: {message}")


@cases(
    ("changes", "message"),
    [
        (
            {"metrics": [{"start": 50.0}]},
            r"metrics\[0\].start = 50: must be less than the scenario's duration, 5 s",
        ),
        ({"scenario.x0": [1.0, 2.0]}, r"scenario.x0 has shape \(2,\): must be a vector of 4"),
        ({"scenario.schedule": [1.0]}, "scenario.schedule has 1 signal, and the schedule of the"),
        ({"plant.uncertain": {"m1": [2.0, 1.0]}}, "plant.uncertain.m1 = .*: must be .low, high"),
        ({"sweep": {"draws": 30}}, "sweep.draws = 30: nothing in the scenario is random"),
        (
            {"sweep": {"parameters": {"observer.b1": [1.0]}}},
            "sweep.parameters: observer.b1: unknown; must be one of",
        ),
        (
            {"sweep": {"parameters": {"plant.m1": [1.0]}, "limits": {"foo": 2.0}}},
            "sweep.limits.foo: is none of the metrics",
        ),
        ({"sweep": {"parameters": {"plant.m1": [1.0]}, "metrics": []}}, "sweep.metrics is empty"),
    ],
)
def test_loading_refuses_what_no_command_can_use(changes: Any, message: str) -> None:
    """With the key, its value and the rule; each part alone is right."""
    base = {
        "dt": 0.01,
        "plant": {"kind": "two-mass"},
        "observer": {"kind": "model-free", "order": 4, "b0": 1.0, "omega_o": 10.0},
        "controller": {"omega_c": 1.0},
        "scenario": {"duration": 5.0, "reference": 1.0},
    }
    made("drive.toml", base)
    with pytest.raises(SetupError, match=f"^drive.toml: {message}"):
        made("drive.toml", changed("drive.toml", base, changes))


def test_several_mistakes_are_told_at_once() -> None:
    """A line for each, in all tables."""
    with pytest.raises(SetupError) as caught:
        setup("[observer]\norder = 'four'\nb0 = 'one'\n[guard]\nbond = 1.0")
    assert sorted(caught.value.mistakes) == [
        "rig.toml: guard.bond: unknown; did you mean bound?",
        "rig.toml: observer.b0 = 'one': must be a number",
        "rig.toml: observer.order = 'four': must be a whole number",
    ]


def test_what_is_missing_is_named() -> None:
    """A file without a plant, or an observer, can be of use; where it is not, that is said."""
    with pytest.raises(SetupError, match="rig.toml: controller: observer is missing; give a table"):
        setup(without=("observer",))
    with pytest.raises(SetupError, match="rig.toml: observer: plant is missing; give a table"):
        setup("[observer]\nkind = 'model-based'\nomega_o = 9.0", without=("plant",))
    with pytest.raises(SetupError, match="rig.toml: scenario: missing; give a table"):
        setup().needed("scenario")
    assert setup(without=("plant",)).plant is None


def test_a_file_that_is_none_is_told_apart(tmp_path: Path) -> None:
    """Not there, or not TOML: with the place."""
    with pytest.raises(
        SetupError, match=r"nowhere.toml: can't be read \(No such file or directory\)"
    ):
        load(tmp_path / "nowhere.toml")
    (tmp_path / "bad.toml").write_text("dt = 0.01\n[plant\n")
    with pytest.raises(SetupError, match=r"bad.toml: not TOML: .*at line 2"):
        load(tmp_path / "bad.toml")
    (tmp_path / "bytes.toml").write_bytes(b"dt = 0.01 # \xb5s\n")
    with pytest.raises(SetupError, match=r"^bytes.toml: not TOML: byte 12 is not UTF-8$"):
        load(tmp_path / "bytes.toml")
    (tmp_path / "deep.toml").write_text("a = " + "[" * 5000 + "]" * 5000)
    with pytest.raises(SetupError, match=r"^deep.toml: .*nested too deeply$"):
        load(tmp_path / "deep.toml")


def test_only_a_setup_can_be_varied() -> None:
    """Anything else is named."""
    with pytest.raises(ValueError, match="setup = 3: must be a Setup"):
        varied(3, {"dt": 0.1})


def test_a_mark_of_byte_order_is_no_mistake(tmp_path: Path) -> None:
    """As some editors put it in front of a text."""
    (tmp_path / "rig.toml").write_text(
        (EXAMPLES / "two_mass.toml").read_text(encoding="utf-8"), encoding="utf-8-sig"
    )
    assert load(tmp_path / "rig.toml").as_json() == load(EXAMPLES / "two_mass.toml").as_json()


def test_every_learner_that_numbers_suffice_for_has_a_kind() -> None:
    """Discovered, not listed: all public ones whose parameters have defaults, and each is built from its name alone."""
    assert set(LEARNERS) >= {
        "kalman",
        "harmonic",
        "nlms",
        "rls",
        "batch-gradient",
        "gaussian-process",
        "mlp",
    }
    for kind, table in LEARNERS.items():
        learner = setup(f"learner = '{kind}'").controller.learner
        assert type(learner) is table.function
        assert hasattr(ql.learners, type(learner).__name__)


def test_tables_take_what_their_calls_take() -> None:
    """Numbers, texts and lists reach the constructor under the names they have in Python."""
    learner = setup(
        "[learner]\nkind = 'harmonic'\ncount = 2\nomegas = [0.5, 1.5]\nlimits = [0.1, 3.0]"
    ).controller.learner
    assert learner == ql.learners.Harmonic(count=2, omegas=(0.5, 1.5), limits=(0.1, 3.0))
    learner = setup(
        "[learner]\nkind = 'rls'\nfeatures = ['state', {kind = 'polynomial', degree = 2}, 'input']"
    ).controller.learner
    assert repr(learner.features) == repr(
        ql.features.State() + ql.features.Polynomial(2) + ql.features.Input()
    )
    guarded = setup(
        "learner = 'kalman'\nguard = {time = 5.0}\n[prefilter]\nkind = 'zvd'\nomega = 1.4"
    ).controller
    assert guarded.prefilter == ql.baselines.ZVD(1.4)
    assert guarded.controller.guard == ql.Guard(time=5.0)


def test_a_cycle_is_a_signal_or_a_sum_of_signals() -> None:
    """There and back, fifty times."""
    scenario = setup(
        "[scenario.reference]\nkind = 'repeated'\nperiod = 6.0\ncount = 50\n"
        "cycle = [{kind = 'trapezoid'}, {kind = 'trapezoid', distance = -1.0, start = 3.0}]"
    ).scenario
    t = np.linspace(0.0, 400.0, 4001)
    moves = ql.signals.Trapezoid() + ql.signals.Trapezoid(distance=-1.0, start=3.0)
    np.testing.assert_array_equal(
        scenario.reference(t), ql.signals.Repeated(moves, 6.0, count=50)(t)
    )


def test_signals_add_up_and_follow_each_other() -> None:
    """A list is a sum, ``until`` and ``then`` are ``Signal.until``, a text is a kind, a number a constant."""
    scenario = setup(
        "[scenario]\nreference = [1.0, 'step', {kind = 'ramp', slope = 2.0, until = 3.0, then = "
        "{kind = 'sinusoid'}}]\n"
        "disturbances = [['step', 0.5], 2.0]\nnoise = 'noise'"
    ).scenario
    shapes, t = ql.signals, np.linspace(0.0, 5.0, 51)
    expected = 1.0 + shapes.Step() + shapes.Ramp(2.0).until(3.0, then=shapes.Sinusoid())
    np.testing.assert_array_equal(scenario.reference(t), expected(t))
    assert scenario.disturbances == (shapes.Step() + 0.5, 2.0)
    assert scenario.noise == shapes.BandLimitedNoise()
    assert set(SIGNALS) == set(shapes.KINDS)


@cases(
    ("text", "expected"),
    [
        ("kind = 'pid'\nkp = 2.0\nu_max = 3.0", ql.baselines.PID),
        ("kind = 'pid-simc'\ngain = 1.0\ntau1 = 2.0\ntheta = 0.1\nb = 0.5", ql.baselines.PID),
        ("kind = 'pid-simc-double-integrator'\ngain = 1.0\ntheta = 0.1", ql.baselines.PID),
        (
            "kind = 'notch-pid'\nkp = 1.0\nnotch = {omega = 1.4, depth = 0.05}",
            ql.baselines.NotchPID,
        ),
        ("kind = 'lqg'\nomega_c = 1.0\nomega_o = 10.0\nu_max = 3.0", ql.baselines.LQG),
        ("kind = 'resonance-ratio'\nomega_o = 10.0", ql.baselines.ResonanceRatio),
    ],
)
def test_the_baselines_are_kinds_of_controllers(text: str, expected: type) -> None:
    """Each with the options it passes on, and the file's plant where it needs one."""
    controller = setup(f"[controller]\n{text}", without=("observer",)).controller
    assert type(controller) is expected
    assert controller.dt == 0.01


def test_a_model_is_the_files_plant_or_its_own() -> None:
    """Of a plant with friction the observer is designed for the linear part; a delay is of the loop's samples."""
    default = setup("[observer]\nkind = 'model-based'\nomega_o = 9.0").controller.observer
    np.testing.assert_allclose(default.a, [0.0, 0.0, 2.0, 0.0], atol=1e-12)
    own = setup(
        "[observer]\nkind = 'model-based'\nomega_o = 9.0\nplant = {kind = 'two-mass', k = 2.0}"
    ).controller.observer
    np.testing.assert_allclose(own.a, [0.0, 0.0, 4.0, 0.0], atol=1e-12)
    rough = setup(
        "plant = 'torsional'\n[observer]\nkind = 'model-based'\nomega_o = 40.0", without=("plant",)
    )
    assert rough.controller.observer.order == 4
    own_rough = setup(
        "[observer]\nkind = 'model-based'\nomega_o = 40.0\nplant = {kind = 'torsional'}"
    )
    np.testing.assert_array_equal(own_rough.controller.observer.a, rough.controller.observer.a)
    late = setup("[plant]\nkind = 'delayed'\ndelay = 0.03\nplant = {kind = 'two-mass', m2 = 0.5}")
    assert late.plant.samples == 3
    linear = setup("[plant]\nkind = 'linear'\nnum = [2.0]\nden = [1.0, 3.0, 0.0]").plant
    assert sorted(np.linalg.eigvals(linear.A).real) == [-3.0, 0.0]


def test_a_guard_is_certified_for_plants_of_the_file() -> None:
    """One or several; of one with friction the linear part counts."""
    learner = "learner = 'kalman'\n"
    two = "certified_for = [{kind = 'two-mass'}, {kind = 'two-mass', k = 1.2}]"
    bounds = [
        setup(learner + "[guard]\n" + line).controller.parameters.guard.bound
        for line in ("", "certified_for = 'two-mass'", two)
    ]
    assert bounds[0] == 3.0
    assert bounds[1] >= bounds[2] > 0.0
    assert bounds[2] < 3.0


def test_none_stands_for_no_value() -> None:
    """TOML has no word for it: an encoder that is none, a learner that is none."""
    assert setup("[plant]\nkind = 'torsional'\ncounts = 'none'").plant.resolution == 0.0
    assert setup("learner = 'none'").controller.features == ()


def test_the_page_of_all_keys_has_a_row_for_each_and_says_what_it_means() -> None:
    """Taken from the docstrings of what is called; the summary of a simple signal says it for all of its keys."""
    for tables in (PLANTS, OBSERVERS, FEATURES, LEARNERS, CONTROLLERS):
        page = markdown(tables)
        for kind, table in tables.items():
            assert f"<summary><code>{kind}</code> " in page
            assert [key for key, *_, words in keys(table) if not words] == []
        assert page.count("\n| `") == sum(len(keys(table)) for table in tables.values())
    assert "| `omega_o` | number | **needed** | observer bandwidth [rad/s]" in markdown(OBSERVERS)


def test_a_setup_with_other_values_is_that_of_a_file_with_them(tmp_path: Path) -> None:
    """Paths go through tables and lists; the setup itself stays as it was."""
    text = (EXAMPLES / "two_mass.toml").read_text(encoding="utf-8")
    setup = load(EXAMPLES / "two_mass.toml")
    path = tmp_path / "two_mass.toml"
    path.write_text(text.replace("m1 = 1.0", "m1 = 0.7").replace("height = 0.5", "height = 2.0"))
    other = varied(setup, {"plant.m1": 0.7, "scenario.disturbances[1].height": 2.0})
    assert other.description == load(path).description
    assert np.array_equal(other.plant.A, load(path).plant.A)
    assert varied(setup, {}).description == setup.description
    assert varied(setup, {"learner": None}).controller.features == ()


@cases(
    ("path", "value", "message"),
    [
        ("plant.m3", 1.0, "plant.m3: unknown; must be one of kind, m1"),
        ("plant.m1", -1.0, "plant.m1 = -1.0: must be finite and greater"),
        ("plnt.m1", 1.0, "plnt: unknown; did you mean plant?"),
        ("dt.x", 1.0, "dt.x: x is no key here, but in 0.002"),
        ("scenario.disturbances[7]", 1.0, r"\[7\] is beyond the list's 2 entries"),
        ("plant[0]", 1.0, r"plant\[0\]: \[0\] is no place in a list"),
        ("plant..m1", 1.0, "must be a path of keys"),
    ],
)
def test_a_change_that_a_setup_does_not_have_is_named(
    path: str, value: float, message: str
) -> None:
    """With the file, the path and the rule."""
    setup = load(EXAMPLES / "two_mass.toml")
    with pytest.raises(SetupError, match=f"^two_mass.toml: .*{message}"):
        varied(setup, {path: value})


CONTROL = 'a\x00b\x07\x1b[31m\x7f\r\n\t"\\ \x85 é'


def test_texts_with_control_characters_reach_no_file_and_no_terminal() -> None:
    """Titles, names of signals and units are refused; TOML and scripts are written so that they can be read."""
    from quell.studio.runs import python_of, toml_of

    tables = {
        "dt": 0.01,
        "plant": {"kind": "linear", "num": [1.0], "den": [1.0, 1.0]},
        "controller": {"kind": "pid", "kp": 1.0, "u_min": -1.0, "u_max": 1.0},
    }
    for wrong, key in (
        (tables | {"title": CONTROL}, "title"),
        (tables | {"title": "a\ud800"}, "title"),
        (tables | {"plant": tables["plant"] | {"signals": {"y": "an\x1bgle [m]"}}}, "signals.y"),
    ):
        with pytest.raises(SetupError, match=rf"{key} = .*: must have no control characters"):
            made("a setup", wrong)
    text = toml_of(tables | {"title": CONTROL, CONTROL: {CONTROL: [CONTROL]}})
    read = tomllib.loads(text)
    assert (read["title"], read[CONTROL]) == (CONTROL, {CONTROL: [CONTROL]})
    compile(python_of(tables, CONTROL, True, 0.0), "script", "exec")
    assert made("a\x07b.toml", tables).title == "a?b"
