"""The nearest point of a box, against SciPy's bounded least squares."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from pinnobs_gym.estimation.estimator import State
from pinnobs_gym.estimation.projection import kept_inside, nearest, nearest_points
from pinnobs_gym.simulation.bounds import StateBox


def drawn(n, batch, seed=0):
    """Points, covariances, and a box whose sides are partly open."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((batch, n, n))
    low = np.where(rng.random(n) < 0.7, -rng.random(n), -np.inf)
    high = np.where(rng.random(n) < 0.5, rng.random(n) + 0.1, np.inf)
    x = 3 * rng.standard_normal((batch, n))
    return x, A @ A.swapaxes(1, 2) + 1e-3 * np.eye(n), StateBox(low, high)


@pytest.mark.parametrize("n", [1, 2, 3, 5, 12])
def test_the_nearest_point_is_scipys(n):
    x, P, box = drawn(n, 40)
    found = nearest(x, P, box)
    for i in range(len(x)):
        W = np.linalg.inv(np.linalg.cholesky(P[i]))  # WᵀW = P⁻¹
        peer = lsq_linear(W, W @ x[i], bounds=(box.low, box.high), tol=1e-14, method="bvls")
        np.testing.assert_allclose(found[i], peer.x, atol=1e-9 * abs(x[i]).max())
    assert not box.outside(found).any()


def test_rows_do_not_depend_on_each_other():
    x, P, box = drawn(5, 30)
    x[3], x[4, 0], P[5] = 0.0, np.nan, np.nan
    together = nearest(x, P, box)
    for i in range(len(x)):
        alone = nearest(x[i : i + 1], P[i : i + 1], box)[0]
        np.testing.assert_array_equal(together[i], alone)
    np.testing.assert_array_equal(together[4], x[4])  # diverged
    assert not box.outside(together[5])  # no metric: each component by itself


def test_what_is_known_of_a_sum_is_kept():
    """A sum of two states is known to 1e-6, their difference is not; by hand, (−2, 6) → (0, 4)."""
    P = np.array([[[9.0, -9.0 + 1e-12], [-9.0 + 1e-12, 9.0]]])
    box = StateBox(np.zeros(2), np.full(2, np.inf))
    found = nearest(np.array([[-2.0, 6.0]]), P, box)
    np.testing.assert_allclose(found, [[0.0, 4.0]], atol=1e-6)


def test_components_that_cannot_move_are_set_to_their_bounds():
    box = StateBox(np.array([0.0, -np.inf, 0.0]), np.array([1.0, np.inf, np.inf]))
    x = np.array([[2.0, 5.0, -1.0]])
    still = np.zeros((1, 3, 3))
    np.testing.assert_array_equal(nearest(x, still, box), [[1.0, 5.0, 0.0]])
    dependent = np.ones((1, 3, 3))  # all three move together: not both bounds can be reached
    found = nearest(x, dependent, box)
    assert not box.outside(found).any()
    # A prior of 1e9 beside a known sum: singular in double precision.
    P = 1e18 * np.array([[[1.0, -1.0], [-1.0, 1.0]]])
    found = nearest(np.array([[-1e9, 1e9 + 4]]), P, StateBox(np.zeros(2), np.full(2, np.inf)))
    np.testing.assert_allclose(found, [[0.0, 4.0]], atol=1e-6)  # the digits of 1e9


def test_points_are_moved_in_the_metric_of_their_row():
    x, P, box = drawn(3, 10)
    points = np.stack([x, -x, 0.5 * x])
    found = nearest_points(points, P, box)
    for k in range(3):
        np.testing.assert_array_equal(found[k], nearest(points[k], P, box))


def test_a_state_without_covariance_is_clipped():
    box = StateBox(np.array([0.0, -1.0]), np.array([np.inf, 1.0]))
    state = kept_inside(State(np.array([[-1.0, 3.0], [np.nan, 9.0]])), box)
    np.testing.assert_array_equal(state.xhat, [[0.0, 1.0], [np.nan, 1.0]])
