"""Laws of initial states, against their moments, and against what estimators make of them."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from linear import Linear

from pinnobs_gym.cli.system_page import page
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.scoring.episode_law import EpisodeLaw
from pinnobs_gym.simulation.augmented import Unknown, augmented
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.start_law import Box, Gaussian, Joint, Points
from pinnobs_gym.simulation.system import Setup, independent, initial_states
from trainers.kkl.labels import initial_states as training_states

MEAN, COV = (1.0, -2.0), ((0.5, -0.3), (-0.3, 0.4))
STATES = ((0.0, 1.0), (2.0, 1.0), (4.0, -2.0), (-1.0, 0.5))


def setup_with(law, **prior):
    """The linear plant's setup with another law of initial states."""
    return Setup(x0_law=law, duration=2.0, dt=0.1, noise_std=0.1, **prior)


def system_with(law, name="Started"):
    """A class of the linear plant whose initial states follow a law."""
    return type(name, (Linear,), {"setups": {"benchmark": setup_with(law)}})


class Upper(Linear):
    """The linear plant of which only states with a second component above −2 may be initial."""

    def admissible(self, x0):
        return x0[..., 1] > -2


def restricted(law):
    return type("Restricted", (Upper,), {"setups": {"benchmark": setup_with(law)}})


def starts(cls, count, condition="nominal"):
    source = EpisodeSource(cls, condition=condition)
    return source, source.draw(source.streams(range(count))).x0


def test_the_prior_of_a_gaussian_law_is_exactly_it():
    mean, cov = prior_moments(*system_with(Gaussian(MEAN, COV)).configured())
    np.testing.assert_array_equal(mean, MEAN)
    np.testing.assert_array_equal(cov, COV)


def test_the_prior_of_a_list_is_its_mean_and_covariance():
    mean, cov = prior_moments(*system_with(Points(STATES)).configured())
    np.testing.assert_allclose(mean, [1.25, 0.125])
    np.testing.assert_allclose(cov, np.cov(np.transpose(STATES), bias=True), atol=1e-15)
    kept = np.array([state for state in STATES if state[1] > -2])
    mean, cov = prior_moments(*restricted(Points(STATES)).configured())
    np.testing.assert_allclose(mean, kept.mean(axis=0))
    np.testing.assert_allclose(cov, np.cov(kept.T, bias=True), atol=1e-15)


@pytest.mark.parametrize("law", [Gaussian(MEAN, COV), Points(STATES), Box((-1, 0), (3, 0.5))])
def test_initial_states_have_the_moments_of_their_law(law):
    """Within four standard errors, of episodes and of states that are the same at every call."""
    count, cls = 2000, system_with(law)
    for x0 in (starts(cls, count)[1], initial_states(cls(), cls.setups["benchmark"], count)):
        std = np.sqrt(np.diag(law.cov))
        assert (abs(x0.mean(axis=0) - law.mean) < 4 * std / np.sqrt(count)).all()
        close = 4 * np.sqrt(2) * np.outer(std, std) / np.sqrt(count)
        assert (abs(np.cov(x0.T) - law.cov) < close).all()


def test_a_list_is_drawn_with_equal_chance():
    _, x0 = starts(system_with(Points(STATES)), 2000)
    counts = (x0[:, None] == np.array(STATES)).all(axis=-1).sum(axis=0)
    assert counts.sum() == 2000
    assert (abs(counts - 500) < 4 * np.sqrt(2000 / 4 * 3 / 4)).all()


def test_a_seed_has_its_initial_state_in_any_batch():
    for law in (Gaussian(MEAN, COV), Points(STATES)):
        source, x0 = starts(system_with(law), 20)
        alone = [source.draw(source.streams([seed])).x0[0] for seed in range(20)]
        np.testing.assert_array_equal(alone, x0)


def test_what_is_admissible_restricts_each_law():
    for law in (Gaussian(MEAN, COV), Points(STATES), Box((-1, -3), (3, 0.5))):
        _, x0 = starts(restricted(law), 500)
        assert (x0[:, 1] > -2).all()
        assert (training_states(restricted(law)(), None, None, 50, seed=0)[:, 1] > -2).all()
    with pytest.raises(ValueError, match=r"no state of .* is admissible"):
        prior_moments(*restricted(Points(((0, -3), (1, -4)))).configured())


def test_the_set_of_a_gaussian_is_the_ellipsoid_of_95_percent():
    law, rng = Gaussian(MEAN, COV), np.random.default_rng(0)
    draws = rng.multivariate_normal(MEAN, COV, 20_000)
    inside = law.contains(draws)
    assert abs(inside.mean() - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 20_000)
    squares = np.einsum("ni,ij,nj->n", draws - MEAN, np.linalg.inv(COV), draws - MEAN)
    np.testing.assert_array_equal(inside, squares <= 5.991464547107979)
    np.testing.assert_allclose(law.log_density(draws), -squares / 2, rtol=1e-9)


def test_a_known_component_stays_as_it_is():
    law = Gaussian((1.0, 5.0), ((2.0, 0.0), (0.0, 0.0)))
    _, x0 = starts(system_with(law), 100)
    assert (x0[:, 1] == 5).all()
    assert law.contains(np.array([[1.0, 5.0], [1.0, 5.1], [9.0, 5.0]])).tolist() == [
        True,
        False,
        False,
    ]


@pytest.mark.parametrize("law", [Gaussian(MEAN, COV), Points(STATES)])
def test_conditions_of_the_start_follow_the_law(law):
    cls = system_with(law)
    source, x0 = starts(cls, 200, "x0_outside")
    assert not law.contains(x0).any()
    near = law.contains(x0 / 1.5)
    assert near.mean() > 0.5  # 1.5 times a state; of a Gaussian, all states and not only its set
    setup = EpisodeSource(cls, condition="xhat0_far").setup
    np.testing.assert_allclose(setup.xhat0, law.mean + 2 * np.sqrt(np.diag(law.cov)))
    assert source.setup.x0_law is law


def test_a_list_has_no_density():
    source = EpisodeSource(system_with(Points(STATES)), duration=0.5)
    with pytest.raises(ValueError, match="a list of 4 states and has no density"):
        EpisodeLaw.of(source)


def test_the_kalman_filter_is_consistent_from_a_gaussian_start():
    """Its squared errors, in its own covariance, have mean 2 over episodes, at any sample."""
    source, count = EpisodeSource(system_with(Gaussian(MEAN, COV)), duration=0.5), 400
    episodes = source.play(source.draw(source.streams(range(count))))
    found = EKF.for_setup(source.system, source.setup, assumed_noise=0.0).run(
        source.record(episodes)
    )
    errors = found.xhat - episodes.x[:-1].swapaxes(0, 1)
    squares = np.einsum("bki,bkij,bkj->bk", errors, np.linalg.inv(found.P), errors)
    assert (abs(squares.mean(axis=0) - 2) < 4 * 2 / np.sqrt(count)).all()


def test_an_augmented_plant_keeps_the_law():
    cls = system_with(Gaussian(MEAN, COV))
    system = augmented(cls(), output_bias={"y1": Unknown(0.5, 0.2)})
    law = system.setups["benchmark"].start(3)
    assert isinstance(law, Joint)
    expected = np.zeros((3, 3))
    expected[:2, :2], expected[2, 2] = COV, 0.04
    np.testing.assert_allclose(law.mean, [*MEAN, 0.5])
    np.testing.assert_allclose(law.cov, expected)
    drawn = law.draw(np.random.default_rng(0), 4000)
    assert (abs(np.cov(drawn.T) - expected) < 0.05).all()
    assert law.contains(np.array([[1.0, -2.0, 0.5], [1.0, -2.0, 5.0]])).tolist() == [True, False]
    for stated, found in zip(
        prior_moments(*type(system).configured()), (law.mean, law.cov), strict=True
    ):
        np.testing.assert_allclose(stated, found)


def test_a_list_of_one_state_is_a_fixed_start():
    with pytest.raises(ValueError, match=r"the initial state is fixed, .* give xhat0$"):
        setup_with(Points(((1.0, 2.0),)))
    setup = setup_with(Points(((1.0, 2.0),)), xhat0=MEAN, P0=COV)
    assert setup.fixed_x0
    _, x0 = starts(type("One", (Linear,), {"setups": {"benchmark": setup}}), 3)
    np.testing.assert_array_equal(x0, [[1.0, 2.0]] * 3)


def test_the_page_of_a_system_says_the_law():
    text = page(system_with(Gaussian(MEAN, COV)), "pinnobs/Started-v0")
    assert "x₀ Gaussian with mean [1.0, -2.0] and covariance [[0.5, -0.3]" in text
    text = page(system_with(Points(STATES)), "pinnobs/Started-v0")
    assert "x₀ drawn with equal chance from [[0.0, 1.0]" in text


@pytest.mark.parametrize("law", [Gaussian(MEAN, COV), Points(STATES), Box((-1, 0), (3, 0.5))])
def test_a_law_can_be_stored(law):
    law.draw(np.random.default_rng(0), 1)
    assert pickle.loads(pickle.dumps(law)) == law


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Setup(duration=1, dt=0.1), "x0_low and x0_high, or x0_law, .* given: neither"),
        (lambda: Setup((0,), duration=1, dt=0.1), "are expected; given: x0_low$"),
        (
            lambda: Setup((0,), (1,), duration=1, dt=0.1, x0_law=Points(((1,), (2,)))),
            "are expected; given: x0_low, x0_high, x0_law$",
        ),
        (lambda: Gaussian((0,), ((1, 0), (0, 1))), r"x0_mean has 1 number\(s\), x0_cov 2 rows"),
        (lambda: Gaussian((0,), ((-1,),)), "expected a covariance, without eigenvalues below 0"),
        (lambda: Gaussian((np.nan,), ((1,),)), "expected one finite number per state"),
        (lambda: Points(()), "expected rows of one finite number per state"),
        (lambda: Points(((1, 2), (1,))), "expected rows of one finite number per state"),
        (lambda: Points((1, 2)), "expected rows of one finite number per state"),
        (lambda: Points(((np.inf,),)), "expected rows of one finite number per state"),
        (lambda: Box((1,), (0,)), r"x0_low=\(1,\) is above x0_high=\(0,\)"),
        (lambda: Box((1,), (2, 3)), r"x0_low has 1 number\(s\), x0_high 2"),
    ],
)
def test_what_is_no_law_is_one_clear_line(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_a_law_of_another_size_is_refused():
    with pytest.raises(TypeError, match=r"x0_law has states of 1 number\(s\); expected 2"):
        system_with(Gaussian((0.0,), ((1.0,),))).validate()


def test_a_setup_for_logs_needs_no_box_and_no_duration():
    """Initial states then follow the prior, in an episode of a hundred steps."""
    setup = Setup(dt=0.1, noise_std=0.2, xhat0=(1.0, -2.0), P0=independent(3.0, 0.5))
    assert (setup.duration, setup.num_steps) == (10.0, 100)
    assert setup.start(2) == Gaussian((1.0, -2.0), independent(3.0, 0.5))
    one = replace(setup, xhat0=(4.0, 4.0))  # another prior, of the same initial states
    assert one.start(2) == setup.start(2)

    source = EpisodeSource(type("Logged", (Linear,), {"setups": {"benchmark": setup}}))
    x0 = source.draw(source.streams(range(2000))).x0
    np.testing.assert_allclose(x0.mean(axis=0), (1, -2), atol=0.25)
    np.testing.assert_allclose(x0.std(axis=0), (3, 0.5), rtol=0.1)
    assert len(source.record(source.play(source.draw(source.streams([0])))).t) == 100


def test_a_gaussian_law_is_restricted_to_the_bounds_of_the_states():
    """To the half of a state that is not negative: the half-normal distribution."""
    setup = Setup(dt=0.1, xhat0=(0.0, -2.0), P0=independent(3.0, 0.5))
    own = {"state_low": (0.0, None), "setups": {"benchmark": setup}}
    source, x0 = starts(type("Positive", (Linear,), own), 2000)
    assert (x0[:, 0] >= 0).all()
    np.testing.assert_allclose(x0.mean(axis=0), (3 * np.sqrt(2 / np.pi), -2), atol=0.2)
    np.testing.assert_allclose(x0.std(axis=0), (3 * np.sqrt(1 - 2 / np.pi), 0.5), rtol=0.1)
    np.testing.assert_array_equal(prior_moments(source.system, source.setup)[0], (0.0, -2.0))

    law = {"benchmark": Setup(dt=0.1, duration=1.0, x0_law=setup.x0_law)}
    mean, cov = prior_moments(*type("Positive", (Linear,), own | {"setups": law}).configured())
    np.testing.assert_allclose(mean, (3 * np.sqrt(2 / np.pi), -2), atol=0.01)
    np.testing.assert_allclose(cov, np.diag([9 * (1 - 2 / np.pi), 0.25]), atol=0.03)


@pytest.mark.parametrize("given", [{}, {"xhat0": (0.0,)}, {"P0": ((1.0,),)}, {"x0_low": (0.0,)}])
def test_a_setup_needs_initial_states_or_a_prior(given):
    with pytest.raises(ValueError, match="x0_low and x0_high, or x0_law, or xhat0 and P0 are exp"):
        Setup(dt=0.1, **given)
