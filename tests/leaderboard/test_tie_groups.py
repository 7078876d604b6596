import numpy as np
import pytest
from scipy.special import stdtrit

from pinnobs_gym.leaderboard.comparison import difference
from pinnobs_gym.leaderboard.influence import Results
from pinnobs_gym.leaderboard.tie_groups import ranks_of, tie_groups

EPISODES = 100
LEVELS = (0.999, 0.2, 1e-4)


def results(log_ratio, diverged=0):
    """Results whose first episodes of each training seed diverge."""
    log_ratio = np.atleast_2d(np.asarray(log_ratio, dtype=float))
    each = np.arange(log_ratio.shape[1]) < diverged
    return Results(log_ratio, np.broadcast_to(each, log_ratio.shape))


def noise(seed, num_seeds=1, spread=0.1):
    return spread * np.random.default_rng(seed).standard_normal((num_seeds, EPISODES))


def equal(rng, size, spread=0.3):
    """Equal estimators: every second one has five training seeds with an effect of their own."""
    field = {str(each): {} for each in range(size)}
    for system in ("A", "B"):
        shared = rng.standard_t(3, 50)
        for each in range(size):
            num_seeds = 5 if each % 2 else 1
            log_ratio = shared + spread * rng.standard_t(3, 50)
            if num_seeds > 1:
                log_ratio = log_ratio + 0.1 * rng.standard_normal((num_seeds, 1))
                log_ratio = log_ratio + 0.1 * rng.standard_normal((num_seeds, 50))
            diverged = rng.random((num_seeds, 50)) < 0.1
            field[str(each)][system] = Results(np.atleast_2d(log_ratio), diverged)
    return field


def test_clusters_far_apart():
    rng = np.random.default_rng(0)
    centres = {"a": 0, "b": 0, "c": 1, "d": 1, "e": 1, "f": 3}
    field = {
        name: {
            system: results(centre + 0.05 * rng.standard_normal((1, EPISODES)))
            for system in ("A", "B")
        }
        for name, centre in centres.items()
    }
    groups = tie_groups(dict(sorted(field.items(), reverse=True)))
    assert [set(group) for group in groups] == [{"a", "b"}, {"c", "d", "e"}, {"f"}]
    assert ranks_of(groups) == {"a": 1, "b": 1, "c": 3, "d": 3, "e": 3, "f": 6}


def test_a_group_is_in_the_order_of_scores():
    shared = noise(0)
    field = {
        name: {"A": results(shared + noise(seed) + mean)}
        for seed, (name, mean) in enumerate({"x": 0.01, "y": 0.0, "z": 0.02}.items(), 1)
    }
    means = {name: np.sort(each["A"].log_ratio[0])[25:75].mean() for name, each in field.items()}
    assert tie_groups(field) == (tuple(sorted(means, key=means.__getitem__)),)


def test_equal_scores_are_in_the_order_of_names_whatever_the_order_of_the_field():
    field = {name: {"A": results(noise(0))} for name in ("c", "a", "b")}
    assert tie_groups(field) == (("a", "b", "c"),)
    assert tie_groups(dict(reversed(field.items()))) == (("a", "b", "c"),)


@pytest.mark.parametrize(("diverged", "first"), [(30, "safe"), (1, "fast")])
def test_divergence_outranks_a_better_nrmse_only_if_it_is_significant(diverged, first):
    field = {
        "fast": {"A": results(noise(0) - 1, diverged)},
        "safe": {"A": results(noise(1))},
    }
    second = {"safe": "fast", "fast": "safe"}[first]
    assert tie_groups(field) == ((first,), (second,))


@pytest.mark.parametrize(("diverged", "first"), [(7, "safe"), (6, "fast")])
def test_divergence_has_half_of_the_level(diverged, first):
    # The exact p-values 2·0.5⁶ = 0.031 and 2·0.5⁷ = 0.016 are on either side of 0.025; those of the
    # t test, 0.014 and 0.008, are smaller.
    field = {
        "fast": {"A": results(noise(0) - 1, diverged)},
        "safe": {"A": results(noise(1))},
    }
    assert tie_groups(field)[0] == (first,)


def test_an_estimator_that_diverges_is_compared_again_in_the_next_group():
    field = {
        "safe": {"A": results(noise(0))},
        "fast": {"A": results(noise(1) - 1, 30)},
        "slow": {"A": results(noise(2) + 1, 30)},
        "like fast": {"A": results(noise(3) - 1, 28)},
    }
    groups = tie_groups(field)
    assert [set(group) for group in groups] == [{"safe"}, {"fast", "like fast"}, {"slow"}]


def test_a_training_seed_more_or_less_does_not_decide_by_itself():
    # The seeds of b are better and worse than a, far more than episodes differ.
    of_seeds = np.array([[-1.5], [0.3], [0.9]])
    field = {
        "a": {"A": results(noise(0))},
        "b": {"A": results(noise(1, 3) + of_seeds)},
    }
    assert len(tie_groups(field)) == 1
    field["b"] = {"A": results(noise(1, 3) + 0.5)}
    assert tie_groups(field) == (("a",), ("b",))


def worse_by(p, best, seed):
    """Results worse than these with this two-sided p-value."""
    drawn = {"A": results(noise(seed))}
    now = difference(drawn, best)
    shift = stdtrit(now.degrees, 1 - p / 2) * now.standard_error - now.value
    return {"A": results(drawn["A"].log_ratio + shift)}


@pytest.mark.parametrize("copies", [1, 2, 3, 6])
def test_the_level_is_divided_by_the_number_of_pairs(copies):
    # The score has half of the level. 1, 2, 3, 6 copies and one other make 1, 3, 6, 21 pairs.
    best = {"A": results(noise(0))}
    pairs = {1: 1, 2: 3, 3: 6, 6: 21}[copies]
    field = {f"a{i}": best for i in range(copies)}
    near, far = (worse_by(factor * 0.025 / pairs, best, 1) for factor in (1.01, 0.99))
    assert len(tie_groups({**field, "b": near})) == 1
    assert tie_groups({**field, "b": far}) == (tuple(field), ("b",))


def test_what_is_left_out_reduces_the_number_of_pairs():
    # Of 5, b is worse (p < 0.025/10); of the 4 left, c is (p < 0.025/6), though not of 5.
    best = {"A": results(noise(0))}
    field = {f"a{i}": best for i in range(3)} | {"c": worse_by(0.025 / 8, best, 2)}
    assert tie_groups({**field, "b": worse_by(1e-12, best, 1)})[0] == ("a0", "a1", "a2")
    assert tie_groups({**field, "b": worse_by(0.2, best, 1)})[0] != ("a0", "a1", "a2")


def test_equal_estimators_tie_at_the_level():
    rng = np.random.default_rng(0)
    tied = [len(tie_groups(equal(rng, 5))) == 1 for _ in range(200)]
    assert np.mean(tied) >= 0.90


def test_a_lower_level_ties_more():
    rng = np.random.default_rng(1)
    fields = [equal(rng, 4) for _ in range(60)]
    tied = [np.mean([len(tie_groups(field, level)) == 1 for field in fields]) for level in LEVELS]
    assert tied == sorted(tied)
    assert tied[0] < 0.7 < 0.95 < tied[-1]


def test_ten_percent_over_six_systems_are_told_apart():
    # Log ratios scatter by 0.2 from episode to episode.
    worse = {str(each): np.log(1.1) for each in range(11)}
    field = {
        name: {str(i): results(noise([i, seed], 1, 0.2) + mean) for i in range(6)}
        for seed, (name, mean) in enumerate({"best": 0.0, **worse}.items())
    }
    groups = tie_groups(field)
    assert groups[0] == ("best",)
    assert set(groups[1]) == set(worse)


def test_one_episode_ties_all():
    field = {
        name: {"A": results([[mean]], diverged)}
        for name, mean, diverged in (("a", 5, 0), ("b", 0, 1), ("c", 2, 0))
    }
    assert tie_groups(field) == (("b", "c", "a"),)


def test_no_estimator_and_one():
    assert tie_groups({}) == ()
    assert ranks_of(()) == {}
    assert tie_groups({"a": {"A": results(noise(0))}}) == (("a",),)


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="level=1; expected a number between 0 and 1"):
        tie_groups({}, level=1)
    field = {"a": {"A": results(noise(0))}, "b": {"B": results(noise(0))}}
    with pytest.raises(ValueError, match="expected the same"):
        tie_groups(field)
