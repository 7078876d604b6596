"""Jobs of floors that are stored are known without running them."""

from dataclasses import replace

from pinnobs_gym.envs.game import Game
from pinnobs_gym.leaderboard.jobs.floor_job import floor_jobs, left
from pinnobs_gym.scoring import rows


def test_a_job_is_left_until_every_episode_of_both_floors_is_stored(tmp_path):
    game = Game.of("ReverseDuffing", condition="noise5")
    (job,) = floor_jobs([game], range(1), tmp_path, fresh=False)
    assert left([job], rows.load(job.rows)) == [job]
    job.run()
    stored = rows.load(job.rows)
    more, anew = replace(job, episodes=2), replace(job, fresh=True)
    assert left([job, more, anew], stored) == [more, anew]
    filtered, smoothed = stored.rows
    assert left([job], stored._replace(rows=[filtered])) == [job]
    other = smoothed | {"game_hash": "other"}
    assert left([job], stored._replace(rows=[filtered, other])) == [job]


def test_a_job_is_left_if_other_code_was_used_after_it(tmp_path):
    """It then notes that its own code is the present one again."""
    (job,) = floor_jobs([Game.of("Academic")], range(1), tmp_path, fresh=False)
    job.run()
    later = {"game_hash": "later", "date": "2999-01-01T00:00:00+00:00"}
    rows.append(job.rows, [row | later for row in rows.read(job.rows)])
    assert left([job], rows.load(job.rows)) == [job]
    job.run()
    assert left([job], rows.load(job.rows)) == []
