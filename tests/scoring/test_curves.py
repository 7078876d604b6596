import re

import numpy as np
import pytest
from damage import damaged, is_one_line_about

from pinnobs_gym import evaluate
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.envs.game import GameName
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.scoring import curves, rows, thinning
from pinnobs_gym.scoring.cramer_rao import cramer_rao
from pinnobs_gym.scoring.curves import Curves, Example

ENV = "pinnobs/ReverseDuffing-v0"
NOMINAL = GameName(ENV, "benchmark", "nominal")
NOISY = NOMINAL._replace(condition="noise5+dropout10")


@pytest.mark.parametrize("num_samples", [1, 7, 200, 201, 1000, 100_000])
def test_kept_samples_resolve_the_transient_and_reach_the_end(num_samples):
    k = thinning.kept(num_samples)
    assert len(k) <= thinning.POINTS
    assert k[0] == 0
    assert k[-1] == num_samples - 1
    assert (np.diff(k) > 0).all()
    if num_samples <= thinning.POINTS:
        assert len(k) == num_samples
    else:
        assert (np.diff(k[:8]) == 1).all()
        assert np.diff(k).max() <= num_samples / 99 + 1


def one(**changes):
    rng = np.random.default_rng(0)
    t, x = np.arange(4.0), rng.normal(size=(4, 2))
    example = Example(3, t, x, x, x[:, :1], None)
    error = np.array([[0.1, 0.2, np.inf, np.nan], [0.1, 0.3, 0.5, 0.7]])
    parts = {"seeds": np.array([3, 4]), "error": error, "reference": None, "example": example}
    return Curves(t=t, states=("a (m)", "b"), measured={0: 0}, **{**parts, **changes})


HASHES = {"game_hash": "4567", "estimator_hash": "0123"}


def row(seed=3):
    return {**NOISY._asdict(), "estimator": "a b/c", **HASHES, "episode": f"seed:{seed}"}


def test_what_is_written_is_read_back(tmp_path):
    curves.save(tmp_path, row(), one(state_period=(6.5, None)))
    found = curves.read(tmp_path, NOISY)
    (back,) = found["4567", "0123"]
    np.testing.assert_array_equal(back.error, one().error)
    np.testing.assert_array_equal(back.example.x, one().example.x)
    assert (back.states, back.measured, back.example.seed) == (("a (m)", "b"), {0: 0}, 3)
    assert back.reference is None
    assert back.state_period == [6.5, None]
    assert back.example.std is None
    assert curves.read(tmp_path, NOMINAL) == {}


def test_files_of_one_estimator_merge_by_episode():
    later = one(seeds=np.array([4, 5]), error=np.full((2, 4), 9.0))
    both = curves.merged([one(), later], [3, 4, 5, 6])
    assert both is not None
    assert both.seeds.tolist() == [3, 4, 5]
    assert both.error[:, 1].tolist() == [0.2, 0.3, 9.0]
    some = curves.merged([one(), later], [5])
    assert some is not None
    assert some.seeds.tolist() == [5]
    assert curves.merged([one()], [8]) is None


def test_a_damaged_file_is_named(tmp_path):
    curves.save(tmp_path, row(), one())
    (path,) = tmp_path.rglob("*.npz")
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(ValueError, match=re.escape(f"cannot read curves from {path}")) as caught:
        curves.read(tmp_path, NOISY)
    assert "\n" not in str(caught.value)


def test_scored_episodes_leave_their_errors_and_the_reference(tmp_path):
    """Against the errors of the EKF on episodes that are played here, state by state."""
    path = tmp_path / "rows.jsonl"
    evaluate("ekf", ENV, episodes=3, results=path)
    ((parts,),) = [list(curves.read(tmp_path / "curves", NOMINAL).values())]
    own = curves.merged(parts, range(3))
    assert own is not None

    source = EpisodeSource("ReverseDuffing")
    episodes = source.play(source.draw(source.streams(range(3))))
    record, x = source.record(episodes), episodes.x[:-1].swapaxes(0, 1)
    estimator = EKF.for_setup(source.system, source.setup)
    estimates = estimator.run(record)
    k = np.flatnonzero(np.isin(record.t, own.t))
    assert len(k) == len(own.t)
    scaled = (estimates.xhat - x) / np.array(source.system.scale)
    expected = np.sqrt((scaled[..., 0] ** 2 + scaled[..., 1] ** 2) / 2)
    np.testing.assert_allclose(own.error, expected[:, k], rtol=3e-4)

    P = cramer_rao(source.system, record.t, x, record.prior.cov[0], source.noise)
    variance = (
        P[..., 0, 0] / source.system.scale[0] ** 2 + P[..., 1, 1] / source.system.scale[1] ** 2
    )
    np.testing.assert_allclose(own.reference, np.sqrt(variance / 2)[:, k], rtol=3e-4)

    assert own.example.seed == 0
    m = np.flatnonzero(np.isin(record.t, own.example.t))
    np.testing.assert_allclose(own.example.x, x[0, m], rtol=3e-4)
    np.testing.assert_allclose(own.example.y, record.y[0, m], rtol=3e-4)
    assert estimates.P is not None
    np.testing.assert_allclose(own.example.std[:, 1], np.sqrt(estimates.P[0, m, 1, 1]), rtol=3e-4)


def test_more_episodes_add_a_file(tmp_path):
    path = tmp_path / "rows.jsonl"
    for episodes in (1, 3):
        evaluate("open_loop", ENV, episodes=episodes, results=path)
    (parts,) = curves.read(tmp_path / "curves", NOMINAL).values()
    assert [part.seeds.tolist() for part in parts] == [[0], [1, 2]]


def test_scores_do_not_depend_on_curves_that_cannot_be_written(tmp_path, caplog):
    (tmp_path / "curves").write_text("")
    path = tmp_path / "rows.jsonl"
    for episodes in (1, 2):
        evaluate("open_loop", ENV, episodes=episodes, results=path)
    assert len(rows.read(path)) == 2
    (line,) = [line for line in caplog.messages if "curves" in line]
    assert line.startswith(f"cannot write {tmp_path / 'curves'}")
    assert line.endswith("scores are stored without these errors over time")


def test_every_flipped_bit_is_noticed(tmp_path):
    curves.save(tmp_path, row(), one())
    (path,) = tmp_path.rglob("*.npz")
    expected, refused, same = one(), [], 0
    for change in damaged(path, 120):
        try:
            ((back,),) = curves.read(tmp_path, NOISY).values()
        except ValueError as error:
            refused.append(error)
        else:
            for name in ("t", "seeds", "error"):
                np.testing.assert_array_equal(getattr(back, name), getattr(expected, name), change)
            np.testing.assert_array_equal(back.example.xhat, expected.example.xhat, change)
            same += 1
    assert len(refused) > same
    assert all(is_one_line_about(error, path) for error in refused)
