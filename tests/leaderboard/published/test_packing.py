"""What is packed is what was played, and nothing is packed by halves."""

import hashlib
import json
import lzma
import math

import numpy as np
import pytest
from made_rows import rows_of

from pinnobs_gym.leaderboard.published.columns import packed, rounded, unpacked
from pinnobs_gym.leaderboard.published.manifest import Manifest
from pinnobs_gym.leaderboard.published.packing import pack
from pinnobs_gym.leaderboard.published.reading import published_floors, rows_in
from pinnobs_gym.scoring import curves, rows
from pinnobs_gym.scoring.metrics import DIVERGED

SEEDS = (0, 1)


def test_published_rows_are_those_that_were_played_up_to_rounding(made):
    """Merging refuses rows of one episode that differ by more than rounding."""
    played = rows.load(made.rows)
    published = rows_in(made.manifest, made.manifest.rows)
    assert {rows.key(row) for row in published} == {rows.key(row) for row in played.rows}
    assert len(published) == len(played.rows) == 4 + 4 + 2 * 4 + 2 + 2 * 2
    both = rows.merge([("a", played), ("b", rows.Stored(published, []))])
    assert both.rows == played.rows


def test_the_list_has_the_hash_and_the_size_of_every_file(made):
    listed = json.loads((made.folder / "published.json").read_text())
    files = {path for path in made.folder.rglob("*") if path.is_file()}
    entries = listed["rows"] + listed["trained"] + listed["curves"]
    assert len(files) == 1 + len(entries)
    for entry in entries:
        data = (made.folder / entry["file"]).read_bytes()
        assert hashlib.sha256(data).hexdigest() == entry["sha256"]
        assert len(data) == entry["size"]
    assert listed["training_seeds"] == [0, 1]
    assert {"python", "torch", "numpy"} < listed["versions"].keys()


def test_floors_are_published_with_their_errors_over_time(made):
    games = [entry.game for entry in made.manifest.rows if entry.floor]
    found = published_floors(games, made.folder)
    assert sorted((row["estimator"], row["episode"]) for row in found) == [
        (name, f"seed:{seed}")
        for name in ("exact_bayes", "exact_bayes_smoother")
        for seed in (0, 1)
    ]
    assert published_floors([], made.folder) == []
    played = curves.read(curves.folder_of(made.rows), games[0])
    published = curves.read(made.folder / "curves", games[0])
    assert published.keys() == {(row["game_hash"], row["estimator_hash"]) for row in found}
    for hashes, (own,) in published.items():
        np.testing.assert_array_equal(own.error, curves.merged(played[hashes], [0, 1]).error)


def test_trained_files_are_those_of_the_first_training_seed(made):
    names = [(entry.estimator, entry.seed) for entry in made.manifest.trained]
    assert sorted(names, key=str) == [
        ("kkl_supervised", None),
        ("pinn_obs (guided by a smoother)", 0),
    ]
    trained = made.rows.parent / "trained"
    played = {hashlib.sha256(path.read_bytes()).digest() for path in trained.rglob("*.pt")}
    for entry in made.manifest.trained:
        data = lzma.decompress((made.folder / entry.file).read_bytes())
        assert hashlib.sha256(data).digest() in played


def test_packing_again_changes_no_file_but_the_date(made, tmp_path):
    stored = rows.load(made.rows)
    again = pack(made.jobs, stored, tmp_path, SEEDS)
    assert (again.rows, again.trained) == (made.manifest.rows, made.manifest.trained)


def test_rows_of_other_training_seeds_are_not_published(made, tmp_path):
    stored = rows.load(made.rows)
    few = pack(made.jobs, stored, tmp_path, (0,))
    published = {rows.key(row) for row in rows_in(few, few.rows)}
    untrained = [row for row in stored.rows if row.get("training_seed") is None]
    first = [row for row in stored.rows if row.get("training_seed") == 0]
    assert untrained
    assert 0 < len(first) < len(stored.rows) - len(untrained)
    assert published == {rows.key(row) for row in [*untrained, *first]}


def test_a_failed_job_is_not_published(made, copy):
    before = sorted(path.read_bytes() for path in copy.rglob("*.*"))
    failure = {"env_id": "pinnobs/X-v0", "setup": "benchmark", "condition": "nominal"}
    failure |= {"estimator": "ekf", "error": "ValueError: no"}
    stored = rows.load(made.rows)._replace(failures=[failure])
    with pytest.raises(ValueError, match=r"^1 job\(s\) failed, such as ekf on pinnobs/X-v0.* no;"):
        pack(made.jobs, stored, copy, SEEDS)
    assert sorted(path.read_bytes() for path in copy.rglob("*.*")) == before


def test_too_many_bytes_are_refused_and_the_largest_files_named(made, copy):
    largest = max(made.manifest.trained, key=lambda entry: entry.size)
    before = Manifest.read(copy)
    with pytest.raises(ValueError, match=r"at most 0\.00 MB: the largest are") as error:
        pack(made.jobs, rows.load(made.rows), copy, SEEDS, largest=1000)
    assert f"the largest are {largest.file} " in str(error.value)
    assert "\n" not in str(error.value)
    assert Manifest.read(copy) == before


def test_what_was_published_before_is_removed_at_the_end(made, copy):
    (copy / "rows" / "old.xz").write_bytes(b"")
    pack(made.jobs, rows.load(made.rows), copy, SEEDS)
    assert not (copy / "rows" / "old.xz").exists()
    assert {path.name for path in copy.iterdir()} == {"published.json", "rows", "trained", "curves"}


def test_a_missing_trained_file_is_told(made, copy):
    (job, *_) = [job for job in made.jobs if job.estimator == "kkl_supervised"]
    moved = [*made.jobs, type(job)(**{**vars(job), "folder": copy})]
    with pytest.raises(ValueError, match="no trained file of kkl_supervised on ReverseDuffing"):
        pack(moved, rows.load(made.rows), copy, SEEDS)


def test_rounding_keeps_seven_digits_and_the_side_of_the_limit_of_divergence():
    just_above = math.nextafter(DIVERGED, 1)
    (row,) = rows_of("x", [0.123456789], diverged=[True])
    row |= {"nrmse_tail": just_above, "mae": math.inf}
    row |= {"training": {"config": {"learning_rate": 0.123456789}}}
    found = rounded(row)
    assert found["nrmse_tail"] == just_above > DIVERGED
    assert found["rmse"] == 0.1234568
    assert found["mae"] == math.inf
    assert found["training"] == row["training"]


def test_columns_restore_rows_whose_values_have_other_types_and_keys():
    some = rows_of("x", [1.0, 2.0, 2.0])
    some[1]["options"] = {"a": 1}
    some[2]["options"] = {"a": True}
    some[0]["us_per_step"], some[1]["us_per_step"] = 1, 1.0
    again = unpacked(json.loads(json.dumps(packed(some))), 3)
    stored = [rows.without_absent(row) for row in some]
    assert json.dumps(again, sort_keys=True) == json.dumps(stored, sort_keys=True)


@pytest.mark.parametrize(
    "columns", [[], {"same": {}, "each": []}, {"each": [{}]}, {"other": {}}, {"same": 1}]
)
def test_what_is_no_packed_form_is_refused(columns):
    with pytest.raises(ValueError, match="expected"):
        unpacked(columns, 2)
