import numpy as np
import pytest
from scipy.optimize import minimize, rosen, rosen_der

from trainers.pinn_obs import quasi_newton
from trainers.pinn_obs.quasi_newton import CURVATURE, SUFFICIENT_DECREASE, QuasiNewton


def minimise(
    objective,
    x,
    *,
    iterations=1000,
    tolerance=1e-8,
    curvature=CURVATURE,
    watch=lambda state: None,
):
    """Iterate until the largest component of the gradient is within the tolerance."""
    state = QuasiNewton.start(objective, x, curvature)
    for _ in range(iterations):
        if abs(state.gradient).max() <= tolerance or not state.step(objective):
            break
        watch(state)
    return state


def rosenbrock(x):
    return float(rosen(x)), rosen_der(x)


def hilly(x):
    """Not convex, with steep and flat places."""
    value = np.sum(np.log1p(x**2) + 0.1 * np.sin(5 * x))
    return float(value), 2 * x / (1 + x**2) + 0.5 * np.cos(5 * x)


@pytest.mark.parametrize("n", [1, 3, 12])
def test_a_quadratic_takes_n_steps_with_an_exact_line_search(n):
    rng = np.random.default_rng(n)
    A, b = rng.standard_normal((n, n)), rng.standard_normal(n)
    A = A @ A.T + np.eye(n)
    steps = []
    found = minimise(
        lambda x: (0.5 * x @ A @ x - b @ x, A @ x - b),
        np.zeros(n),
        curvature=1e-10,
        tolerance=1e-8,
        watch=steps.append,
    )
    assert len(steps) <= n
    np.testing.assert_allclose(found.x, np.linalg.solve(A, b), rtol=0, atol=1e-7)


@pytest.mark.parametrize("n", [2, 10])
def test_rosenbrocks_function_is_minimised(n):
    found = minimise(rosenbrock, np.tile([-1.2, 1.0], n // 2), tolerance=1e-9)
    assert found.f < 1e-12
    np.testing.assert_allclose(found.x, np.ones(n), atol=1e-6)


def test_it_takes_about_the_iterations_of_bfgs():
    steps, x0 = [], np.tile([-1.2, 1.0], 5)
    minimise(rosenbrock, x0, tolerance=1e-9, watch=steps.append)
    peer = minimize(rosen, x0, jac=rosen_der, method="BFGS", options={"gtol": 1e-9})
    assert len(steps) < 2 * peer.nit


@pytest.mark.parametrize("objective", [rosenbrock, hilly])
def test_every_step_satisfies_the_strong_wolfe_conditions(objective, monkeypatch):
    searches = []
    search = quasi_newton.line_search

    def watched(objective, start, direction, *rest):
        found = search(objective, start, direction, *rest)
        searches.append((start, found))
        return found

    monkeypatch.setattr(quasi_newton, "line_search", watched)
    minimise(objective, np.tile([-3.2, 1.7], 4), iterations=80, tolerance=1e-5)
    assert len(searches) > 10
    for start, found in searches:
        assert found is not None
        assert found.f <= start.f + SUFFICIENT_DECREASE * found.step * start.slope
        assert abs(found.slope) <= CURVATURE * abs(start.slope)


def test_the_matrix_satisfies_the_secant_equation():
    state = QuasiNewton.start(rosenbrock, np.tile([-1.2, 1.0], 3))
    for _ in range(40):  # past the step at which updates are added up
        x, gradient = state.x, state.gradient
        assert state.step(rosenbrock)
        H = np.stack([state.H.times(unit) for unit in np.eye(6)])
        np.testing.assert_allclose(H @ (state.gradient - gradient), state.x - x, atol=1e-10)
        np.testing.assert_allclose(H, H.T, rtol=1e-9)
        assert np.linalg.eigvalsh(H).min() > 0
        if state.direction is not None:
            np.testing.assert_allclose(state.direction, -H @ state.gradient, rtol=1e-6, atol=1e-12)


def test_at_a_minimum_there_is_no_step():
    state = QuasiNewton.start(rosenbrock, np.ones(4))
    assert not state.step(rosenbrock)
    assert state.x.tolist() == [1, 1, 1, 1]


def test_values_that_are_not_finite_are_stepped_around():
    def walled(x):
        return (float(np.sum(x - np.log(x))), 1 - 1 / x) if (x > 0).all() else (np.nan, x * np.nan)

    found = minimise(walled, np.array([40.0, 0.01]))
    np.testing.assert_allclose(found.x, [1, 1], atol=1e-6)
