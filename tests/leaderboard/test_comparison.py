import numpy as np
import pytest
from scipy.stats import binomtest, trim_mean, ttest_ind, ttest_rel

from pinnobs_gym.leaderboard.comparison import (
    Estimate,
    difference,
    divergence_difference,
    p_value,
    score,
)
from pinnobs_gym.leaderboard.influence import Results


def results(log_ratio, diverged=None):
    log_ratio = np.atleast_2d(np.asarray(log_ratio, dtype=float))
    none = np.zeros(log_ratio.shape, dtype=bool)
    return Results(log_ratio, none if diverged is None else np.atleast_2d(diverged))


def drawn(seed, num_seeds=1, episodes=40, systems=("A", "B")):
    """Independent normal log ratios, in a quarter of which the episode diverges."""
    rng = np.random.default_rng(seed)
    shape = num_seeds, episodes
    return {each: results(rng.standard_normal(shape), rng.random(shape) < 0.25) for each in systems}


def of_rates(*counts, episodes=100):
    """One system per count, in which the first episodes diverge."""
    zeros = np.zeros(episodes)
    return {str(i): results(zeros, np.arange(episodes) < n) for i, n in enumerate(counts)}


def never(episodes):
    """One system without divergence."""
    return {"A": results(np.zeros(episodes))}


# --- The value.


def test_the_score_is_the_mean_over_systems_of_scipys_trimmed_means():
    for num_seeds, episodes in ((1, 40), (3, 41), (5, 2), (2, 1)):
        made = drawn(num_seeds, num_seeds, episodes)
        trimmed = [trim_mean(each.log_ratio, 0.25, axis=None) for each in made.values()]
        assert score(made).value == pytest.approx(np.mean(trimmed), abs=1e-14)


def test_a_difference_is_that_of_the_scores_and_changes_its_sign_with_the_order():
    a, b = drawn(0, num_seeds=3), drawn(1)
    for compared in (difference, divergence_difference):
        forward, backward = compared(a, b), compared(b, a)
        assert forward.value == -backward.value
        assert forward.standard_error == pytest.approx(backward.standard_error, rel=1e-12)
        assert forward.degrees == pytest.approx(backward.degrees, rel=1e-12)
        assert p_value(forward) == pytest.approx(p_value(backward), rel=1e-12)
    assert difference(a, b).value == pytest.approx(score(a).value - score(b).value, abs=1e-14)


def test_the_difference_of_divergence_is_the_mean_over_systems_of_the_rates():
    assert divergence_difference(of_rates(30, 10), of_rates(10, 0)).value == pytest.approx(0.15)


def test_the_order_of_systems_does_not_matter():
    a, b = drawn(0), drawn(1)
    swapped = difference(a, dict(reversed(b.items())))
    assert swapped == difference(a, b)


# --- The standard error.


def test_one_seed_and_one_system_give_yuens_test():
    # Yuen's trimmed t test against a sample without variance, with the standard error of Tukey &
    # McLaughlin (1963), as SciPy computes it.
    for episodes in (6, 21, 100):
        made = drawn(episodes, episodes=episodes, systems=("A",))
        values = made["A"].log_ratio[0]
        peer = ttest_ind(values, np.zeros(50), trim=0.25, equal_var=False)
        own = score(made)
        assert own.value / own.standard_error == pytest.approx(peer.statistic, rel=1e-12)
        assert own.degrees == pytest.approx(peer.df, rel=1e-12)
        assert p_value(own) == pytest.approx(max(peer.pvalue, 2 * 0.5**episodes), rel=1e-9)


def test_the_difference_of_divergence_with_one_seed_is_the_paired_t_test():
    a, b = (drawn(seed, episodes=60, systems=("A",)) for seed in (0, 1))
    peer = ttest_rel(*(each["A"].diverged[0].astype(float) for each in (a, b)))
    own = divergence_difference(a, b)
    assert own.value / own.standard_error == pytest.approx(peer.statistic, rel=1e-12)
    assert own.degrees == peer.df
    assert p_value(own) == pytest.approx(peer.pvalue, rel=1e-9)


def test_the_variance_over_seeds_and_episodes_by_hand():
    # Three training seeds: never, never and always diverged, in two episodes. The seeds' means are
    # 0, 0 and 1 with variance 1/3 over 3 seeds; nothing depends on the episode.
    by_seed = np.repeat([[False], [False], [True]], 2, axis=1)
    own = divergence_difference({"A": results(np.zeros((3, 2)), by_seed)}, never(2))
    assert own.standard_error == pytest.approx(np.sqrt(1 / 9))
    assert own.degrees == pytest.approx(2)
    # Two seeds, four episodes. Means of seeds .75 and .25 (variance 1/8), of episodes 1, .5, .5, 0
    # (variance 1/6). The rest is ±.25 in the second episode and ∓.25 elsewhere:
    # x - seed - episode + mean = [[-.25, .25, .25, -.25], [.25, -.25, -.25, .25]], whose sum of
    # squares .5 over 3 degrees is 1/6. Variance (1/8)/2 + (1/6)/4 - (1/6)/8 = 1/12. Degrees with
    # the seeds' 1/16 counted twice: (1/12 + 1/16)²/((2/16)²/1 + (1/24)²/3 + (1/48)²/3).
    crossed = np.array([[True, True, True, False], [True, False, False, False]])
    own = divergence_difference({"A": results(np.zeros((2, 4)), crossed)}, never(4))
    assert own.value == 0.5
    assert own.standard_error == pytest.approx(np.sqrt(1 / 12))
    assert own.degrees == pytest.approx(7**2 / (6**2 + 2**2 / 3 + 1 / 3))


def test_seeds_that_agree_give_the_result_of_one_and_others_a_larger_error():
    one = drawn(0, episodes=40)
    same = {name: results(np.repeat(each.log_ratio, 4, axis=0)) for name, each in one.items()}
    assert score(same).value == pytest.approx(score(one).value, abs=1e-14)
    assert score(same).standard_error == pytest.approx(score(one).standard_error, rel=1e-12)
    shifted = {
        name: results(each.log_ratio + np.array([[-0.5], [0], [0], [0.5]]))
        for name, each in same.items()
    }
    assert score(shifted).standard_error > 1.2 * score(one).standard_error
    assert score(shifted).degrees < score(one).degrees


def test_the_variance_is_at_least_that_of_seeds_and_that_of_episodes():
    # Two rows of opposite effects of the episode: the means of episodes are equal, and the rest
    # exceeds the sum of both terms.
    rest = np.array([[1, -1, 1, -1], [-1, 1, -1, 1]]) > 0
    own = divergence_difference({"A": results(np.zeros((2, 4)), rest)}, never(4))
    assert own.standard_error == 0
    tilted = rest.copy()
    tilted[0, 1] = True
    own = divergence_difference({"A": results(np.zeros((2, 4)), tilted)}, never(4))
    of_seeds, of_episodes = np.var([0.75, 0.5], ddof=1) / 2, np.var([0.5, 1, 0.5, 0.5], ddof=1) / 4
    assert own.standard_error == pytest.approx(np.sqrt(max(of_seeds, of_episodes)))


def test_a_constant_shifts_the_value_alone():
    a, b = drawn(0, num_seeds=3), drawn(1, num_seeds=5)
    shifted = {name: results(each.log_ratio + 0.25) for name, each in a.items()}
    assert difference(shifted, b).value == pytest.approx(difference(a, b).value + 0.25, abs=1e-14)
    for field in ("standard_error", "degrees"):
        assert getattr(difference(shifted, b), field) == pytest.approx(
            getattr(difference(a, b), field), rel=1e-12
        )


def test_episodes_are_paired():
    # What both have in common on an episode does not count.
    a, b = drawn(0, episodes=400), drawn(1, episodes=400)
    hard = 3 * np.random.default_rng(2).standard_normal(400)
    near_a, near_b = (
        {name: results(hard + 0.1 * each.log_ratio) for name, each in one.items()} for one in (a, b)
    )
    paired = difference(near_a, near_b).standard_error
    alone = np.hypot(score(near_a).standard_error, score(near_b).standard_error)
    assert paired < 0.1 * alone


@pytest.mark.parametrize(("num_seeds", "systems"), [(1, 1), (3, 1), (3, 3), (5, 2)])
def test_the_interval_covers_the_truth(num_seeds, systems):
    # Seeds, episodes and the rest with deviations .2, .3 and .2; the true score is 0.
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(400):
        made = {}
        for system in range(systems):
            of_seed, of_episode = rng.standard_normal((num_seeds, 1)), rng.standard_normal(30)
            rest = rng.standard_normal((num_seeds, 30))
            made[str(system)] = results(0.2 * of_seed + 0.3 * of_episode + 0.2 * rest)
        if num_seeds == 1:  # a single seed's effect cannot be known
            made = {name: results(each.log_ratio - 0.2 * of_seed) for name, each in made.items()}
        inside.append(p_value(score(made)) >= 0.05)
    assert np.mean(inside) >= 0.92


# --- p-values.


def test_copies_tie():
    a = drawn(0, num_seeds=3)
    copy = {name: results(each.log_ratio.copy(), each.diverged) for name, each in a.items()}
    assert p_value(difference(a, copy)) == 1
    assert p_value(divergence_difference(a, copy)) == 1


def test_estimators_that_are_equal_but_for_rounding_tie():
    a = drawn(0)
    rounded = {name: results(each.log_ratio + 1e-12) for name, each in a.items()}
    assert p_value(difference(rounded, a)) == 1
    apart = {name: results(each.log_ratio + 1e-6) for name, each in a.items()}
    assert p_value(difference(apart, a)) < 1e-9


def test_students_p_value():
    # The 97.5 % quantile of Student's t with 10 degrees of freedom is 2.2281.
    assert p_value(Estimate(-2.2281, 1.0, 10.0)) == pytest.approx(0.05, abs=1e-5)
    assert p_value(Estimate(0.0, 1.0, 10.0)) == 1
    assert p_value(Estimate(1.0, 0.0, np.inf)) == 0


@pytest.mark.parametrize("discordant", [1, 3, 5, 6, 30])
def test_divergence_is_no_more_significant_than_the_exact_test_allows(discordant):
    # McNemar's exact test is the binomial test of the discordant pairs.
    exact = binomtest(discordant, discordant).pvalue
    some = divergence_difference(of_rates(discordant), of_rates(0))
    assert p_value(some) >= exact
    all_of_them = divergence_difference(
        of_rates(discordant, episodes=discordant), of_rates(0, episodes=discordant)
    )
    if discordant > 1:
        assert all_of_them.standard_error == 0
        assert p_value(all_of_them) == pytest.approx(exact)


def test_few_episodes_are_not_significant_however_large_the_difference():
    a, b = drawn(0, episodes=2), drawn(1, episodes=2)
    far = {name: results(each.log_ratio + 1e6) for name, each in a.items()}
    assert p_value(difference(far, b)) >= 2 * 0.5**4


def test_one_episode_tells_nothing():
    a = drawn(0, num_seeds=3, episodes=1)
    b = drawn(1, num_seeds=1, episodes=1)
    for own in (score(a), score(b), difference(a, b), divergence_difference(a, b)):
        assert np.isinf(own.standard_error)
        assert own.degrees == 0
        assert p_value(own) == 1
    assert np.isfinite(difference(a, b).value)


# --- Bad input.


@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan])
def test_what_is_not_finite_is_refused(bad):
    message = rf"^log_ratio contains {bad}; expected finite values$"
    with pytest.raises(ValueError, match=message):
        results([0.0, bad])


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match=r"log_ratio has shape \(3,\); expected \(training seeds"):
        Results(np.zeros(3), np.zeros(3, dtype=bool))
    with pytest.raises(ValueError, match=r"log_ratio has shape \(0, 3\)"):
        Results(np.zeros((0, 3)), np.zeros((0, 3), dtype=bool))
    with pytest.raises(ValueError, match=r"diverged has shape \(1, 2\); expected \(1, 3\)"):
        Results(np.zeros((1, 3)), np.zeros((1, 2), dtype=bool))


def test_estimators_that_cannot_be_compared_are_refused():
    with pytest.raises(ValueError, match=r"systems are \['A'\] and \['B'\]; expected the same"):
        difference(drawn(0, systems=("A",)), drawn(0, systems=("B",)))
    with pytest.raises(ValueError, match="numbers of episodes of A are 4 and 5; expected the same"):
        divergence_difference(drawn(0, episodes=4), drawn(0, episodes=5))
    with pytest.raises(ValueError, match="no systems are given; expected at least one"):
        score({})
