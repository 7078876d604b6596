import numpy as np
import pytest

from pinnobs_gym.scoring.metrics import error_scores


def test_hand_computed_case():
    t = np.array([0.0, 1.0, 2.0, 3.0])
    x = np.array([[[1.0, 2.0], [1.0, 2.0], [1.0, 2.0], [1.0, 2.0]]])
    error = np.array([[[2.0, 0.0], [0.0, -4.0], [0.1, 0.0], [0.0, 0.0]]])
    got = error_scores(t, x, x + error, scale=(2.0, 4.0))
    assert got["mae"][0] == pytest.approx((2 + 4 + 0.1) / 8)
    assert got["mse"][0] == pytest.approx((4 + 16 + 0.01) / 8)
    assert got["rmse"][0] == pytest.approx(np.sqrt((4 + 16 + 0.01) / 8))
    # |e| / mean(|x|, |xhat|): 2/2, 4/((2+2)/2), 0.1/1.05
    assert got["smape"][0] == pytest.approx(100 / 8 * (1 + 2 + 0.1 / 1.05))
    assert got["nrmse"][0] == pytest.approx(np.sqrt((1 + 1 + 0.05**2) / 8))
    assert got["nrmse_75"][0] == pytest.approx(np.sqrt((1 + 0.05**2) / 6))
    assert got["nrmse_tail"][0] == 0
    assert got["peak"][0] == pytest.approx(np.sqrt(0.5))
    assert got["settling"][0] == 2.0  # the sample at 1 s is the last above 5 %
    assert not got["diverged"][0]


def test_an_error_that_stays_never_settles_and_diverges_above_a_fifth():
    t = np.linspace(0, 1, 8)
    x = np.zeros((2, 8, 1))
    xhat = x + np.array([0.19, 0.21])[:, None, None]
    got = error_scores(t, x, xhat, scale=(1.0,))
    assert np.isinf(got["settling"]).all()
    assert got["diverged"].tolist() == [False, True]


def test_what_is_not_finite_scores_infinity_in_its_own_row_alone():
    x = np.ones((3, 8, 2))
    xhat = x.copy()
    xhat[1, 3, 0] = np.nan
    xhat[2, 0, 1] = -np.inf
    got = error_scores(np.arange(8.0), x, xhat, scale=(1.0, 1.0))
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
    got = error_scores(np.arange(4.0), x, xhat, scale=(1.0, 1.0), scored=scored)
    assert got["nrmse"][0] == pytest.approx(0.3)
    assert got["rmse"][0] > 70  # the paper's metrics take all states


def test_modulo_takes_the_nearest_of_the_states_that_look_alike():
    x = np.tile([1.0, 2.0], (1, 8, 1))
    other = x * [1, -1]
    got = error_scores(np.arange(8.0), x, other + 0.01, scale=(1.0, 1.0), alternatives=[other])
    assert got["nrmse_modulo"][0] == pytest.approx(0.01)
    assert got["nrmse_tail_modulo"][0] == pytest.approx(0.01)
    assert got["nrmse"][0] > 2


def test_shapes_are_checked():
    with pytest.raises(ValueError, match=r"xhat has shape \(1, 3, 2\); expected \(1, 4, 2\)"):
        error_scores(np.arange(4.0), np.zeros((1, 4, 2)), np.zeros((1, 3, 2)), scale=(1.0, 1.0))
