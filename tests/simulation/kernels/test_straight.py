"""Straight-line code: its values, and the loops that it is divided into."""

import math

import numpy as np

from pinnobs_gym.simulation.kernels.straight import ONE, ZERO, Straight, transposed


def values(straight, **given):
    """Return the values of all names, in Python."""
    names = dict(given)
    for name, code in straight._code.items():
        names.setdefault(name, eval(code, {"sin": math.sin}, names))
    return names


def numbers(rows, names):
    return np.array([[eval(entry, {}, names) for entry in row] for row in rows])


def test_products_are_those_of_the_matrices_and_leave_out_zeros():
    s = Straight()
    a, b = [["a", ZERO], [ONE, "c"]], [["a", "c"], [ZERO, "d"]]
    ab, outer = s.product(a, b), s.symmetric(a, a, [["d", "c"], ["c", "d"]])
    names = values(s, a=2.0, c=3.0, d=5.0)
    A, B = numbers(a, names), numbers(b, names)
    np.testing.assert_array_equal(numbers(ab, names), A @ B)
    np.testing.assert_array_equal(numbers(outer, names), A @ A.T + [[5, 3], [3, 5]])
    assert not any(ZERO in code for code in s._code.values())
    assert transposed(ab)[0][1] == ab[1][0]


def test_lines_with_calls_have_loops_of_their_own():
    s = Straight()
    s.define("a", "x[0][l]")
    s.define("b", "(a * a)")
    s.define("c", "sin(b)")
    s.store("y[0][l]", s.let("b + c"))
    loops = s.body().split("EACH_LANE")[1:]
    assert [("sin" in loop, "a * a" in loop, "y[0][l]" in loop) for loop in loops] == [
        (False, True, False),
        (True, False, False),
        (False, False, True),
    ]
    assert "b[l] + c[l]" in loops[2]
    assert "double b[W];" in s.body()
