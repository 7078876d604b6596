"""Published files are used if they are whole and of the same training, and only then."""

import json
from dataclasses import replace

import pytest
from damage import damaged, is_one_line_about
from made_published import KKL, SUITE

import pinnobs_gym
from pinnobs_gym.cli import main
from pinnobs_gym.envs.game import Game
from pinnobs_gym.files.seal import sealed
from pinnobs_gym.leaderboard.against import compare, opponents
from pinnobs_gym.leaderboard.jobs import plan, trainings
from pinnobs_gym.leaderboard.jobs.job import run_job
from pinnobs_gym.leaderboard.published import manifest, on_record, reading
from pinnobs_gym.leaderboard.published.manifest import Manifest
from pinnobs_gym.leaderboard.published.trained import published_for
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.evaluation import evaluate


@pytest.fixture
def shipped(copy, monkeypatch):
    """The copy in the place of what ships with the package."""
    monkeypatch.setattr(manifest, "FOLDER", copy)
    return copy


def jobs(folder, published, **changes):
    suite = replace(SUITE, training_seeds=(0,), **changes)
    return [replace(job, published=published) for job in plan.jobs_of(suite, folder)]


def learning(folder, published, name):
    (job,) = [job for job in jobs(folder, published) if job.estimator == name]
    return job


def listed(folder, change):
    """Change the list of what is published."""
    path = folder / "published.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(sealed(content)))


@pytest.mark.parametrize("name", ["kkl_supervised", "pinn_obs"])
def test_a_job_plays_the_published_training_as_the_job_that_trained(made, tmp_path, name):
    job = learning(tmp_path, made.folder, name)
    assert not trainings.Outlook().will_train(job)
    run_job(job)
    assert not (tmp_path / "trained").exists()  # nothing was trained
    played = {rows.key(row): row for row in rows.read(made.rows)}
    found = rows.read(job.rows)
    assert found
    for row in found:
        before = played[rows.key(row)]
        assert row["nrmse"] == pytest.approx(before["nrmse"], rel=1e-9)
        assert row["training"] == before["training"]
        if name == "pinn_obs":  # the training is part of the cost, as it was
            steps = Game.of("ReverseDuffing").record([0]).num_samples
            with_training = network_seconds(made) * 1e6 / steps
            assert row["us_per_step"] > with_training


def network_seconds(made):
    from pinnobs_gym.estimators.pinn_obs import TrainedNetwork

    job = next(job for job in made.jobs if job.estimator == "pinn_obs")
    training = trainings.training_of(job)
    path = trainings.place_of(job, training) / "row-0" / "trained.pt"
    return TrainedNetwork.load(path, job.game.source.system).seconds


@pytest.mark.parametrize("changes", [{"published": None}, {"training": {"seed": 3, **KKL}}])
def test_another_recipe_or_the_wish_to_train_anew_trains(made, tmp_path, changes):
    job = replace(learning(tmp_path, made.folder, "kkl_supervised"), **changes)
    assert trainings.Outlook().will_train(job)
    run_job(job)
    assert len(list((tmp_path / "trained").glob("*.pt"))) == 1
    assert not trainings.Outlook().will_train(job)


def test_a_training_in_the_folder_comes_before_the_published_one(made, tmp_path):
    run_job(replace(learning(tmp_path, None, "kkl_supervised")))
    (path,) = (tmp_path / "trained").glob("*.pt")
    path.write_bytes(b"damaged")
    with pytest.raises(ValueError, match="is damaged"):
        run_job(replace(learning(tmp_path, made.folder, "kkl_supervised"), fresh=True))


def test_a_game_with_other_settings_has_no_published_training(made):
    job = learning(made.folder, made.folder, "kkl_supervised")
    training = trainings.training_of(job)
    assert published_for(training, made.manifest) is not None
    other = Game.of("ReverseDuffing", noise_std=0.3)
    assert published_for(replace(training, game=other), made.manifest) is None


def test_earlier_code_is_told_by_estimator_and_system(copy, tmp_path):
    own = jobs(tmp_path, copy)
    assert trainings.Outlook().outdated(own) == {}
    listed(copy, lambda content: content["trained"][0].update(code="other"))
    (name,) = {Manifest.read(copy).trained[0].estimator}
    assert trainings.Outlook().outdated(own) == {name: ["ReverseDuffing-v0"]}


def test_rows_of_a_network_of_earlier_code_have_the_hashes_of_that_code(copy, tmp_path):
    earlier = {"code": "other", "estimator_code": "old code", "estimator_hash": "old hash"}
    listed(copy, lambda c: [e.update(earlier) for e in c["trained"] if e["record"]])
    job = learning(tmp_path, copy, "pinn_obs")
    run_job(job)
    (row,) = rows.read(job.rows)
    assert (row["estimator_code"], row["estimator_hash"]) == ("old code", "old hash")
    before = job.rows.read_bytes()
    run_job(job)
    assert [row["kind"] for row in map(json.loads, before.splitlines())] == ["score"]
    assert job.rows.read_bytes() == before  # it is the present one, and is not played again


def test_a_network_of_another_record_is_not_used(made):
    job = learning(made.folder, made.folder, "pinn_obs")
    training = trainings.training_of(job)
    entry = published_for(training, made.manifest)
    system, setup = job.game.source.system, job.game.source.setup
    estimator = training.cls.for_setup(system, setup, config=training.recipe)
    assert on_record.stand_in(estimator, job.game, made.manifest, entry) is not None
    rounding = replace(entry, record="that of another machine")  # the outputs are near
    assert on_record.stand_in(estimator, job.game, made.manifest, rounding) is not None
    other = replace(rounding, seed=1)
    assert on_record.stand_in(estimator, job.game, made.manifest, other) is None


def test_load_gives_the_estimator_that_was_scored_first(made, shipped):
    with pytest.raises(ValueError, match="no trained file of 'kkl_pinn' on ReverseDuffing-v0"):
        pinnobs_gym.load("kkl_pinn", "ReverseDuffing")
    estimator = pinnobs_gym.load("kkl_supervised", "ReverseDuffing")
    found = evaluate(estimator, "ReverseDuffing", episodes=4)
    played = {rows.key(row): row for row in rows.read(made.rows)}
    for row in found:
        assert row["training_seed"] == 0
        assert row["nrmse"] == pytest.approx(played[rows.key(row)]["nrmse"], rel=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("kkl", "ReverseDuffing"), "unknown estimator 'kkl'"),
        (("kkl_supervised", "Duffing"), "unknown system 'Duffing'"),
        (("kkl_supervised", "ReverseDuffing", "x"), "unknown setup 'x'"),
        (("ekf", "ReverseDuffing"), "estimator 'ekf' needs no training; no trained file"),
        (("pinn_obs", "ReverseDuffing"), "estimator 'pinn_obs' trains on each record; no trained"),
        (
            ("kkl_supervised", "Academic"),
            "'kkl_supervised' on Academic-v0, benchmark, is published; published are "
            "kkl_supervised on ReverseDuffing-v0$",
        ),
        (("kkl_supervised", "ReverseDuffing", "paper"), "on ReverseDuffing-v0, paper, is publis"),
    ],
)
def test_what_cannot_be_loaded_is_told_in_one_line(shipped, arguments, message):
    with pytest.raises(ValueError, match=message) as error:
        pinnobs_gym.load(*arguments)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda f, file: file.write_bytes(file.read_bytes()[:-1]), "bytes; expected "),
        (lambda f, file: file.write_bytes(bytes(file.stat().st_size)), "its SHA-256 differs"),
        (lambda f, file: file.unlink(), "cannot read .*: No such file"),
        (lambda f, file: listed(f, lambda c: c.update(format=2)), "another version of pinnobs-gym"),
        (lambda f, file: listed(f, lambda c: c.pop("date")), "published.json is damaged: "),
        (lambda f, file: listed(f, lambda c: c.update(rows=3)), "published.json is damaged: "),
        (lambda f, file: listed(f, lambda c: c["trained"][0].update(size="1")), "size='1'; expect"),
        (lambda f, file: (f / "published.json").write_text("{"), "damaged: it is no JSON object"),
        (lambda f, file: (f / "published.json").unlink(), "holds no published results; make publ"),
    ],
)
def test_a_damaged_file_is_told_in_one_line_and_nothing_is_lost(shipped, break_it, message):
    (entry,) = [e for e in Manifest.read(shipped).trained if e.estimator == "kkl_supervised"]
    break_it(shipped, shipped / entry.file)
    left = {path: path.read_bytes() for path in shipped.rglob("*.*")}
    with pytest.raises(ValueError, match=message) as error:
        pinnobs_gym.load("kkl_supervised", "ReverseDuffing")
    assert "\n" not in str(error.value)
    assert {path: path.read_bytes() for path in shipped.rglob("*.*")} == left


def test_every_flipped_bit_of_what_is_published_is_noticed(shipped):
    whole = Manifest.read(shipped)
    (entry,) = [e for e in whole.trained if e.estimator == "kkl_supervised"]
    for path in (shipped / "published.json", shipped / entry.file):
        refused, same = [], 0
        for change in damaged(path, 60):
            try:
                found = Manifest.read(shipped)
                assert found == whole, change
                found.content(entry)
                same += 1
            except ValueError as error:
                refused.append(error)
        assert len(refused) > same
        assert all(is_one_line_about(error, path) for error in refused)


def test_a_new_estimator_is_ranked_among_the_published_ones_on_the_same_episodes(made, shipped):
    game = Game.of("ReverseDuffing")
    others = opponents(reading.PUBLISHED, game, range(6))
    own = evaluate("ukf", "ReverseDuffing", episodes=6)
    found = compare(own, others)
    names = {entry.name.partition(" (")[0] for entry in found.table.entries}
    assert names == {"ekf", "ukf", "open_loop", "kkl_supervised"}
    assert {entry.standing.episodes for entry in found.table.entries} <= {4, 8}
    assert found.summary.startswith("ukf: rank 1 (steady)")
    assert "of 4 estimators of the track online, on the 4 of 6 episodes of" in found.summary
    # The same estimator again is one line of the table.
    again = compare(evaluate("ekf", "ReverseDuffing", episodes=4), others)
    assert len(again.table.entries) == 3
    # The rows file gives what the published rows give.
    same = compare(own, opponents(made.rows, game, range(6)))
    assert [(e.name, e.ranks) for e in same.table.entries] == [
        (e.name, e.ranks) for e in found.table.entries
    ]


def test_one_that_trains_on_each_record_is_shown_on_these_records(made):
    game = Game.of("ReverseDuffing")
    own = [row for row in rows.read(made.rows) if row["estimator"].startswith("pinn_obs")]
    own = [row for row in own if row["training_seed"] == 0]
    found = compare(own, opponents(made.rows, game, range(4)))
    assert "on 1 episodes of" in found.summary
    assert "ekf" in {entry.name for entry in found.table.entries}


def test_rows_of_another_game_or_of_other_code_are_refused(made, shipped):
    published, own = reading.PUBLISHED, Game.of("ReverseDuffing")
    with pytest.raises(ValueError, match="no scores of pinnobs/Academic-v0, benchmark, nominal;"):
        opponents(published, Game.of("Academic"), range(4))
    with pytest.raises(ValueError, match="seeds 50 to 51; it has those of 0 to 3"):
        opponents(published, own, range(50, 52))
    with pytest.raises(ValueError, match=r"there is no rows file none\.jsonl"):
        opponents(made.rows.with_name("none.jsonl").relative_to(made.rows.parent), own, range(4))
    changed = Game.of("ReverseDuffing", noise_std=0.3)  # other settings have another hash
    with pytest.raises(
        ValueError,
        match="cannot be compared; make new ones by pinnobs leaderboard "
        "--systems ReverseDuffing, and name",
    ):
        opponents(published, changed, range(4))


def test_published_rows_are_read_where_a_rows_file_is(made, shipped):
    alone = reading.load_rows([reading.PUBLISHED])
    both = reading.load_rows([made.rows, reading.PUBLISHED])
    assert len(alone.rows) == len(both.rows) == len(rows.read(made.rows))


def test_the_next_command_compares_with_what_is_published_only_if_it_can(shipped, tmp_path, capsys):
    command = ["evaluate", "--system", "ReverseDuffing", "--episodes", "3", "--out", str(tmp_path)]
    assert main(command) == 0
    following = capsys.readouterr().out.splitlines()[-1]
    assert following.startswith("next: pinnobs evaluate --system ReverseDuffing")
    assert following.endswith(" --against published")
    assert main([*following.split()[2:], "--episodes", "3"]) == 0
    stale = Manifest.read(shipped)
    assert stale is not None
    replace(stale, rows=tuple(replace(each, game_hash="0" * 12) for each in stale.rows)).write()
    capsys.readouterr()
    assert main(command) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("next: pinnobs tables ")
