"""Mistakes in what a system declares: each is one line with the class's name, at registration, when
an estimator is made, and by `check_system`."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from linear import Linear

from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.checks import check_system
from pinnobs_gym.simulation.conformance import CheckFailed
from pinnobs_gym.simulation.probe import probe
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
