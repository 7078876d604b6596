"""Formulas of columns, against Python's own arithmetic, and what is none."""

import math
import re

import numpy as np
import pytest

from pinnobs_gym.logs.formulas import FUNCTIONS, parsed

COLUMNS = {
    "a": np.array([0.3, 0.7, -0.2]),
    "b": np.array([2.0, 0.5, 4.0]),
    "Time (s)": np.array([10.0, 20.0, 30.0]),
    "log": np.array([1.0, 2.0, 3.0]),
}
PYTHON = {name: getattr(math, name, abs) for name in FUNCTIONS}


@pytest.mark.parametrize(
    "text",
    [
        "a",
        "a*1e-3",
        " a + b*2 - 3/b ",
        "1-2-3",
        "8/2/2",
        "-a**2",
        "2**-1",
        "2**3**2",
        "-(-a)",
        "+a--b",
        "2*-a",
        ".5*b+5.",
        "(a+b)*(a-b)",
        "sin(a)+cos(a)*tan(a)",
        "asin(a)-acos(a)",
        "atan2(a, b)",
        "sqrt(b)+abs(a)-exp(a)/log(b+1)",
        "radians(a)*degrees(b)/pi",
        "b**0",
    ],
)
def test_a_formula_is_as_in_python(text):
    found = parsed(text).values(COLUMNS, 3)
    for k in range(3):
        row = {name: COLUMNS[name][k].item() for name in ("a", "b")}
        expected = eval(text.strip(), {"pi": math.pi, **PYTHON}, row)
        assert found[k] == pytest.approx(expected, rel=1e-15)


def test_names_in_braces_are_columns_of_any_name():
    formula = parsed("{Time (s)}/10 + {a} + log + log(log)")
    assert formula.columns == ("Time (s)", "a", "log")
    expected = COLUMNS["Time (s)"] / 10 + COLUMNS["a"] + COLUMNS["log"] + np.log(COLUMNS["log"])
    np.testing.assert_allclose(formula.values(COLUMNS, 3), expected, rtol=1e-15)


def test_nothing_follows_from_a_missing_value():
    columns = {"a": np.array([np.nan, 1.0]), "b": np.array([2.0, 3.0])}
    for text in ("a*b", "a**0", "b+0*a", "atan2(b, a)"):
        assert np.isnan(parsed(text).values(columns, 2)).tolist() == [True, False]
    np.testing.assert_array_equal(parsed("7").values({}, 3), [7.0, 7.0, 7.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the end is unexpected; expected a name, a number or '('"),
        ("a b", "'b' is unexpected; expected an operator or the end"),
        ("2a", "'a' is unexpected"),
        ("a.b", "'.' is not part of a formula"),
        ("a.__class__", "'.' is not part"),
        ("__import__('os')", '"\'" is not part'),
        ("eval(a)", "unknown function 'eval'; known are sin, cos, "),
        ("sin()", "')' is unexpected; expected a name"),
        ("sin(a, b)", "',' is unexpected; expected ')'"),
        ("atan2(a)", "')' is unexpected; expected ','"),
        ("(a", "the end is unexpected; expected ')'"),
        ("a)", "')' is unexpected; expected an operator"),
        ("a+", "the end is unexpected"),
        ("a***2", "'*' is unexpected"),
        ("a//2", "'/' is unexpected"),
        ("a=1", "'=' is not part"),
        ("a^2", "'^' is not part"),
        ("a%2", "'%' is not part"),
        ("[a]", "'[' is not part"),
        ("lambda: 1", "':' is not part"),
        ("{a", "'{' is not part"),
        ("1j", "'j' is unexpected"),
        ("1_000", "'_000' is unexpected"),
        ("(" * 60 + "a" + ")" * 60, "more than 40 levels; expected fewer parentheses and signs"),
        ("-" * 60 + "a", "more than 40 levels"),
        ("a**" * 60 + "a", "more than 40 levels"),
        ("sin(" * 60 + "a" + ")" * 60, "more than 40 levels"),
        ("(" * 100_000, "100000 characters; expected at most 500"),
    ],
)
def test_what_is_no_formula_is_one_short_line(text, message):
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        parsed(text)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("text", ["9**9**9", "9" * 400, "1e999", "1/0", "sqrt(-1)", "exp(exp(9))"])
def test_numbers_that_are_too_large_or_none_are_not_finite(text):
    assert not np.isfinite(parsed(text).values({}, 1)).any()


def test_a_long_chain_of_operations_needs_no_depth():
    assert parsed("1" + "+1" * 249).values({}, 1).tolist() == [250.0]
