"""Values that a user gives: numbers, arrays of them, parameters, and how messages show them."""

import re
from dataclasses import dataclass

import numpy as np
import pytest

from pinnobs_gym.simulation.start_law import Gaussian, Points
from pinnobs_gym.simulation.system import MOST_SAMPLES, Setup
from pinnobs_gym.simulation.values import (
    check_parameters,
    check_seed,
    finite_array,
    is_number,
    real_array,
    shortly,
)

HUGE = 10**5000


@pytest.mark.parametrize("value", [1, 1.5, np.int8(3), np.float32(2), float("nan"), float("inf")])
def test_numbers(value):
    assert is_number(value)


@pytest.mark.parametrize(
    "value", [True, np.bool_(True), 1j, np.complex128(1), "1", None, HUGE], ids=shortly
)
def test_what_is_no_number(value):
    assert not is_number(value)


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ("ab", "x holds values of type <U2, such as 'ab'; expected real numbers"),
        (["1", "2"], "such as '1'"),
        ([1j, 0], "x holds values of type complex128, such as 1j"),
        (np.array(["2030-01-01"], "datetime64[D]"), "such as datetime.date(2030, 1, 1)"),
        ([HUGE, 0], "such as a whole number of about 5001 digits"),
        ([[1, 2], [3]], "x=[[1, 2], [3]]; expected an array of real numbers"),
        ([True, False], "x holds values of type bool"),
        (np.ma.masked_array([1.0, 2.0], [0, 1]), "x has masked elements"),
    ],
)
def test_what_is_no_array_of_real_numbers(value, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        real_array("x", value)


def test_arrays_of_real_numbers_are_doubles():
    for value in (3, [1, 2.5], np.float32([1, np.nan]), np.ma.masked_array([1.0], [False])):
        assert real_array("x", value).dtype == float
    assert real_array("x", [True], truths=True).tolist() == [1.0]
    with pytest.raises(ValueError, match=r"x=\(1e\+300, 0\); expected numbers up to 1e\+30"):
        finite_array("x", (1e300, 0))


@pytest.mark.parametrize("value", [-1, 1.5, "3", True, None, float("nan"), [1]])
def test_seeds_are_whole_numbers(value):
    with pytest.raises(ValueError, match=re.escape(f"seed={value!r}; expected a whole number")):
        check_seed(value)
    assert check_seed(np.int64(3)) == 3


@dataclass(frozen=True)
class Plant:
    mass: float = 1.0
    longest: float = float("inf")
    on: bool = True
    name: str = "a"


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1j, "1", True, [1.0], np.array([1, np.nan])])
def test_parameters_are_finite_numbers(value):
    with pytest.raises(ValueError, match=r"mass=.* of Plant; expected a finite number"):
        check_parameters(Plant, {"mass": value})


def test_other_parameters_are_as_the_class_has_them():
    check_parameters(Plant, {"mass": np.array([1.0, 2.0]), "on": False, "name": "b"})
    check_parameters(Plant, {"mass": 2, "longest": float("inf")})
    with pytest.raises(ValueError, match="longest=nan"):
        check_parameters(Plant, {"longest": np.nan})


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"duration": 2**70}, "duration=1.18059e+21 s has 1.18e+22 samples of dt=0.1 s"),
        ({"dt": 1e-300}, f"expected at most {MOST_SAMPLES}"),
        ({"dt": HUGE}, "dt=a whole number of about 5001 digits s; expected a positive number"),
        ({"dt": "0.1"}, "dt='0.1' s; expected a positive number"),
        ({"dt": 1j}, "dt=1j s; expected a positive number"),
        ({"noise_std": HUGE}, "noise_std=a whole number of about 5001 digits; expected numbers"),
        ({"noise_std": 1e300}, "noise_std=1e+300; expected at most 1e+30"),
        ({"noise_std": "1"}, "noise_std='1'; expected numbers"),
        ({"noise_std": True}, "noise_std=True; expected numbers"),
        ({"x0_low": (HUGE, 0)}, "x0_low=a tuple of huge numbers; expected finite numbers"),
        ({"x0_low": (-1e308, 0)}, "x0_low=(-1e+308, 0); expected numbers up to 1e+30"),
        ({"P0": [[HUGE]]}, "P0=a list of huge numbers; expected a covariance"),
        ({"parameters": 3}, "parameters=3; expected values by name"),
    ],
)
def test_wrong_values_of_a_setup_are_named(changes, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        Setup(**{"x0_low": (0, 0), "x0_high": (1, 1), "duration": 1, "dt": 0.1, **changes})


@pytest.mark.parametrize(
    "make",
    [
        lambda: Gaussian((0, "a"), ((1, 0), (0, 1))),  # pyright: ignore[reportArgumentType]
        lambda: Gaussian((0, HUGE), ((1, 0), (0, 1))),
        lambda: Points([["a"]]),  # pyright: ignore[reportArgumentType]
        lambda: Points(3),  # pyright: ignore[reportArgumentType]
        lambda: Points([]),
    ],
)
def test_wrong_states_of_a_law_are_named(make):
    with pytest.raises(ValueError, match=r"^(x0_mean|states)=.*one finite number per state$"):
        make()


def test_values_are_shown_in_one_line():
    assert shortly("a\nb") == r"'a\nb'"
    assert shortly(np.zeros((2, 2))) == "array([[0., 0.], [0., 0.]])"
    assert len(shortly("x" * 1000)) == 60
