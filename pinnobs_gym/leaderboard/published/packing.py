"""Packing of a leaderboard's results into the folder that ships with the package."""

from __future__ import annotations

import hashlib
import lzma
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.files import json_line, replacing
from pinnobs_gym.leaderboard.floor import is_floor
from pinnobs_gym.leaderboard.jobs.job import Job
from pinnobs_gym.leaderboard.jobs.trainings import place_of, training_of
from pinnobs_gym.leaderboard.published.columns import packed
from pinnobs_gym.leaderboard.published.manifest import (
    CURVES,
    Manifest,
    PublishedFile,
    PublishedRows,
    PublishedTraining,
)
from pinnobs_gym.leaderboard.published.trained import Training, record_hash
from pinnobs_gym.scoring.curves import folder_of, merged, read, save
from pinnobs_gym.scoring.evaluation import make_estimator
from pinnobs_gym.scoring.provenance import estimator_code, estimator_hash, now, versions
from pinnobs_gym.scoring.recency import LastUse
from pinnobs_gym.scoring.rows import Row, Stored, game_of, seed_of

LARGEST = 10_000_000
"""Largest number of bytes of all published files."""
_SHOWN = 3
"""Number of the largest files that an error names."""


@dataclass(frozen=True)
class _Packed:
    """A file that is ready to be written."""

    entry: Any
    """Its `PublishedRows`, `PublishedTraining` or `PublishedFile`."""
    data: bytes


def pack(
    jobs: Sequence[Job], stored: Stored, to: Path, seeds: tuple[int, ...], largest: int = LARGEST
) -> Manifest:
    """Write the results of a leaderboard whose jobs are all done into a folder, in place of what
    was published there before. Nothing is changed unless everything can be packed.

    Args:
        jobs: its jobs.
        stored: its rows, of which those of the present code are published.
        to: the folder.
        seeds: training seeds of the rows; trained files of the first one are published.
        largest: largest number of bytes of all files.

    Raises:
        ValueError: in one line, if a job failed, a trained file is missing, the files are too
            large, or cannot be written.
    """
    if stored.failures:
        row = stored.failures[0]
        raise ValueError(
            f"{len(stored.failures)} job(s) failed, such as {row['estimator']} on "
            f"{', '.join(game_of(row))}: {row['error']}; nothing is published"
        )
    rows_files = list(_rows_files(stored, {job.game.name for job in jobs}, seeds))
    floors = {file.entry.game for file in rows_files if file.entry.floor}
    curves_files = list(_curves_files(stored, floors, jobs[0].folder))
    files = [*rows_files, *_trained_files(jobs, seeds[0]), *curves_files]
    _check_size(files, largest)
    for file in files:
        with replacing(to / file.entry.file, durable=True) as temporary:
            temporary.write_bytes(file.data)
    entries = [file.entry for file in files]
    manifest = Manifest(
        folder=to,
        date=now(),
        versions=versions(),
        training_seeds=seeds,
        rows=tuple(entry for entry in entries if isinstance(entry, PublishedRows)),
        trained=tuple(entry for entry in entries if isinstance(entry, PublishedTraining)),
        curves=tuple(file.entry for file in curves_files),
    )
    manifest.write()
    kept = {to / entry.file for entry in entries}
    for path in [*to.glob("rows/*.xz"), *to.glob("trained/*.xz"), *to.glob(f"{CURVES}/**/*.npz")]:
        if path not in kept:  # of what was published before
            path.unlink()
    return manifest


def _rows_files(stored: Stored, games: set[GameName], seeds: Sequence[int]) -> Iterator[_Packed]:
    """Yield a file for each game, and one for its floor: a line per run, of its number of rows and
    its packed columns.

    Floors of other games are published, too. Rows of other training seeds are not: some of them
    may be there for some games only, and no number of trainings would then be that of all.
    """
    last_use = LastUse.of([*stored.rows, *stored.uses])
    runs: dict[GameName, dict[Any, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in stored.rows:
        if row.get("training_seed") not in (None, *seeds):
            continue
        run = row["game_hash"], row["estimator"], row["estimator_hash"]
        runs[game_of(row)][run].append(row)
    for game in sorted(runs):
        own = last_use.among(game)
        present = [rows for rows in runs[game].values() if own.is_last(rows[0])]
        for floor in (False, True):
            chosen = [rows for rows in present if is_floor(rows[0]) == floor]
            if chosen and (floor or game in games):
                yield _rows_file(game, chosen, floor)


def _rows_file(game: GameName, runs: Sequence[Sequence[Row]], floor: bool) -> _Packed:
    lines = b"".join(_line(rows) for rows in runs)
    facts = {"game_hash": runs[0][0]["game_hash"], "rows": sum(map(len, runs)), "floor": floor}
    name = f"rows/{game.file_stem}{'-floor' * floor}"
    return _file(PublishedRows, name, lines, **game._asdict(), **facts)


def _line(rows: Sequence[Row]) -> bytes:
    return json_line({"rows": len(rows), "columns": packed(rows)})


def _curves_files(stored: Stored, games: set[GameName], folder: Path) -> Iterator[_Packed]:
    """Yield the errors over time of the floors of some games, without the Cramér-Rao reference, a
    file for each floor."""
    own = folder_of(folder / "rows.jsonl")
    for game in sorted(games):
        known = read(own, game)
        runs: dict[tuple[str, str], list[Row]] = defaultdict(list)
        for row in stored.rows:
            if is_floor(row) and game_of(row) == game:
                runs[row["game_hash"], row["estimator_hash"]].append(row)
        for hashes, rows in runs.items():
            whole = merged(known.get(hashes, []), map(seed_of, rows))
            if whole is None:
                continue
            with TemporaryDirectory() as temporary:
                save(Path(temporary), rows[0], replace(whole, reference=None))
                (path,) = Path(temporary).rglob("*.npz")
                data, file = path.read_bytes(), f"{CURVES}/{path.relative_to(temporary).as_posix()}"
            facts = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            yield _Packed(PublishedFile(file=file, **facts, **game._asdict()), data)


def _trained_files(jobs: Sequence[Job], seed: int) -> Iterator[_Packed]:
    """Yield a file for each training of a training seed."""
    seen = set()
    for job in jobs:
        training = training_of(job)
        if training is None or training.recipe.seed != seed:
            continue
        place = place_of(job, training)
        if place in seen:  # one training serves every condition
            continue
        seen.add(place)
        path = place if training.seed is None else place / "row-0" / "trained.pt"
        try:
            data = path.read_bytes()
        except OSError as error:
            raise ValueError(
                f"no trained file of {job.name}: {path}: {error.strerror or error}; run the job "
                "again with --fresh"
            ) from None
        facts = {"estimator": job.called, "code": training.code, **training.facts}
        facts |= {} if training.seed is None else _on_record(job, training)
        yield _file(PublishedTraining, f"trained/{place.name.removesuffix('.pt')}", data, **facts)


def _on_record(job: Job, training: Training) -> dict[str, str]:
    """Return the fields of a training on one episode."""
    estimator = make_estimator(training.cls, job.game, {"config": training.recipe})
    return {
        "record": record_hash(job.game.record([job.seed])),
        "estimator_code": estimator_code(training.cls),
        "estimator_hash": estimator_hash(estimator),
    }


def _file(kind: Any, name: str, content: bytes, **facts: Any) -> _Packed:
    """Return a file under a name that no other content has, so that a stopped packing leaves what
    was published before as it was."""
    data = lzma.compress(content, preset=9 | lzma.PRESET_EXTREME)
    sha256 = hashlib.sha256(data).hexdigest()
    file = f"{name}-{sha256[:8]}.xz"
    return _Packed(kind(file=file, size=len(data), sha256=sha256, **facts), data)


def _check_size(files: Sequence[_Packed], largest: int) -> None:
    total = sum(len(file.data) for file in files)
    if total > largest:
        by_size = sorted(files, key=lambda file: -len(file.data))[:_SHOWN]
        named = ", ".join(f"{file.entry.file} {len(file.data) / 1e6:.2f} MB" for file in by_size)
        raise ValueError(
            f"published files of {total / 1e6:.2f} MB; expected at most {largest / 1e6:.2f} MB: "
            f"the largest are {named}"
        )
