"""Mistakes in what a system declares: each is one line with the class's name, at registration, when
an estimator is made, and by `check_system`."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from linear import Linear

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.checks import check_system
from pinnobs_gym.simulation.conditions import parse_condition
from pinnobs_gym.simulation.conformance import CheckFailed
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.probe import probe
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.start_law import Points
from pinnobs_gym.simulation.system import PoorPrior, System
from pinnobs_gym.simulation.truth import truth

SETUP = Linear.setups["benchmark"]
NAN, INF = np.nan, np.inf


def declared(**attributes) -> type[System]:
    """A class with these attributes in place of those of `Linear`."""
    own = type("Plant", (Linear,), {"__annotations__": {}, **attributes})
    return dataclass(frozen=True)(own)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("state_names", "ab", r"'ab'; expected a tuple of names, such as \('ab',\)"),
        ("output_names", "y", r"'y'; expected a tuple of names, such as \('y',\)"),
        ("input_names", "u", r"'u'; expected a tuple of names, such as \('u',\)"),
        ("input_names", None, "None; expected a tuple of names"),
        ("state_names", (1, 2), r"\(1, 2\); expected a tuple of names"),
        ("state_names", ("a", "a"), ".*; expected 'a' once"),
        ("state_names", ("a,b", "c"), ".*; expected names for the header of a table.*"),
        ("output_names", ("y\n",), ".*; expected names for the header of a table.*"),
        ("output_names", (), ".*; expected at least one name"),
        ("uncertain", "k", "'k'; expected a tuple of names"),
        ("state_low", 0.0, "0.0; expected a number for each of 2 states, None for no bound"),
        ("state_high", "ab", "'ab'; expected a number for each of 2 states, None for no bound"),
        ("state_low", (True, None), ".*; expected numbers, None for no bound"),
        ("state_low", (NAN, None), ".*; expected numbers, None for no bound"),
        ("breakpoints", 1.0, "1.0; expected a method"),
        ("f_jacobian", None, "None; expected a method"),
        ("draw_input", 0.0, "0.0; expected a method"),
        ("draw_input", lambda self, rng: 0.0, None),
        ("scale", 1.0, "1.0; expected a positive number for each state"),
        ("scale", "ab", "'ab'; expected a positive number for each state"),
        *(
            (name, (value, 1.0), ".*; expected a positive number for each state")
            for name in ("scale", "state_bound")
            for value in (0.0, -1.0, NAN, INF, None, True)
        ),
        ("state_bound", (1.0,), None),
        ("state_period", 3.0, "3.0; expected None or 2 entries"),
        *(
            ("model_step", value, ".*; expected None or a positive number of seconds")
            for value in (0.0, -0.1, NAN, INF, "a", True)
        ),
        ("discrete", "no", "'no'; expected True or False"),
        ("stiff", 1, "1; expected True or False"),
        ("version", "1", "'1'; expected a whole number"),
        ("input_hold", "zoh", "'zoh'; expected 'previous' or 'linear'"),
        ("units", "m", "'m'; expected a mapping from names to units"),
        ("setups", [SETUP], None),
        ("setups", {"benchmark": 1}, None),
        ("setups", {"paper": SETUP}, None),
    ],
)
def test_a_wrong_attribute_is_named(name, value, says):
    cls = declared(**{name: value})
    line = f"^system Plant: {name}{'.*expected ' if says is None else '=' + says}"
    for use in (cls.validate, lambda: probe(cls), lambda: EKF(cls())):
        with pytest.raises(TypeError, match=line) as caught:
            use()
        assert "\n" not in str(caught.value)
    with pytest.raises(CheckFailed, match=f"^attributes: TypeError: {line[1:]}"):
        check_system(cls)


@pytest.mark.parametrize("value", [1.0, None, "ab", (NAN,), ("a",), np.array([1.0, 2.0])])
def test_breakpoints_are_finite_times(value):
    cls = declared(breakpoints=lambda self: value)
    with pytest.raises(
        TypeError, match=r"^Plant\.breakpoints .*; expected a tuple of finite times"
    ):
        EKF(cls())


@pytest.mark.parametrize("value", [None, np.zeros(3), np.full((21, 1), NAN), np.full((21, 1), "a")])
def test_drawn_inputs_are_numbers_at_the_samples(value):
    cls = declared(input_names=("u",), draw_input=lambda self, rng, times: value)
    line = r"^Plant\.draw_input .*for times \(21,\); expected finite numbers of shape \(21, 1\)$"
    with pytest.raises(TypeError, match=line):
        EKF(cls())


def test_breakpoints_may_be_in_any_order():
    """A force that is switched on from 0.5 s to 1.2 s, given late before early, and twice."""

    def force(self, t, x, u):
        on = np.where((np.asarray(t) >= 0.5) & (np.asarray(t) < 1.2), 1.0, 0.0)
        return np.stack([x[..., 1], on - 2 * x[..., 0]], axis=-1)

    t, x0 = np.linspace(0.0, 2.0, 9), np.array([[0.3, -0.2]])
    paths = [
        truth(declared(f=force, breakpoints=lambda self, own=own: own)(), x0, t)
        for own in ((0.5, 1.2), (1.2, 0.5, 1.2))
    ]
    np.testing.assert_array_equal(paths[0], paths[1])


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"truth_step": 0.0}, "truth_step=0.0 s; expected a positive number of seconds"),
        ({"truth_step": NAN}, "truth_step=nan s; expected a positive number of seconds"),
        ({"transient": 2.1}, "transient=2.1 s is longer than the episode, duration=2.0 s"),
        ({"duration": True}, "duration=True s; expected a positive number of seconds"),
        ({"xhat0": (NAN, 0.0)}, r"xhat0=\(nan, 0.0\); expected finite numbers"),
        ({"x0_low": "ab"}, "x0_low='ab'; expected finite numbers"),
        ({"x0_high": (INF, 1.0)}, r"x0_high=\(inf, 1.0\); expected finite numbers"),
        ({"x0_law": 3}, "x0_law=3; expected None or a StartLaw"),
        ({"poor_prior": 3}, "poor_prior=3; expected None or a PoorPrior"),
        ({"parameters": [1]}, r"parameters=\[1\]; expected values by name"),
        ({"P0": "a"}, "P0='a'; expected a covariance, rows of numbers"),
        ({"noise_std": -1}, "noise_std=-1; expected numbers of at least 0"),
    ],
)
def test_a_wrong_value_of_a_setup_is_named(changes, line):
    with pytest.raises(ValueError, match=f"^{line}$"):
        replace(SETUP, **changes)
    with pytest.raises(ValueError, match=r"^xhat0 of the poor prior="):
        PoorPrior((NAN, 0.0), ((1.0, 0.0), (0.0, 1.0)))


def started(low, high=None, **changes):
    """A class with these bounds, and a setup with these changes."""
    setups = {"benchmark": replace(SETUP, **changes)}
    return declared(state_low=low, state_high=high, setups=setups)


@pytest.mark.parametrize(
    ("cls", "line"),
    [
        (
            declared(state_period=(None, 6.0), state_low=(None, -3.0), state_high=(None, 3.0)),
            "state_period=6 and bounds -3 to 3 of state 2; expected one of them",
        ),
        (started((5.0, None)), r"{0} comes to .*, below state_low=5, in an initial state"),
        (started(None, (None, -5.0)), r"{1} comes to .*, above state_high=-5, in an initial state"),
        (
            started((-9.0, None), xhat0=(-9.5, 0.0)),
            "{0} comes to -9.5, below state_low=-9, in the prior's mean; expected it within",
        ),
        (
            started((-9.0, None), poor_prior=PoorPrior((-9.5, 0.0), ((1.0, 0.0), (0.0, 1.0)))),
            "{0} comes to -9.5, below state_low=-9, in the poor prior's",
        ),
        (
            started(
                (-9.0, None),
                x0_low=None,
                x0_high=None,
                x0_law=Points(((-8.0, 0.0), (-9.5, 0.0))),
            ),
            "{0} comes to -9.5, below state_low=-9, in an initial state",
        ),
    ],
)
def test_what_contradicts_the_bounds_is_named(cls, line):
    expected = "^system Plant.*: " + line.format(*cls.state_names)
    for use in (lambda: probe(cls), lambda: EKF(cls()), lambda: EpisodeSource(cls)):
        with pytest.raises(TypeError, match=expected) as caught:
            use()
        assert "\n" not in str(caught.value)


def test_a_given_prior_outside_of_the_bounds_is_refused():
    cls = started((-9.0, None))
    system, setup = cls.configured()
    with pytest.raises(ValueError, match=r"^xhat0=.* comes to -9.1, below state_low=-9; expected"):
        Prior.of(system, replace(setup, xhat0=(-9.1, 0.0)), 1)
    assert Prior.of(system, setup, 2).mean.shape == (2, 2)


def test_a_truth_that_leaves_its_bounds_is_said_once(caplog):
    """An oscillation comes below zero, from which it starts."""
    say_once.cache_clear()
    cls = started((0.0, None), x0_low=(0.5, -1.0), duration=10)
    source = EpisodeSource(cls)
    for seed in (0, 1):
        assert source.play(source.draw(source.streams([seed]))).x[..., 0].min() < 0
    said = [r.getMessage() for r in caplog.records if "leaves its bounds" in r.getMessage()]
    assert said == [
        f"Plant: {cls.state_names[0]} of the true states leaves its bounds (state_low, "
        "state_high), within which estimates are kept; scores are worse for it"
    ]


def test_a_guess_further_away_stays_within_the_bounds():
    cls = started((-1.0, -1.0), (1.0, 1.0), x0_low=(-1.0, -1.0), x0_high=(1.0, 1.0), P0=None)
    system, setup = cls.configured()
    moved = parse_condition("xhat0_far").setup(system, setup)
    np.testing.assert_array_equal(moved.xhat0, (1.0, -1.0))  # from (0.3, −0.2)


def test_a_shorter_episode_has_a_shorter_transient_window():
    cls = declared(setups={"benchmark": replace(SETUP, transient=0.5)})
    windows = [cls.configured(duration=d)[1].transient_end for d in (None, 1.0, 0.4)]
    assert windows == [0.5, 0.5, 0.1]


@pytest.mark.parametrize(
    ("attributes", "says"),
    [
        ({"state_lower": (0.0, 0.0)}, "unknown attribute state_lower; did you mean state_low"),
        ({"ouput_period": (6.28, None)}, "unknown attribute ouput_period; .*mean output_period"),
        ({"modelstep": 0.1}, "unknown attribute modelstep; did you mean model_step"),
        ({"set_ups": {}}, "unknown attribute set_ups; did you mean setups"),
        ({"units": {"zz": "m"}}, "units of an unknown name 'zz'; did you mean x1, x2, y1, y2"),
        ({"units": {"x11": "m"}}, "units of an unknown name 'x11'; did you mean x1"),
    ],
)
def test_a_misspelt_attribute_is_named(attributes, says):
    cls = declared(**attributes)
    for use in (cls.validate, lambda: probe(cls)):
        with pytest.raises(TypeError, match=f"^system Plant: {says}") as caught:
            use()
        assert "\n" not in str(caught.value)


def test_other_attributes_and_parameters_may_have_any_name():
    @dataclass(frozen=True)
    class Free(Linear):
        state_lower: float = 1.0
        units = {"x1": "m", "y2": "m/s", "state_lower": "m"}
        scale_x = 3.0
        _state_lows = ()

        def f_jacobia(self):
            return 0

        @property
        def output_periods(self):
            return ()

    probe(Free)


@dataclass(frozen=True, eq=False)
class OwnNoise(Noise):
    """L, G and R that are given, from a time on."""

    given: dict = None
    since: float = 0.0

    def _at(self, name, t):
        usual = getattr(Noise, name)(self, t)
        return self.given[name] if name in self.given and t >= self.since else usual

    def L(self, t):
        return self._at("L", t)

    def G(self, t):
        return self._at("G", t)

    def R(self, t, y=None):
        return self._at("R", t)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"G": np.full((2, 2, 1), NAN)}, r"whose G\(t=1\) is \[\[nan, nan\].*; expected finite"),
        ({"L": np.full((2, 1, 1), INF)}, r"whose L\(t=1\) is .*inf.*shape \(2, m, 1\)"),
        ({"L": np.eye(3)[..., None]}, r"whose L\(t=1\) has shape \(3, 3, 1\); .*\(2, m, 1\)"),
        ({"G": np.eye(2)}, r"whose G\(t=1\) has shape \(2, 2\); expected .*\(2, m, 1\)"),
        ({"R": np.ones((2, 1, 1))}, r"whose R\(t=1\) has shape \(2, 1, 1\); .*\(2, 2, 1\)"),
        ({"R": None}, r"whose R\(t=1\) has shape \(\); expected"),
    ],
)
def test_noise_of_a_class_is_finite_and_of_the_right_shape(given, says):
    def noise(self, noise_std=None, process_noise=None):
        usual = System.noise(self, noise_std, process_noise)
        return OwnNoise(usual.process, usual.output, given=given, since=0.7)

    cls = declared(noise=noise)
    for use in (lambda: probe(cls), lambda: EKF(cls())):
        with pytest.raises(
            TypeError, match=rf"^Plant\.noise \(.*\) returns noise {says}"
        ) as caught:
            use()
        assert "\n" not in str(caught.value)
    probe(declared(noise=lambda self, a=None, b=None: System.noise(self, a, b)))


def test_noise_of_a_class_is_a_noise():
    with pytest.raises(TypeError, match=r"^Plant\.noise .* returns float ; expected a Noise$"):
        probe(declared(noise=lambda self, noise_std=None, process_noise=None: 0.1))


def test_a_default_that_no_instance_would_have_is_refused():
    class Told(declared()):
        measured_input = True

    class Trusting(EKF):
        assumed_noise = 0.1

    @dataclass(frozen=True)
    class Right(EKF):
        assumed_noise: float = 0.1

    with pytest.raises(TypeError, match=r"^system Told: measured_input = True has no effect, .*"):
        probe(Told)
    with pytest.raises(ValueError, match=r"^assumed_noise = 0\.1 has no effect, .*: float = 0\.1$"):
        Trusting(declared()())
    assert Right(declared()()).assumed_noise == 0.1
