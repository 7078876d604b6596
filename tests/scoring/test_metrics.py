import numpy as np
import pytest

from pinnobs_gym.scoring.metrics import error_scores, state_errors, windows


def test_hand_computed_case():
    t = np.array([0.0, 1.0, 2.0, 3.0])
    x = np.array([[[1.0, 2.0], [1.0, 2.0], [1.0, 2.0], [1.0, 2.0]]])
    error = np.array([[[2.0, 0.0], [0.0, -4.0], [0.1, 0.0], [0.0, 0.0]]])
    got = error_scores(t, x, x + error, scale=(2.0, 4.0), transient_end=1.0)
    assert got["mae"][0] == pytest.approx((2 + 4 + 0.1) / 8)
    assert got["mse"][0] == pytest.approx((4 + 16 + 0.01) / 8)
    assert got["rmse"][0] == pytest.approx(np.sqrt((4 + 16 + 0.01) / 8))
    # |e| / mean(|x|, |xhat|): 2/2, 4/((2+2)/2), 0.1/1.05
    assert got["smape"][0] == pytest.approx(100 / 8 * (1 + 2 + 0.1 / 1.05))
    assert got["nrmse"][0] == pytest.approx(np.sqrt((1 + 1 + 0.05**2) / 8))
    assert got["nrmse_75"][0] == pytest.approx(np.sqrt((1 + 0.05**2) / 6))
    assert got["nrmse_first"][0] == pytest.approx(np.sqrt(1 / 2))
    assert got["nrmse_transient"][0] == pytest.approx(np.sqrt(1 / 2))  # the sample at 1 s
    assert got["nrmse_steady"][0] == pytest.approx(np.sqrt(0.05**2 / 4))
    assert got["nrmse_tail"][0] == 0
    assert got["peak"][0] == pytest.approx(np.sqrt(0.5))
    assert got["settling"][0] == 2.0  # the sample at 1 s is the last above 5 %
    assert not got["diverged"][0]


def test_an_error_that_stays_never_settles_and_diverges_above_a_fifth():
    t = np.linspace(0, 1, 8)
    x = np.zeros((2, 8, 1))
    xhat = x + np.array([0.19, 0.21])[:, None, None]
    got = error_scores(t, x, xhat, scale=(1.0,), transient_end=0.2)
    assert np.isinf(got["settling"]).all()
    assert got["diverged"].tolist() == [False, True]


def test_what_is_not_finite_scores_infinity_in_its_own_row_alone():
    x = np.ones((3, 8, 2))
    xhat = x.copy()
    xhat[1, 3, 0] = np.nan
    xhat[2, 0, 1] = -np.inf
    got = error_scores(np.arange(8.0), x, xhat, scale=(1.0, 1.0), transient_end=1.0)
    for name, values in got.items():
        if name != "diverged":
            assert values[0] == 0, name
            assert np.isinf(values[1:]).all(), name
    assert got["diverged"].tolist() == [False, True, True]


def test_unscored_states_do_not_count():
    x = np.zeros((1, 4, 2))
    xhat = x + np.array([0.3, 100.0])
    scored = np.zeros(x.shape, dtype=bool)
    scored[..., 0] = True
    got = error_scores(np.arange(4.0), x, xhat, scale=(1.0, 1.0), transient_end=1.0, scored=scored)
    assert got["nrmse"][0] == pytest.approx(0.3)
    assert got["rmse"][0] > 70  # the paper's metrics take all states


def test_modulo_takes_the_nearest_of_the_states_that_look_alike():
    x = np.tile([1.0, 2.0], (1, 8, 1))
    other = x * [1, -1]
    got = error_scores(
        np.arange(8.0), x, other + 0.01, scale=(1.0, 1.0), transient_end=1.0, alternatives=[other]
    )
    assert got["nrmse_modulo"][0] == pytest.approx(0.01)
    assert got["nrmse_steady_modulo"][0] == pytest.approx(0.01)
    assert got["nrmse_tail_modulo"][0] == pytest.approx(0.01)
    assert got["nrmse"][0] > 2


def test_shapes_are_checked():
    with pytest.raises(ValueError, match=r"xhat has shape \(1, 3, 2\); expected \(1, 4, 2\)"):
        error_scores(
            np.arange(4.0),
            np.zeros((1, 4, 2)),
            np.zeros((1, 3, 2)),
            scale=(1.0, 1.0),
            transient_end=1.0,
        )


@pytest.mark.parametrize(
    ("samples", "end", "transient", "steady"),
    [
        (11, 0.3, [1, 2, 3], [4, 5, 6, 7, 8, 9, 10]),  # 0.3 s is a sample, up to rounding
        (11, 0.35, [1, 2, 3], [4, 5, 6, 7, 8, 9, 10]),
        (11, 0.01, [1], list(range(2, 11))),  # ends before the second sample
        (11, 9.0, list(range(1, 10)), [10]),  # ends after the episode
        (3, 0.1, [1], [2]),
        (2, 0.1, [1], [1]),
        (1, 0.1, [0], [0]),
    ],
)
def test_windows_divide_the_samples_after_the_first(samples, end, transient, steady):
    for start in (0.0, 1e5):  # the times of a log start anywhere
        parts = windows(start + 0.1 * np.arange(samples), end)
        numbers = np.arange(samples)
        assert numbers[parts["first"]].tolist() == [0]
        assert numbers[parts["transient"]].tolist() == transient
        assert numbers[parts["steady"]].tolist() == steady
        assert all(len(numbers[part]) for part in parts.values())


def test_errors_of_each_state_by_hand():
    """Of the samples 1 and 2 to 3; the second state counts only from sample 2 on in one episode."""
    error = np.array([[[9.0, 9.0], [3.0, 4.0], [1.0, 0.0], [7.0, 2.0]]] * 3)
    scored = np.ones(error.shape, dtype=bool)
    scored[1, :2, 1] = False
    error[2, 3, 0] = np.nan
    x = np.random.default_rng(0).standard_normal(error.shape)
    found = state_errors(windows(np.arange(4.0), 1.0), x, x + error, scored)
    np.testing.assert_allclose(found["transient"], [[3, 4], [3, np.nan], [3, 4]])
    np.testing.assert_allclose(found["steady"], [[5, 2**0.5], [5, 2**0.5], [np.inf, 2**0.5]])
