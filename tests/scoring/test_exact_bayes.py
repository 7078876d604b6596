"""Exact Bayes against the Kalman filter, least squares, a grid and its own calibration."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from linear import (
    A,
    H,
    Linear,
    Modulated,
    jacobians,
    process_covariance,
    record_of,
    runge_kutta_matrix,
)
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.scoring import rows as rows_module
from pinnobs_gym.scoring.episode_law import EpisodeLaw
from pinnobs_gym.scoring.exact_bayes import LEAST_ESS, exact_bayes
from pinnobs_gym.scoring.floor import floors_of, run_floor, too_few
from pinnobs_gym.scoring.particle_reference import particle_reference
from pinnobs_gym.scoring.proposals import Mixture
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.start_law import Gaussian
from pinnobs_gym.simulation.system import Setup, independent, stack

MEAN, COV = (1.0, -2.0), ((0.5, -0.3), (-0.3, 0.4))


@dataclass(frozen=True)
class Started(Linear):
    """The linear plant with a Gaussian start."""

    setups = {"benchmark": Setup(x0_law=Gaussian(MEAN, COV), duration=1.0, dt=0.1, noise_std=0.1)}


def kalman(record, R, Q=0.0):
    """Filtered means and covariances of `Started`."""
    F, xhat, P, found = runge_kutta_matrix(0.1), np.tile(MEAN, (record.batch, 1)), np.array(COV), []
    for k in range(record.num_samples):
        if k:
            xhat, P = xhat @ F.T, F @ P @ F.T + Q
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        xhat, P = xhat + (record.y[:, k] - xhat @ H.T) @ K.T, P - K @ H @ P
        found.append((xhat, P))
    means, covariances = zip(*found, strict=True)
    return np.array(means).swapaxes(0, 1), np.array(covariances)


def test_from_a_gaussian_start_it_is_the_kalman_filter_to_a_percent():
    source = EpisodeSource(Started)
    episodes = source.play(source.draw(source.streams(range(10))))
    record, x = source.record(episodes), episodes.x[:-1].swapaxes(0, 1)
    found = exact_bayes(EpisodeLaw.of(source), record)
    assert found.filtered.ess.min() >= LEAST_ESS
    xhat, P = kalman(record, 0.01 * np.eye(2))
    rms = [np.sqrt(np.mean((each - x) ** 2)) for each in (found.filtered.mean, xhat)]
    assert rms[0] == pytest.approx(rms[1], rel=0.01)
    # Each mean and covariance, within five standard errors of as many independent draws.
    std = np.sqrt(np.einsum("kii->ki", P))
    error = 5 / np.sqrt(found.filtered.ess)[..., None]
    assert (abs(found.filtered.mean - xhat) < error * std).all()
    size = std[..., None] * std[..., None, :]
    assert (abs(found.filtered.cov - P) < 1.5 * error[..., None] * size).all()


@dataclass(frozen=True)
class WideLinear(Linear):
    setups = {"benchmark": replace(Linear.setups["benchmark"], x0_low=(-5, -5), x0_high=(5, 5))}


@dataclass(frozen=True)
class WideModulated(Modulated):
    setups = WideLinear.setups


def plain(record):
    """C, and the outputs, of `WideLinear`."""
    return np.repeat(H[None], record.num_samples, axis=0), record.y


def demodulated(record):
    """C, and the outputs less what is known of them, of `WideModulated`."""
    sine = 0.5 * np.stack([np.sin(3 * record.t), 0 * record.t], axis=-1)
    C = jacobians(WideModulated(), record.t, record.u[0])
    return C, record.y - record.u * (0.7, -1.1) - sine


@pytest.mark.parametrize(("cls", "outputs"), [(WideLinear, plain), (WideModulated, demodulated)])
def test_on_a_linear_system_exact_bayes_is_least_squares(cls, outputs):
    """With a uniform prior much wider than what one output leaves open."""
    source = EpisodeSource(cls)
    record = record_of(source, 3)
    posterior = exact_bayes(EpisodeLaw.of(source), record).filtered
    C, y = outputs(record)
    assert posterior.ess.min() >= LEAST_ESS
    F, Phi = runge_kutta_matrix(0.1), np.eye(2)
    information, right = np.zeros((2, 2)), np.zeros((2, 3))
    for k in range(record.num_samples):
        G = C[k] @ Phi
        information += G.T @ G / 0.01
        right += G.T @ y[:, k].T / 0.01
        if k >= 2:
            cov = Phi @ np.linalg.inv(information) @ Phi.T
            off = posterior.mean[:, k] - (Phi @ np.linalg.solve(information, right)).T
            assert (abs(off) < 0.25 * np.sqrt(np.diag(cov))).all()
            np.testing.assert_allclose(
                posterior.cov[:, k], np.repeat(cov[None], 3, axis=0), atol=0.25 * abs(cov).max()
            )
        Phi = F @ Phi


@pytest.mark.slow
def test_no_filter_is_better():
    source = EpisodeSource("ReverseDuffing", duration=4.0)
    episodes = source.play(source.draw(source.streams(range(12))))
    record, x = source.record(episodes), episodes.x[:-1].swapaxes(0, 1)
    posterior = exact_bayes(EpisodeLaw.of(source), record).filtered
    errors = {}
    for name, xhat in (("bayes", posterior.mean), ("ekf", EKF(source.system).run(record).xhat)):
        errors[name] = np.sqrt(np.mean(((xhat - x) / source.system.scale) ** 2))
    assert errors["bayes"] < errors["ekf"]


def test_smoothed_it_is_the_trajectory_of_the_last_posterior():
    """Without process noise, the smoothed mean at each sample leads to the last filtered one."""
    source = EpisodeSource(Started)
    record = record_of(source, 2)
    found = exact_bayes(EpisodeLaw.of(source), record)
    ahead = expm(0.1 * (record.num_samples - 1) * A)
    last = found.smoothed.mean[:, 0] @ ahead.T
    np.testing.assert_allclose(last, found.filtered.mean[:, -1], atol=1e-8)
    assert (np.linalg.det(found.smoothed.cov[:, 0]) < np.linalg.det(found.filtered.cov[:, 0])).all()


def test_two_seeds_differ_by_their_error():
    source = EpisodeSource("ReverseDuffing", duration=2.0)
    record, law = record_of(source, 2), EpisodeLaw.of(source)
    first, second = (exact_bayes(law, record, seed=seed).filtered for seed in (0, 1))
    std = np.sqrt(np.einsum("bkii->bki", first.cov))
    error = np.sqrt(1 / first.ess + 1 / second.ess)[..., None]
    off = (first.mean - second.mean) / (std * error)
    assert 0.4 < np.sqrt(np.mean(off**2)) < 1.5
    assert abs(off).max() < 6


def test_an_episode_does_not_depend_on_its_batch():
    source = EpisodeSource("ReverseDuffing", duration=0.4)
    law, record = EpisodeLaw.of(source), record_of(source, 2)
    both = exact_bayes(law, record).filtered
    alone = exact_bayes(law, record.rows(slice(1, 2))).filtered
    np.testing.assert_array_equal(both.mean[1:], alone.mean)


def test_it_is_the_quadrature_over_a_grid():
    """Of a plant that is not linear, at its first five samples, with SciPy's solver."""
    source = EpisodeSource("ReverseDuffing", duration=0.3, dt=0.06)
    system, record = source.system, record_of(source, 2)
    found = exact_bayes(EpisodeLaw.of(source), record)
    for row in range(2):
        # A grid about the positions that the first output allows.
        x1 = record.y[row, 0, 0] + np.linspace(-0.1, 0.1, 61)
        x = np.stack(np.meshgrid(x1, np.linspace(-1.8, 1.8, 721), indexing="ij"), -1).reshape(-1, 2)
        x = x[system.admissible(x) & source.start.contains(x)]

        def rate(t, flat, shape=x.shape):
            state = flat.reshape(shape)
            return np.stack([state[:, 1] ** 3, -state[:, 0]], axis=-1).ravel()

        end = float(record.t[-1])
        path = solve_ivp(rate, (0, end), x.ravel(), t_eval=record.t, rtol=1e-8, atol=1e-10).y
        path = np.moveaxis(path.reshape(*x.shape, -1), -1, 0)
        log_weight = np.cumsum(-((record.y[row] - path[..., 0]) ** 2) / (2 * 0.02**2), axis=0)
        weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
        weight /= weight.sum(axis=1, keepdims=True)
        mean = np.einsum("kn,kni->ki", weight, path)
        std = np.sqrt(np.einsum("kn,kni->ki", weight, (path - mean[:, None]) ** 2))
        error = 5 * std / np.sqrt(found.filtered.ess[row])[:, None]
        assert (abs(found.filtered.mean[row] - mean) < error).all()
        own = np.sqrt(np.einsum("kii->ki", found.filtered.cov[row]))
        np.testing.assert_allclose(own, std, rtol=0.12)


@dataclass(frozen=True)
class Uncertain(Linear):
    """A damped oscillator whose stiffness a mismatch changes."""

    stiffness: float = 2.0
    uncertain = ("stiffness",)
    setups = {"benchmark": Setup((-1.0, -1.0), (1.0, 1.0), duration=1.6, dt=0.1, noise_std=0.1)}

    def f(self, t, x, u):
        return stack(x, x[..., 1], -self.stiffness * x[..., 0] - 0.3 * x[..., 1])


@pytest.mark.parametrize(
    "condition",
    [
        *("x0_outside+dropout30", "mismatch30"),
        *(pytest.param(c, marks=pytest.mark.slow) for c in ("outliers", "delay2", "noise5+gap")),
    ],
)
def test_its_covariance_is_that_of_its_errors_under_the_law(condition):
    """The mean of (x − x̂)ᵀP⁻¹(x − x̂) over the law is nx: its standard error is about 0.3 here."""
    source = EpisodeSource(Uncertain, condition=condition)
    count = 40
    episodes = source.play(source.draw(source.streams(range(count))))
    found = exact_bayes(EpisodeLaw.of(source), source.record(episodes)).filtered
    for k in (3, -1):
        error = episodes.x[:-1][k] - found.mean[:, k]
        square = np.einsum("bi,bij,bj->b", error, np.linalg.inv(found.cov[:, k]), error)
        assert 1.1 < square.mean() < 3.1


@dataclass(frozen=True)
class Escaping(Linear):
    """A plant that leaves the finite numbers from states beyond 0.45, which none of the law is."""

    setups = {
        "benchmark": Setup(
            x0_law=Gaussian((0.0, 0.0), independent(0.01, 0.01)),
            duration=1.6,
            dt=0.1,
            noise_std=0.1,
        )
    }

    def f(self, t, x, u):
        return stack(x, 60 * x[..., 0] ** 3 - 0.2 * x[..., 0], -x[..., 1])


def test_draws_from_which_the_plant_leaves_the_finite_numbers_have_no_weight():
    source = EpisodeSource(Escaping)
    law, u = EpisodeLaw.of(source), np.zeros((17, 0))
    x = law.trajectories(law.plants[0], np.array([[0.01, 0.1], [2.0, 0.1], [-0.02, 0.0]]), 16, u)
    assert np.isnan(x[:, 1]).all()
    assert np.isfinite(x[:, ::2]).all()
    density = law.log_likelihood(law.plants[0], x, np.zeros((16, 2)), u)
    assert (density[:, 1] == -np.inf).all()
    assert np.isfinite(density[:, ::2]).all()


@dataclass(frozen=True)
class Silent(Linear):
    """Without an output at some states."""

    def h(self, t, x, u):
        return stack(x, np.where(x[..., 0] > 0, x[..., 0], np.nan), x[..., 1])


def test_a_plant_that_withholds_outputs_by_its_state_is_refused():
    law = EpisodeLaw.of(EpisodeSource(Linear))
    x = np.array([[[0.5, 0.1], [-0.5, 0.1]]])
    with pytest.raises(ValueError, match=r"Silent.h has no output at some states"):
        law.log_likelihood(Silent(), x, np.zeros((1, 2)), np.zeros((1, 0)))


def test_what_estimators_are_told_does_not_matter():
    plain, far = (EpisodeSource(Uncertain, condition=name) for name in ("nominal", "xhat0_far"))
    found = [exact_bayes(EpisodeLaw.of(source), record_of(source, 2)) for source in (plain, far)]
    np.testing.assert_array_equal(found[0].filtered.mean, found[1].filtered.mean)


@dataclass(frozen=True)
class Disturbed(Started):
    """With process noise."""

    setups = {
        "benchmark": Setup(
            x0_law=Gaussian(MEAN, COV),
            duration=1.0,
            dt=0.1,
            noise_std=0.1,
            process_noise=0.3,
        )
    }


def test_the_particle_reference_is_the_kalman_filter_within_its_error():
    source = EpisodeSource(Disturbed)
    record = record_of(source, 2)
    found, error = particle_reference(source, record, particles=4000)
    xhat, P = kalman(record, 0.01 * np.eye(2), process_covariance(0.3))
    off = (found.mean - xhat) / np.sqrt(np.einsum("kii->ki", P))
    assert abs(off).max() < 0.15
    assert 0.2 < np.sqrt(np.mean(off**2)) / np.sqrt(np.mean(error**2)) < 3
    np.testing.assert_allclose(
        np.einsum("bkii->bki", found.cov) / np.einsum("kii->ki", P), 1, atol=0.2
    )


class Quieter(Noise):
    """Correlated output noise whose standard deviation is a fifth from 0.3 s on."""

    def G(self, t):
        return super().G(t) * (0.2 if t > 0.25 else 1.0)


@dataclass(frozen=True)
class Fading(Started):
    """With noise that depends on time."""

    setups = {"benchmark": replace(Started.setups["benchmark"], noise_std=((0.4, 0.0), (0.3, 0.3)))}

    def noise(self, noise_std=None, process_noise=None):
        usual = super().noise(noise_std, process_noise)
        return Quieter(usual.process, usual.output, usual.samples)


def test_delayed_outputs_have_the_noise_of_when_they_were_measured():
    """Against least squares of the outputs measured three samples earlier, each weighted by the
    noise of its time, on the exact solution exp(At)x₀."""
    source = EpisodeSource(Fading, condition="delay3")
    record = record_of(source, 2)
    found = exact_bayes(EpisodeLaw.of(source), record).filtered
    for row in range(2):
        information, weighted = np.linalg.inv(COV), np.linalg.solve(COV, MEAN)
        for k in range(record.num_samples):
            if k >= 3:
                C = H @ expm(A * source.times[k - 3])
                R = source.noise.R(float(source.times[k - 3]))[..., 0]
                information = information + C.T @ np.linalg.solve(R, C)
                weighted = weighted + C.T @ np.linalg.solve(R, record.y[row, k])
            moved = expm(A * source.times[k])
            xhat = moved @ np.linalg.solve(information, weighted)
            std = np.sqrt(np.diag(moved @ np.linalg.solve(information, moved.T)))
            # Five standard errors of as many independent draws.
            error = 5 / np.sqrt(found.ess[row, k])
            assert (abs(found.mean[row, k] - xhat) < error * std).all()
            np.testing.assert_allclose(np.diag(found.cov[row, k]), std**2, rtol=1.5 * error)


@dataclass(frozen=True)
class PartlyKnown(Linear):
    """The linear plant, whose first state begins at 0.5."""

    setups = {"benchmark": replace(Linear.setups["benchmark"], x0_low=(0.5, -1), x0_high=(0.5, 1))}


def test_a_known_component_is_that_of_the_condition():
    """Outside the set it is 1.5 times as large."""
    source = EpisodeSource(PartlyKnown, condition="x0_outside")
    found = exact_bayes(EpisodeLaw.of(source), record_of(source, 1))
    assert found.smoothed.mean[0, 0, 0] == pytest.approx(0.75, abs=1e-12)
    assert found.filtered.ess.min() >= LEAST_ESS


@pytest.mark.parametrize(
    ("source", "told"),
    [
        (
            lambda: EpisodeSource(Linear, noise_std=((0.1, 0.0), (0.3, 0.0))),
            "Linear has a combination of outputs without noise",
        ),
        (lambda: EpisodeSource(Linear, noise_std=0.0), "without noise"),
        (lambda: EpisodeSource(Disturbed), "has process noise"),
        (lambda: EpisodeSource("ReverseDuffing", "paper"), "a known state"),
        (lambda: EpisodeSource("InductionMotor", condition="load_step"), "no list"),
    ],
)
def test_a_law_without_a_likelihood_is_refused(source, told):
    with pytest.raises(ValueError, match=told):
        EpisodeLaw.of(source())


def test_what_is_too_large_or_of_another_record_is_refused():
    with pytest.raises(ValueError, match=r"InductionMotor has 5 states; .* at most 3"):
        floors_of(Game.of("InductionMotor"))
    source = EpisodeSource(Started)
    record = record_of(EpisodeSource(Started, dt=0.05), 1)
    with pytest.raises(ValueError, match="other sample times"):
        exact_bayes(EpisodeLaw.of(source), record)


def test_the_density_of_a_mixture_is_that_of_its_draws():
    """The mean of q/p over draws of p is the integral of q, up to the constant that both have."""
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.normal(0, 1, (500, 2)), rng.normal((4, -3), (0.2, 0.5), (500, 2))])
    narrow = Mixture.fitted(x, np.full(1000, 1e-3), rng)
    wide = Mixture(np.ones(1), np.array([[2.0, -1.0]]), 4 * np.eye(2)[None])
    drawn = wide.draw(40_000, rng)
    ratio = np.exp(narrow.log_density(drawn) - wide.log_density(drawn))
    assert ratio.mean() == pytest.approx(1, abs=4 * ratio.std() / 200)
    assert len(narrow.probabilities) > 2
    own = narrow.draw(40_000, rng)
    assert abs(own.mean(axis=0) - x.mean(axis=0)).max() < 0.1


def test_rows_of_the_floor_are_stored_once(tmp_path):
    game = Game.of(Uncertain, duration=0.5)
    path = tmp_path / "rows.jsonl"
    found = run_floor(game, range(3), path)
    assert [(row["estimator"], row["track"]) for row in found] == [
        *[("exact_bayes", "floor")] * 3,
        *[("exact_bayes_smoother", "floor, whole")] * 3,
    ]
    assert all(row["effective_sample_size"] >= LEAST_ESS for row in found)
    assert not too_few(found)
    assert too_few([{**found[0], "effective_sample_size": 12.0}])
    before = path.read_bytes()
    run_floor(game, range(3), path)
    again = rows_module.read(path)
    assert path.read_bytes().startswith(before)
    assert len(again) == 6
