"""Ensembles that localise covariances, and particles from a wide prior, against written-out
filters."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from linear import H, Linear, runge_kutta_matrix

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.localisation import gaspari_cohn
from pinnobs_gym.estimators.enkf import EnKF
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.simulation.augmented import Unknown, augmented
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.start_law import Gaussian
from pinnobs_gym.simulation.system import Setup, System, independent

SIZE = 24


@dataclass(frozen=True)
class Ring(System):
    """The model of Lorenz (1996) on a ring; every second state is measured."""

    state_names = tuple(f"x{i}" for i in range(SIZE))
    output_names = tuple(f"y{i}" for i in range(0, SIZE, 2))
    scale = (4.0,) * SIZE
    model_step = 0.05
    setups = {
        "benchmark": Setup(
            x0_law=Gaussian((8.0,) * SIZE, independent(*[1.0] * SIZE)),
            duration=6.0,
            dt=0.05,
            noise_std=1.0,
            truth_step=0.02,
        )
    }

    def f(self, t, x, u):
        ahead, before = np.roll(x, -1, axis=-1), np.roll(x, 1, axis=-1)
        return (ahead - np.roll(x, 2, axis=-1)) * before - x + 8

    def h(self, t, x, u):
        return x[..., ::2]

    def distances(self):
        apart = abs(np.subtract.outer(np.arange(SIZE), np.arange(0, SIZE, 2)))
        ring = np.minimum(apart, SIZE - apart)
        return ring, ring[::2]


def ring_record(samples, batch=1):
    """Outputs of states near the rest point 8 that do not move, which is enough for formulas."""
    rng, t = np.random.default_rng(0), np.arange(samples) * 0.05
    x = 8 + rng.standard_normal((batch, 1, SIZE)) + np.zeros((1, samples, 1))
    y = x[..., ::2] + rng.standard_normal((batch, samples, SIZE // 2))
    prior = Prior.of(*Ring.configured(), batch)
    return Record(t, y, np.zeros((batch, samples, 0)), prior)


def test_the_taper_is_that_of_gaspari_and_cohn():
    """Equation 4.10 with c = 1, and its value 5/24 at c."""
    z = np.linspace(0, 3, 301)
    expected = np.zeros(301)
    a, b = z[z <= 1], z[(z > 1) & (z <= 2)]
    expected[z <= 1] = -(a**5) / 4 + a**4 / 2 + 5 * a**3 / 8 - 5 * a**2 / 3 + 1
    expected[(z > 1) & (z <= 2)] = (
        b**5 / 12 - b**4 / 2 + 5 * b**3 / 8 + 5 * b**2 / 3 - 5 * b + 4 - 2 / (3 * b)
    )
    np.testing.assert_allclose(gaspari_cohn(z, 2.0), expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(gaspari_cohn(np.array([5.0, 10.0, 10.1]), 10.0), [5 / 24, 0, 0])
    assert gaspari_cohn(np.array([0]), 3.0) == 1
    points = np.random.default_rng(0).uniform(0, 5, (40, 2))
    apart = np.linalg.norm(points[:, None] - points, axis=-1)
    assert np.linalg.eigvalsh(gaspari_cohn(apart, 2.5)).min() > -1e-12


def test_an_analysis_uses_tapered_covariances():
    """The mean moves by K(y − ȳ), as the perturbations have mean zero over the ensemble."""
    record, own = ring_record(1), EnKF(Ring(), members=10, localisation=6.0)
    members = own.reset(record.prior).memory.members[:, 0]
    X = (members - members.mean(axis=0)).T
    P = X @ X.T / 9
    states, outputs = (gaspari_cohn(distance, 6.0) for distance in Ring().distances())
    K = (states * P[:, ::2]) @ np.linalg.inv(outputs * P[::2, ::2] + np.eye(SIZE // 2))
    expected = members.mean(axis=0) + K @ (record.y[0, 0] - members.mean(axis=0)[::2])
    np.testing.assert_allclose(own.run(record).xhat[0, 0], expected, rtol=0, atol=1e-10)


def test_an_output_changes_no_state_beyond_the_radius():
    record, own = ring_record(1), EnKF(Ring(), members=10, localisation=4.0)
    y = np.full_like(record.y, np.nan)
    y[..., 0] = 12.0
    before = own.reset(record.prior).memory.members[:, 0].mean(axis=0)
    moved = own.run(replace(record, y=y)).xhat[0, 0] - before
    near = Ring().distances()[0][:, 0] < 4
    assert (abs(moved[near]) > 1e-6).all()
    assert (abs(moved[~near]) < 1e-12).all()


def test_without_distance_nothing_is_tapered():
    class Point(Ring):
        def distances(self):
            return np.zeros((SIZE, SIZE // 2)), np.zeros((SIZE // 2, SIZE // 2))

    record = ring_record(10)
    plain = EnKF(Point(), members=60).run(record)
    local = EnKF(Point(), members=60, localisation=1.0).run(record)
    np.testing.assert_allclose(local.xhat, plain.xhat, rtol=0, atol=1e-8)
    np.testing.assert_allclose(local.P, plain.P, rtol=0, atol=1e-8)


def test_few_members_track_chaos_with_localisation_and_not_without():
    """Errors after 60 cycles, of outputs with noise 1; those of a free run are about 4."""
    source = EpisodeSource(Ring)
    episodes = source.play(source.draw(source.streams([0])))
    record, error = source.record(episodes), {}
    for radius in (8.0, None):
        own = EnKF(Ring(), members=12, localisation=radius, inflation=1.05)
        errors = own.run(record).xhat[0] - episodes.x[:-1, 0]
        error[radius] = np.sqrt((errors[60:] ** 2).mean())
    assert error[8.0] < 0.7
    assert error[None] > 2.0


def test_a_row_alone_and_in_a_batch():
    record, own = ring_record(20, batch=3), EnKF(Ring(), members=8, localisation=5.0)
    whole = own.run(record)
    for row in range(3):
        alone = own.run(record.rows(slice(row, row + 1)))
        np.testing.assert_array_equal(alone.xhat[0], whole.xhat[row])
        np.testing.assert_array_equal(alone.P[0], whole.P[row])


def test_constants_of_an_augmented_plant_are_near_every_output():
    system = augmented(Ring(), output_bias={"y0": Unknown(0.0, 1.0)})
    distances = system.distances()
    assert distances is not None
    np.testing.assert_array_equal(distances[0][:SIZE], Ring().distances()[0])
    np.testing.assert_array_equal(distances[0][SIZE:], np.zeros((1, SIZE // 2)))
    assert augmented(Linear(), output_bias={"y1": Unknown(0.0, 1.0)}).distances() is None


class Misfit(Ring):
    def distances(self):
        return np.zeros((SIZE, 2)), np.zeros((SIZE // 2, SIZE // 2))


@pytest.mark.parametrize(
    ("cls", "radius", "message"),
    [
        (Linear, 1.0, r"^localisation=1, but Linear declares no distances\(\)$"),
        (Misfit, 1.0, r"Misfit.distances\(\) returns an array of shape \(24, 2\); expected"),
        (Ring, 0.0, r"^localisation=0.0; expected a number above 0$"),
    ],
)
def test_a_radius_that_cannot_be_used_is_refused(cls, radius, message):
    with pytest.raises(ValueError, match=message):
        EnKF(cls(), localisation=radius)


@pytest.mark.parametrize("ratio", [1e5, 1e8, 1e12])
def test_particles_from_a_wide_prior_end_at_the_kalman_filters(ratio):
    """Within three of their standard deviations at each sample, from 2 and from 3.5 standard
    deviations of the prior in eight directions; P₀ is this ratio times R."""
    R, F, count = np.diag([0.01, 0.01]), runge_kutta_matrix(0.1), 5
    angles = np.arange(8) * np.pi / 4
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    x0 = np.sqrt(ratio) * 0.1 * np.concatenate([2 * ring, 3.5 * ring])
    x = np.stack([x0 @ np.linalg.matrix_power(F, k).T for k in range(count)], axis=1)
    noise = 0.1 * np.random.default_rng(2).standard_normal((16, count, 2))
    prior = Prior(np.zeros((16, 2)), np.tile(ratio * R, (16, 1, 1)))
    y, u = x @ H.T + noise, np.zeros((16, count, 0))
    found = ParticleFilter(Linear(), 0.1).run(Record(0.1 * np.arange(count), y, u, prior))
    xhat, P = prior.mean, prior.cov[0]
    for k in range(count):
        if k:
            xhat, P = xhat @ F.T, F @ P @ F.T
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        xhat, P = xhat + (y[:, k] - xhat @ H.T) @ K.T, P - K @ H @ P
        own = np.sqrt(np.einsum("bii->bi", found.P[:, k]))
        assert (abs(found.xhat[:, k] - xhat) < 3 * own).all()
        assert (own > 0.5 * np.sqrt(np.diag(P))).all()
