"""Errors over time and the example episode, against ones worked out by hand or by other means."""

from dataclasses import replace

import numpy as np
import pytest
from page_rows import curves, lines_of

from pinnobs_gym.leaderboard.site import over_samples
from pinnobs_gym.scoring.curves import Example


def test_error_over_time_is_median_and_band():
    rng = np.random.default_rng(1)
    error = np.exp(rng.normal(size=(11, 3)))
    error[:3, 2] = np.inf
    table = over_samples.errors({"ekf": curves(error), "lost": curves([[np.nan, np.inf, 1.0]])})
    for k, (t, median, low, high) in enumerate(lines_of(table, "ekf")):
        ordered = sorted(error[:, k].tolist())
        assert t == k
        assert median == pytest.approx(ordered[5], rel=1e-3)
        assert low == pytest.approx(ordered[1], rel=1e-3)  # of 11 the second is 10 % or more
        assert high == (None if k == 2 else pytest.approx(ordered[9], rel=1e-3))
    # Where nothing counts there is no point, and where nothing is finite a gap.
    assert lines_of(table, "lost") == [(1.0, None, None, None), (2.0, 1.0, 1.0, 1.0)]


def test_the_median_of_an_even_number_is_between_the_two():
    table = over_samples.errors({"ekf": curves([[1.0], [2.0], [4.0], [np.inf]], t=[0.0])})
    assert lines_of(table, "ekf") == [(0.0, 3.0, 1.0, None)]


def test_the_reference_is_of_each_episode_once():
    first = curves(np.ones((2, 3)), reference=[[1, 2, 3], [3, 4, 5]])
    second = curves(np.ones((2, 3)), reference=[[3, 4, 5], [8, 8, 8]], seeds=[1, 2])
    found = [first, second, curves(np.ones((1, 3)))]
    assert over_samples.reference(found, -1.0) == {"t": [0, 1, 2], "median": [3, 4, 5]}
    assert over_samples.reference(found, 1.0) == {"t": [2], "median": [5]}  # the steady window
    assert over_samples.reference(found[2:], 0.0) == {"t": [], "median": []}


def test_lines_of_an_angle_have_a_gap_where_it_jumps():
    """A heading wrapped at half a turn, 1 rad a second; the estimate is 0.2 rad ahead."""
    t = np.arange(8.0)
    x = np.stack([np.angle(np.exp(1j * t)), np.sin(t)], axis=-1)
    example = Example(0, t, x, x + np.array([0.2, 0.1]), x[:, :1], np.full(x.shape, 0.25))
    own = curves(np.ones((1, 8)), t=t)
    own = replace(own, example=example, state_period=(2 * np.pi, None))
    found = over_samples.states({"a": own}, {}, after=3.0)
    assert found is not None
    # π lies between 3 and 4 s; the sample at 4 s is drawn behind a gap.
    assert found.truth["t"] == [0, 1, 2, 3, 4, 4, 5, 6, 7]
    assert [k for k, value in enumerate(found.truth["x0"]) if value is None] == [4]
    assert [k for k, value in enumerate(found.truth["y0"]) if value is None] == [4]
    assert found.truth["x1"][4] == found.truth["x1"][5] is not None
    lines = lines_of(found.estimates, "a")
    assert [line[0] for line in lines] == found.truth["t"]
    assert [line[1:3] for line in lines if None in line] == [(None, None)]
    # An estimate beyond half a turn is as far from the truth as any other.
    errors = [line[3::3] for line in lines if None not in line]
    np.testing.assert_allclose(errors, 8 * [(0.2, 0.1)], rtol=1e-3)
    plain = over_samples.states({"a": replace(own, state_period=None)}, {}, after=3.0)
    assert plain is not None
    assert plain.truth["t"] == t.tolist()


def test_the_example_is_of_the_episode_that_most_have():
    own = {"a": curves(np.ones((1, 3)), seed=5), "b": curves(np.ones((1, 3)))}
    found = over_samples.states({**own, "c": curves(np.ones((1, 3)))}, {}, after=1.0)
    assert found is not None
    assert found.called == "seed 0"
    assert found.truth == {
        "t": [0, 1, 2],
        "x0": [0, 1, 2],
        "x1": [0, -1, -2],
        "y0": [0, 1, 2],
    }
    assert set(found.estimates["estimator"]) == {"b", "c"}
    assert lines_of(found.estimates, "b")[1] == (1, 2, 0.5, 1, 0, 0.5, 1)
    assert over_samples.states({}, {}, after=1.0) is None


def test_errors_are_drawn_on_the_scale_of_those_after_the_transient():
    """Errors of 10 s and -0.5 s in the transient of 2 s, then of at most 0.04 and of none."""
    t = np.arange(6.0)
    x = np.stack([np.full(6, 100.0), t], axis=-1)
    error = np.stack([[10, 5, 2, 0.04, -0.02, 0.01], [-0.5, 0, 0, 0, 0, 0]], axis=-1)
    own = curves(np.ones((1, 6)), t=t)
    own = replace(own, example=Example(0, t, x, x + error, x[:, :1], None))
    found = over_samples.states({"a": own}, {}, after=2.0)
    assert found is not None
    first, second = found.error_limits["a"]
    assert first == pytest.approx(1.25 * 0.04, rel=0.01)
    assert 0 < second < 1e-6  # of an axis that has to have a length
    assert found.estimates["e0"] == [10, 5, 2, 0.04, -0.02, 0.01]
    whole = over_samples.states({"a": own}, {}, after=np.inf)  # of a game that is not known here
    assert whole is not None
    assert whole.error_limits["a"][0] == pytest.approx(12.5)
