"""Suites: what their files say, and the jobs that come of them."""

from pathlib import Path

import pytest

from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.pinn_obs import PinnObs
from pinnobs_gym.leaderboard import suites
from pinnobs_gym.leaderboard.jobs import plan
from pinnobs_gym.leaderboard.jobs.job import trained
from pinnobs_gym.leaderboard.jobs.plan import jobs_of
from pinnobs_gym.leaderboard.jobs.trainings import training_of
from pinnobs_gym.leaderboard.suites import Entry, Suite
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.rows import Stored, seed_of
from pinnobs_gym.simulation.conditions import CONDITIONS
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.by_name import train_by_name


@pytest.fixture
def write(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def written(text):
        (tmp_path / "my.toml").write_text(text)
        return suites.load("my.toml")

    return written


def test_a_file_is_read_and_options_change_it(write):
    suite = write(
        'systems = ["Academic"]\n'
        'estimators = ["ekf", {name = "ekf", label = "robust", settings = {huber = 1.3}}]\n'
        "episodes = 7\nbudgets = [1, 2.5]\ntraining_seeds = [0, 1]\n"
    )
    assert suite.systems == ("Academic",)
    assert suite.estimators == (Entry("ekf"), Entry("ekf", "robust", {"huber": 1.3}))
    tuned = write('estimators = ["ekf, tuned", {name = "ekf", tuned = true}]').estimators
    assert tuned == (Entry("ekf", tuned=True),) * 2
    assert (suite.episodes, suite.budgets, suite.training_seeds) == (7, (1, 2.5), (0, 1))
    assert (suite.setup, suite.seed) == ("benchmark", 0)
    other = suite.changed(episodes=3, setup=None, systems=(), estimators=("ukf",))
    assert (other.episodes, other.setup, other.systems) == (3, "benchmark", ("Academic",))
    assert other.estimators == (Entry("ukf"),)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("epsiodes = 3", "unknown key 'epsiodes'; expected one of systems, estimators, "),
        ("episodes = 0", "episodes=0; expected at least 1"),
        ("episodes = true", "episodes=True; expected at least 1"),
        ("seed = -1", "seed=-1; expected at least 0"),
        ("seed = 9223372036854775808", "seed=9223372036854775808; expected at least 0, at most"),
        ("episodes = 10_000_001", "episodes=10000001; expected at least 1, at most 10000000"),
        ("systems = " + "[" * 5000 + "]" * 5000, "nested too deeply"),
        ('estimators = [{name = "ekf", label = 3}]', "estimators: label=3; expected letters"),
        ('systems = "Academic"', "systems='Academic'; expected a list of names"),
        ("systems = [1]", "systems=[1]; expected a list of names"),
        ("budgets = [0]", "budgets=[0]; expected a list of positive numbers of seconds"),
        ('conditions = ["gap", "gap"]', "conditions=['gap', 'gap']; expected each but once"),
        ('estimators = [{use = "ekf"}]', "estimators: unknown key 'use' in {'use': 'ekf'}; expe"),
        ('estimators = [{label = "a"}]', "estimators: {'label': 'a'} has no name"),
        ('estimators = [{name = "ekf", label = "a/b"}]', "estimators: label='a/b'; expected lett"),
        ('estimators = [{name = "ekf", tuned = 1}]', "estimators: tuned=1; expected true or false"),
        (
            'estimators = [{name = "ekf", tuned = true, settings = {huber = 1}}]',
            "is tuned and has settings; expected one",
        ),
        ('estimators = ["pinn_gain, tuned"]', "estimators: estimator 'pinn_gain' is trained"),
        ('estimators = ["ekf, tuned", "ekf, tuned"]', "estimators: 'ekf, tuned' stands for two"),
        ("episodes", "is no TOML: "),
        ('systems = ["Duffing"]', "systems: unknown system 'Duffing'; known are Academic"),
        ('estimators = ["kf"]', "estimators: unknown estimator 'kf'; known are batch_least"),
        ('estimators = ["pinn_obs_direct"]', "estimators: estimator 'pinn_obs_direct' knows one"),
        ('estimators = ["ekf", "ekf"]', "estimators: 'ekf' stands for two; give each a"),
        ('estimators = ["pinn_obs", "pinn_obs"]', "estimators: 'pinn_obs (guided by a smoother)'"),
        ('estimators = ["ekf", {name = "ekf"}]', "estimators: 'ekf' stands for two; give each a"),
        ('setup = "x"', "setup: unknown setup 'x' of Academic"),
        ('conditions = ["fog"]', "conditions: 'fog' on Academic: unknown condition 'fog'"),
        ('conditions = ["load_step"]', "conditions: 'load_step' on Academic: condition 'load_st"),
        ('conditions = ["all", "gap"]', "conditions: conditions all gap: 'all' stands alone"),
        ("training_seeds = [4294967296]", "expected a list of whole numbers from 0 to 4294967295"),
        (
            'estimators = [{name = "pinn_obs", settings = {transfer = "False"}}]',
            "estimators: settings of 'pinn_obs': transfer='False'; expected True or False",
        ),
        (
            'estimators = [{name = "ekf", settings = {gate = "0.9"}}]',
            "estimators: settings of 'ekf': gate='0.9'; expected None or a number",
        ),
        (
            'estimators = [{name = "enkf", settings = {members = 10.0}}]',
            "estimators: settings of 'enkf': members=10.0; expected a whole number",
        ),
        (
            'estimators = [{name = "ekf", settings = {huuber = 1}}]',
            "estimators: settings of 'ekf': setting 'huuber'; expected one of assumed_noise, ",
        ),
        (
            'estimators = [{name = "ekf", settings = {huber = -1}}]',
            "estimators: settings of 'ekf': huber=-1; expected a number of at least 1e-30",
        ),
        (
            'estimators = [{name = "pinn_gain", settings = {depth = 1.5, streams = -1}}]',
            "estimators: sett",
        ),
    ],
)
def test_mistakes_name_file_key_value_and_what_was_expected(write, tmp_path, text, message):
    with pytest.raises(ValueError, match=r"^suite my\.toml") as caught:
        jobs_of(write(text), tmp_path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_option_is_not_told_as_the_files(write, tmp_path):
    suite = write('conditions = ["load_step"]').changed(conditions=("fog",))
    with pytest.raises(ValueError, match=r"^'fog' on Academic: unknown condition"):
        jobs_of(suite, tmp_path)
    with pytest.raises(ValueError, match=r"^episodes=0; expected at least 1"):
        suite.changed(episodes=0)


@pytest.mark.parametrize("name", suites.names())
def test_every_suite_of_ours_has_jobs(name, tmp_path):
    jobs = jobs_of(suites.load(name), tmp_path)
    assert jobs
    told = {(job.game.name, job.called, str(job.training), job.seed) for job in jobs}
    assert len(told) == len(jobs)
    assert {job.game.system.partition(":")[2] for job in jobs} == set(SYSTEMS.classes())


def test_full_is_every_system_estimator_and_condition(tmp_path):
    jobs = jobs_of(suites.load("full"), tmp_path)
    ranked = {
        n for n, c in ESTIMATORS.classes().items() if not c.needs_training or c.track == "online"
    }
    assert {job.estimator for job in jobs} == ranked
    assert {job.game.name.condition for job in jobs} == set(CONDITIONS)


@pytest.mark.parametrize("name", ["leaderboard", "full", "paper"])
def test_pinn_obs_is_played_with_and_without_its_guide(name, tmp_path):
    games = {}
    for job in jobs_of(suites.load(name), tmp_path):
        if job.estimator in ("pinn_obs", "pinn_obs_replay"):
            games.setdefault(job.called, set()).add(job.game.name)
    recipes = ["guided by a smoother", "paper's loss", *["paper's recipe"] * (name == "paper")]
    assert set(games) == {f"pinn_obs{s} ({r})" for s in ("", "_replay") for r in recipes}
    assert len(set(map(frozenset, games.values()))) == 1


def test_rows_are_called_as_the_plan_says(tmp_path):
    small = {"depth": 1, "width": 3, "iterations": 2}
    entries = [
        Entry(name, settings={**small, "preset": preset})
        for name in ("pinn_obs", "pinn_obs_replay")
        for preset in ("guided", "plain")
    ]
    suite = Suite(("ReverseDuffing",), tuple(entries), ("nominal",), episodes=1)
    jobs = jobs_of(suite, tmp_path)
    for job in jobs:
        job.run()
    stored = rows.load(tmp_path / "rows.jsonl")
    assert [row["estimator"] for row in stored.rows] == [job.called for job in jobs]
    assert len({job.called for job in jobs}) == 4
    assert all(job.known for job in plan.left(jobs, stored, False)[0])


def test_budgets_and_seeds_multiply_what_learns(tmp_path):
    names = tuple(map(Entry, ("ekf", "pinn_gain", "pinn_obs")))
    suite = Suite(("Academic",), names, budgets=(1.0, 2.0), training_seeds=(0, 1, 2))
    jobs = jobs_of(suite, tmp_path)
    count = {n: sum(job.estimator == n for job in jobs) for n in ("ekf", "pinn_gain", "pinn_obs")}
    assert count == {"ekf": 1, "pinn_gain": 6, "pinn_obs": 6 * suite.trained_episodes}
    chosen = {(j.training["budget"], j.training["seed"]) for j in jobs if j.training}
    assert chosen == {(b, s) for b in (1.0, 2.0) for s in (0, 1, 2)}


def test_variants_have_rows_of_their_own_and_what_is_stored_is_not_run_again(tmp_path):
    variants = (Entry("ekf"), Entry("ekf", "robust ekf", {"huber": 1.345}))
    suite = Suite(("Academic",), variants, episodes=3)
    path = tmp_path / "rows.jsonl"

    def run(suite):
        before = len(rows.read(path))
        for job in plan.left(jobs_of(suite, tmp_path), rows.load(path), False)[0]:
            job.run()
        found = rows.read(path)[before:]
        return sorted((row["estimator"], seed_of(row)) for row in found)

    both = [(name, seed) for name in ("ekf", "robust ekf") for seed in range(3)]
    assert run(suite) == both
    assert run(suite) == []
    assert run(suite.changed(episodes=4)) == [("ekf", 3), ("robust ekf", 3)]
    hashes = {row["estimator"]: row["estimator_hash"] for row in rows.read(path)}
    assert len(set(hashes.values())) == 2
    # another setting under the same name: what is stored is of another configuration
    other = (Entry("ekf"), Entry("ekf", "robust ekf", {"huber": 2.0}))
    assert run(Suite(("Academic",), other, episodes=3)) == [("robust ekf", s) for s in range(3)]


def test_an_edited_default_is_run_anew(tmp_path, monkeypatch):
    path = tmp_path / "rows.jsonl"
    suite = Suite(("Academic",), (Entry("ekf"),), episodes=2)

    def run():
        for job in plan.left(jobs_of(suite, tmp_path), rows.load(path), False)[0]:
            job.run()
        return len(rows.read(path))

    assert run() == 2
    defaults = EKF.__init__.__defaults__
    assert 15 in defaults  # of patience
    changed = tuple(16 if value == 15 else value for value in defaults)
    monkeypatch.setattr(EKF.__init__, "__defaults__", changed)
    assert run() == 4
    assert run() == 4


def test_failures_are_left_out_or_told_that_they_are_tried_again(tmp_path):
    first, second = jobs_of(Suite(("Academic",), (Entry("ekf"), Entry("ukf"))), Path("elsewhere"))
    stored = Stored([], [{"job": first.digest}])
    to_run, left_out = plan.left([first, second], stored, retry_failed=False)
    assert ([job.estimator for job in to_run], left_out) == (["ukf"], [first])
    to_run, left_out = plan.left([first, second], stored, retry_failed=True)
    assert [(job.estimator, job.failed) for job in to_run] == [("ekf", True), ("ukf", False)]
    assert left_out == []
    here = jobs_of(Suite(("Academic",), (Entry("ekf"),)), tmp_path)[0]
    assert here.digest == first.digest  # wherever it is kept


def written(path):
    """What changes when a file is written again."""
    return path.stat().st_ino, path.stat().st_mtime_ns, path.read_bytes()


def test_of_two_trainings_at_the_same_time_the_first_counts(tmp_path, monkeypatch):
    """The other one's file is there by the time that the second is trained."""
    small = {"depth": 1, "width": 4, "iterations": 5}
    entry = (Entry("pinn_obs_replay", None, small),)
    (job,) = jobs_of(Suite(("Academic",), entry, ("nominal",)), tmp_path)
    training = training_of(job)
    train, found = train_by_name, []

    def slow(*arguments, **options):
        result = train(*arguments, **options)
        if not found:
            found.append(None)
            trained(training, job)  # as another process does meanwhile
            (path,) = (tmp_path / "trained").iterdir()
            found.append((path, written(path)))
        return result

    monkeypatch.setattr("pinnobs_gym.leaderboard.jobs.job.train_by_name", slow)
    trained(training, job)
    path, before = found[1]
    assert list((tmp_path / "trained").iterdir()) == [path]
    assert written(path) == before


@pytest.mark.parametrize("settings", [{}, {"iterations": 1}])
def test_what_trains_on_each_record_trains_by_its_own_recipe(tmp_path, monkeypatch, settings):
    recipe = {"depth": 1, "width": 3, "iterations": 2}
    monkeypatch.setattr(PinnObs, "recipe", recipe)
    suite = Suite(
        systems=("ReverseDuffing",),
        estimators=(Entry("pinn_obs", settings=settings),),
        conditions=("nominal",),
        trained_episodes=1,
    )
    (job,) = jobs_of(suite, tmp_path)
    job.run()
    (row,) = rows.read(tmp_path / "rows.jsonl")
    config = row["options"]["config"]
    assert {name: config[name] for name in recipe} == {**recipe, **settings}
