"""A live filter gives what its estimator gives on the whole record, and refuses what is no
sample."""

import copy
import pickle
import threading
from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from linear import H, Linear, linear_record, process_covariance, runge_kutta_matrix
from live_runs import (
    ONLINE,
    PLANTS,
    TRAINED,
    UNTRAINED,
    assert_as_expected,
    begun,
    expected,
    on_plant,
    online,
    samples,
)

from pinnobs_gym import Live
from pinnobs_gym.estimation.adapters import PerEpisode
from pinnobs_gym.estimators.batch_least_squares import BatchLeastSquares
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.mhe import MHE
from pinnobs_gym.estimators.rts_smoother import RTSSmoother
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.system import independent
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.induction_motor import InductionMotor
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

QUICK = [name for name in UNTRAINED if name != "sliding_mode"]
"""Those that are tried on all systems. The design of the gain of the other one takes seconds; but
for the gain it is the Luenberger observer."""
ON_SYSTEMS = [(name, system) for name in QUICK for system in SYSTEMS.classes()]


@pytest.mark.parametrize(("name", "system"), [*ON_SYSTEMS, ("sliding_mode", "ReverseDuffing")])
def test_it_gives_what_a_run_gives_on_each_system(name, system):
    estimator, record = online(name, system)
    live = begun(estimator, record)
    assert_as_expected(
        [live.update(*each) for each in samples(record)], expected(estimator, record)
    )


@pytest.mark.parametrize("name", QUICK)
def test_it_gives_what_a_run_gives_without_compiled_code(name, monkeypatch):
    monkeypatch.setenv("PINNOBS_KERNELS", "0")
    estimator, record = online(name, "InductionMotor")
    live = begun(estimator, record)
    assert_as_expected(
        [live.update(*each) for each in samples(record)], expected(estimator, record)
    )


@pytest.mark.parametrize("name", TRAINED)
def test_it_gives_what_a_run_of_a_trained_estimator_gives(name):
    estimator, record = online(name)
    live = begun(estimator, record)
    assert_as_expected(
        [live.update(*each) for each in samples(record)], expected(estimator, record)
    )


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.__name__)
@pytest.mark.parametrize("name", ["ekf", "ukf", "mhe", "enkf", "particle", "luenberger"])
def test_it_gives_what_a_run_gives_on_other_plants(name, plant):
    """With measured inputs, steps of a map, bounds, angles, wide priors, and where it diverges."""
    if (found := on_plant(name, plant)) is None:
        pytest.skip("the estimator does not take this plant")
    estimator, record = found
    live = begun(estimator, record)
    assert_as_expected(
        [live.update(*each) for each in samples(record)], expected(estimator, record)
    )


@pytest.mark.parametrize("name", ["ekf", "particle"])
def test_without_inputs_given_it_uses_those_of_the_system(name):
    estimator, record = online(name, "InductionMotor")
    live, told = begun(estimator, record), begun(estimator, record)
    for t, y, u in samples(record):
        np.testing.assert_allclose(live.update(t, y).xhat, told.update(t, y, u).xhat, rtol=1e-12)


def test_on_a_linear_plant_it_is_the_kalman_filter():
    """filterpy's, with lost samples and one of two outputs missing now and then."""
    record = linear_record(1)
    noise, R = 0.15, np.diag([0.01, 0.04])
    live = Live(
        EKF(Linear(), (0.1, 0.2), noise, assumed_noise=0.0),
        record.prior.mean[0],
        record.prior.cov[0].tolist(),
    )
    peer = KalmanFilter(dim_x=2, dim_z=2)
    peer.x, peer.P = record.prior.mean[0].copy(), record.prior.cov[0].copy()
    peer.F, peer.Q = runge_kutta_matrix(0.1), process_covariance(noise)
    for k, (t, y, u) in enumerate(samples(record)):
        if k:
            peer.predict()
        if k % 5 == 2:
            continue  # lost
        seen = [1] if k % 5 == 3 else [0, 1]
        y = np.where([i in seen for i in range(2)], y, np.nan)
        S = H[seen] @ peer.P @ H[seen].T + R[np.ix_(seen, seen)]
        peer.update(y[seen], R=R[np.ix_(seen, seen)], H=H[seen])
        estimate = live.update(t, y.tolist(), u)
        np.testing.assert_allclose(estimate.xhat, peer.x, atol=1e-6)
        np.testing.assert_allclose(estimate.std, np.sqrt(np.diag(peer.P)), atol=1e-6)
        nis = peer.y.T @ np.linalg.solve(S, peer.y)
        assert estimate.nis == pytest.approx(float(nis), rel=1e-4)


def test_what_is_told_is_computed_once_and_is_not_the_filters_own():
    estimator, record = online("ekf")
    live, other = begun(estimator, record), begun(estimator, record)
    for t, y, u in samples(record):
        estimate = live.update(t, y, u)
        assert estimate.xhat is estimate.xhat
        assert estimate.std is estimate.std
        np.testing.assert_array_equal(estimate.xhat, other.update(t, y, u).xhat)
        estimate.xhat[:] = np.nan
        estimate.std[:] = 0.0


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickle.dumps])
@pytest.mark.parametrize("late", ["refuse", "replay"])
def test_it_is_not_copied_since_copies_would_share_its_state(copied, late):
    with pytest.raises(TypeError, match=r"a Live is neither copied nor pickled.*Live.load\(\)"):
        copied(Live(EKF(Linear()), late=late))


@pytest.mark.parametrize("name", ["ekf", "mhe", "open_loop"])
def test_an_estimate_goes_to_other_processes(name):
    estimator, record = online(name)
    live = begun(estimator, record)
    for t, y, u in samples(record, slice(5)):
        estimate = live.update(t, y, u)
        copied = pickle.loads(pickle.dumps(estimate))
        assert repr(copied) == repr(estimate)
        assert copied.t == t
        assert (copied.std is None) == (name == "open_loop")


FINITE = r"expected a finite number up to 1e\+30"
WRONG = (
    ({"t": "0.5"}, "t='0.5'; expected a finite number of s"),
    ({"t": np.nan}, "t=nan; expected a finite number of s"),
    ({"t": None}, "t=None; expected a finite number of s"),
    ({"t": [0.5]}, r"t=\[0.5\]; expected a finite number of s"),
    ({"t": True}, "t=True; expected a finite number of s"),
    ({"y": [0.1]}, r"y has shape \(1,\); InductionMotor has ny=2, expected \(2,\)"),
    ({"y": 0.1}, r"y has shape \(\); InductionMotor has ny=2, expected \(2,\)"),
    ({"y": [[0.1, 0.2]]}, r"y has shape \(1, 2\); InductionMotor has ny=2, expected \(2,\)"),
    ({"y": [0.1, None]}, r"y=\[0.1, None\]; expected 2 number\(s\), NaN if it is missing"),
    ({"y": [0.1, "1"]}, r"y=\[0.1, '1'\]; expected 2 number\(s\), NaN if it is missing"),
    ({"y": [1j, 0.1]}, r"y=\[1j, 0.1\]; expected 2 number\(s\), NaN if it is missing"),
    ({"y": [[0.1], [0.1, 0.2]]}, r"y=\[.*\]; expected 2 number\(s\), NaN if it is missing"),
    ({"y": [0.1, np.inf]}, f"y2=inf; {FINITE}, or NaN if it is missing"),
    ({"y": [np.nan, -np.inf]}, f"y2=-inf; {FINITE}, or NaN if it is missing"),
    ({"y": [np.inf, -np.inf]}, f"y1=inf; {FINITE}, or NaN if it is missing"),
    ({"y": [1e308, -1e308]}, f"y1=1e[+]308; {FINITE}, or NaN if it is missing"),
    ({"y": np.array([np.nan, 1e31])}, f"y2=1e[+]31; {FINITE}, or NaN if it is missing"),
    ({"u": [0.1]}, r"u has shape \(1,\); InductionMotor has nu=2, expected \(2,\)"),
    ({"u": [np.nan, 0.1]}, f"u1=nan; {FINITE}"),
    ({"u": [0.1, np.inf]}, f"u2=inf; {FINITE}"),
    ({"u": [-1e308, 0.1]}, f"u1=-1e[+]308; {FINITE}"),
    ({"u": ["a", "b"]}, r"u=\['a', 'b'\]; expected 2 number\(s\)"),
    ({"u": [1.0, 2.0]}, "input u1=1 at t=.* is not that of InductionMotor.input, .*"),
    ({"t": 0.0}, "t=0 s is not after the last sample, t=0.002 s; expected a later one, .*"),
    ({"t": 0.002}, "t=0.002 s is not after the last sample, t=0.002 s; expected a later one, .*"),
    ({"t": 14.0}, "t=14 s is 14 s after t=0.002 s; expected at most longest_gap=0.1 s, with .*"),
    ({"t": 1e8}, "t=100000000 s is 1e[+]08 s after t=0.002 s; expected at most .*"),
)


@pytest.mark.parametrize("name", QUICK)
def test_what_is_no_sample_is_refused_and_changes_nothing(name):
    estimator, record = online(name, "InductionMotor")
    live, other = (begun(estimator, record, longest_gap=0.1) for _ in range(2))
    played = samples(record)
    for each in played[:3]:
        live.update(*each)
        other.update(*each)
    given = dict(zip("tyu", played[3], strict=True))
    for changes, line in WRONG:
        with pytest.raises(ValueError, match=f"^{line}$") as caught:
            live.update(**{**given, **changes})
        assert "\n" not in str(caught.value)
    for each in played[3:6]:
        np.testing.assert_array_equal(live.update(*each).xhat, other.update(*each).xhat)


def test_a_number_is_one_output_and_what_is_like_an_array_is_taken():
    estimator, record = online("ekf")
    t, y, u = samples(record)[0]
    first = begun(estimator, record).update(t, y, u)
    value = float(y[0])
    for same in (value, np.float64(value), [value], (value,), np.array(value), [np.float64(value)]):
        estimate = begun(estimator, record).update(np.float64(t), same)
        np.testing.assert_array_equal(estimate.xhat, first.xhat)
    whole = begun(estimator, record).update(np.int64(0), np.float32(1.0)).xhat
    np.testing.assert_array_equal(whole, begun(estimator, record).update(0, 1).xhat)
    masked = np.ma.masked_array([1.0], mask=[True])
    missing = begun(estimator, record).update(0.0, np.nan).xhat
    np.testing.assert_array_equal(begun(estimator, record).update(0.0, masked).xhat, missing)
    largest = begun(estimator, record).update(0.0, [1e30])
    assert largest.t == 0.0


@pytest.mark.parametrize("name", ["ekf", "ukf", "particle"])
def test_measured_inputs_are_needed(name):
    estimator, record = on_plant(name, PLANTS[1])
    assert estimator.system.measured_input
    live = begun(estimator, record)
    with pytest.raises(
        ValueError, match=r"^u is missing; Cart has 2 measured input\(s\), expected"
    ):
        live.update(0.0, [1.0, 0.1])


def test_a_map_is_sampled_at_whole_steps():
    estimator, record = on_plant("ekf", PLANTS[6])
    assert estimator.system.discrete
    live = begun(estimator, record)
    live.update(0, 0.1)
    with pytest.raises(ValueError, match=r"^a sample has t=0.5; Henon is a map, expected whole"):
        live.update(0.5, 0.1)
    with pytest.raises(
        ValueError, match=r"^t=5000 steps is 5e\+03 steps after t=0 steps; expected"
    ):
        live.update(5000, 0.1)
    assert live.update(3, 0.1).t == 3.0


@pytest.mark.parametrize("name", ONLINE)
def test_no_gap_takes_forever(name):
    """Not even if it is allowed: the model would take too many steps, or that of a fallback."""
    estimator, record = online(name)
    live = begun(estimator, record, longest_gap=1e9)
    for each in samples(record, slice(3)):
        live.update(*each)
    with pytest.raises(
        ValueError, match=r"^from t=0.04 s to t=100000000 s, ReverseDuffing would take .*"
    ):
        live.update(1e8, record.y[0, 3])
    assert live.t == record.t[2]


def test_milliseconds_taken_for_seconds_are_refused_by_default():
    live = Live(EKF(ReverseDuffing()))
    live.update(0.0, 0.1)
    with pytest.raises(
        ValueError, match=r"^t=20 s is 20 s after t=0 s; expected at most longest_g"
    ):
        live.update(20.0, 0.1)  # 20 ms
    assert live.update(9.9, 0.1).t == 9.9


# Late samples


@pytest.mark.parametrize("name", ONLINE)
def test_late_samples_are_replayed_to_what_a_run_in_order_gives(name):
    estimator, record = online(name)
    live, played = begun(estimator, record, late="replay"), samples(record)
    order = [1, 3, 0, 2, 5, 4, 9, 8, 7, 6, *range(11, 20), 10, *range(20, len(played))]
    for k in order:
        estimate = live.update(*played[k])
    wanted = expected(estimator, record)
    assert_as_expected([estimate], wanted, len(played) - 1)


def test_the_estimate_after_a_late_sample_is_that_of_the_last_one():
    estimator, record = online("ekf")
    played = samples(record)
    live = begun(estimator, record, late="replay")
    for k in (0, 1, 3, 4):
        live.update(*played[k])
    estimate = live.update(*played[2])
    assert estimate.t == live.t == record.t[4]
    assert_as_expected([estimate], expected(estimator, record.first_samples(5)), 4)


def test_what_is_late_beyond_the_ring_or_was_taken_is_refused():
    estimator, record = online("ukf")
    played = samples(record)
    live = begun(estimator, record, late="replay", ring=4)
    for k in (0, 1, 2, 3, 4, 6, 7, 9, 10):
        live.update(*played[k])
    for k in (4, 2, 0):
        line = (
            r"is older than the latest 4 samples, which go back to t=0.12 s; expected a later one"
        )
        with pytest.raises(ValueError, match=line):
            live.update(*played[k])
    with pytest.raises(ValueError, match=r"^a sample with t=0.18 s was taken before; expected all"):
        live.update(*played[9])
    with pytest.raises(ValueError, match=r"^y has shape"):
        live.update(record.t[8], [1.0, 2.0])
    for k in (5, 8):  # the first of them has become the oldest that is kept
        live.update(*played[k])
    estimate = live.update(*played[11])
    assert_as_expected([estimate], expected(estimator, record.first_samples(12)), 11)


def test_a_sample_long_before_the_first_is_refused():
    estimator, record = online("ekf")
    live = begun(estimator, record, late="replay")
    live.update(100.0, 0.1)
    with pytest.raises(ValueError, match=r"^t=100 s is 95 s after t=5 s; expected at most longest"):
        live.update(5.0, 0.1)
    assert live.update(99.0, 0.1).t == 100.0


# Prediction


@pytest.mark.parametrize("name", ["ekf", "ukf", "particle", "mhe", "luenberger"])
def test_a_prediction_is_a_sample_without_outputs_that_is_forgotten(name):
    estimator, record = online(name)
    live, other = begun(estimator, record), begun(estimator, record)
    for each in samples(record, slice(3)):
        live.update(*each)
        other.update(*each)
    ahead = live.predict(1.0)
    lost = other.update(1.0, np.nan)
    assert ahead.t == 1.0
    assert ahead.nis is None
    np.testing.assert_array_equal(ahead.xhat, lost.xhat)
    assert live.t == record.t[2]
    played = [live.update(*each) for each in samples(record, slice(3, 6))]
    assert_as_expected(played, expected(estimator, record), 3)


def test_a_prediction_of_a_linear_plant_is_its_flow():
    record = linear_record(1)
    live = begun(EKF(Linear(), assumed_noise=0.0), record)
    x = live.update(*samples(record)[0]).xhat
    ahead = live.predict(0.3).xhat
    np.testing.assert_allclose(ahead, np.linalg.matrix_power(runge_kutta_matrix(0.1), 3) @ x)


def test_a_prediction_holds_the_last_measured_inputs():
    estimator, record = on_plant("ekf", PLANTS[1])
    live, (first, second) = begun(estimator, record), samples(record, slice(2))
    live.update(*first)
    ahead = live.predict(second[0])
    np.testing.assert_array_equal(ahead.xhat, live.predict(second[0], first[2]).xhat)


def test_a_prediction_is_of_a_later_time():
    live = Live(EKF(ReverseDuffing()))
    with pytest.raises(
        ValueError, match=r"^t=0.1 is before the first sample, at which the prior h"
    ):
        live.predict(0.1)
    live.update(0.1, 0.3)
    with pytest.raises(ValueError, match=r"^t=0.1 s is not after the last sample, t=0.1 s; expect"):
        live.predict(0.1)
    with pytest.raises(ValueError, match=r"^t=1000 s is 1e\+03 s after t=0.1 s; expected at most "):
        live.predict(1000.0)
    with pytest.raises(ValueError, match=r"^t='1'; expected a finite number of s$"):
        live.predict("1")


# What it begins with


class Mean:
    """The mean of all outputs."""

    def reset(self, xhat0, P0):
        self.x = xhat0

    def update(self, t, y, u):
        return self.x


def test_only_online_estimators_of_one_plant_are_taken():
    system = ReverseDuffing()
    for offline in (RTSSmoother(system), BatchLeastSquares(system)):
        line = (
            rf"^{offline.label} is offline: it needs the whole record for each estimate; expected"
        )
        with pytest.raises(ValueError, match=line):
            Live(offline)
    with pytest.raises(
        ValueError, match=r"^per_episode is an adapter of objects that change in pl"
    ):
        Live(PerEpisode(system, make=Mean))
    with pytest.raises(TypeError, match=r"is no estimator; expected an online one, such as EKF"):
        Live(system)
    motors = replace(InductionMotor(), J=np.array([0.1, 0.2]))
    with pytest.raises(
        ValueError, match=r"^J of InductionMotor has 2 values; expected that of one plant"
    ):
        Live(EKF(motors))


def test_the_prior_is_the_setups_unless_it_is_given():
    system = ReverseDuffing()
    own = Live(EKF(system)).update(0.0, 0.4)
    setup = system.setups["benchmark"]
    same = Live(EKF(system), setup.xhat0, setup.P0).update(0.0, 0.4)
    np.testing.assert_array_equal(own.xhat, same.xhat)
    other = Live(EKF(system, noise_std=0.5), (1.0, 2.0), independent(0.5, 0.3)).update(0.0, 0.4)
    np.testing.assert_allclose(other.xhat, [1.0 + 0.5 * (0.4 - 1.0), 2.0])  # P0 = R
    np.testing.assert_allclose(other.std, [0.5 / np.sqrt(2), 0.3])
    assert other.nis == pytest.approx(0.36 / 0.5)


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"xhat0": (1.0,)}, r"xhat0 has shape \(1,\); expected 2 number\(s\)"),
        ({"xhat0": (1.0, np.nan)}, r"xhat0=\[1.0, nan\] is not finite"),
        (
            {"P0": (0.5, 0.3)},
            r"P0 has shape \(2,\); expected a covariance, \(nx, nx\)=\(2, 2\); .*",
        ),
        ({"P0": ((1, 2), (2, 1))}, r"P0=.*; expected a covariance, without eigenvalues below 0"),
        ({"late": "sometimes"}, "late='sometimes'; expected 'refuse' or 'replay'"),
        ({"ring": 0}, "ring=0; expected a whole number of at least 1 sample"),
        ({"ring": 2.5}, "ring=2.5; expected a whole number of at least 1 sample"),
        ({"longest_gap": 0.0}, "longest_gap=0.0; expected a positive number of s"),
        ({"longest_gap": np.nan}, "longest_gap=nan; expected a positive number of s"),
        ({"longest_gap": "1"}, "longest_gap='1'; expected a positive number of s"),
    ],
)
def test_what_it_cannot_begin_with_is_refused_in_one_line(settings, line):
    with pytest.raises(ValueError, match=f"^{line}$"):
        Live(EKF(ReverseDuffing()), **settings)


def test_filters_of_two_threads_do_not_disturb_each_other():
    estimator, record = online("ekf", "Satellite")
    wanted, found = expected(estimator, record), {}

    def play(number):
        for _ in range(20):
            live = begun(estimator, record)
            found[number] = [live.update(*each) for each in samples(record)]

    threads = [threading.Thread(target=play, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for number in range(4):
        assert_as_expected(found[number], wanted)


def test_kept_estimates_do_not_keep_particles_or_windows():
    """An estimate holds a few numbers, whatever the estimator remembers."""
    for estimator in (online("particle")[0], MHE(ReverseDuffing()), UKF(ReverseDuffing())):
        live = Live(estimator)
        live.update(0.0, 0.1)
        assert len(pickle.dumps(live.update(0.02, 0.1))) < 1500
        held = vars(live.update(0.04, 0.1))["_source"]
        assert "State" not in type(held).__name__
