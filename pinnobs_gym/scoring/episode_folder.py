"""Folders with the records of a game's episodes, for estimators in other languages.

A folder has the records without the true states, texts that say what they are, and ``game.json``,
from which estimates that are brought back are scored (`pinnobs_gym.scoring.submitted`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from pinnobs_gym.envs.game import Game, GameName
from pinnobs_gym.files import replacing_folder
from pinnobs_gym.files.archive import Damaged, json_of
from pinnobs_gym.files.seal import sealed, unsealed
from pinnobs_gym.scoring.episode_table import writing
from pinnobs_gym.scoring.evaluation import BATCH, seeds_of
from pinnobs_gym.scoring.issue import FORMAT, Issue
from pinnobs_gym.scoring.provenance import game_hash

GAME_FILE = "game.json"
"""The file that identifies the game and its episodes."""
_HASHES = "sha256"
"""The entry of this file that has the hash of each table."""


def write_folder(
    folder: Path,
    issue: Issue,
    texts: Mapping[str, str],
    progress: Callable[[int], None] | None = None,
) -> bool:
    """Write a folder, all of it or nothing.

    Args:
        folder: the folder; it may exist if it is empty.
        issue: what it has.
        texts: further files by name.
        progress: called with the number of episodes written since its last call.

    Returns:
        Whether it was written; False if the folder has these very records already.

    Raises:
        ValueError: in one line, if the folder holds anything else, or cannot be written.
    """
    facts = issue.facts()
    if is_there(folder, facts):
        return False
    with replacing_folder(folder) as made:
        _write_tables(made, issue, progress)
        for name, text in texts.items():
            (made / name).write_text(text, encoding="utf-8", newline="\n")
        facts |= {_HASHES: {name: _sha256(made / name) for name in issue.tables}}
        text = json.dumps(sealed(facts), indent=2, ensure_ascii=False, allow_nan=False)
        (made / GAME_FILE).write_text(text + "\n", encoding="utf-8", newline="\n")
    return True


def is_there(folder: Path, facts: Mapping[str, Any]) -> bool:
    """Return whether a folder has the records of these `Issue.facts`; False if it is empty or does
    not exist.

    Raises:
        ValueError: in one line, if it holds anything else, or a table is not as it was written.
    """
    if not folder.exists():
        return False
    if not folder.is_dir():
        raise ValueError(f"{folder} is a file; expected a new folder")
    if not any(folder.iterdir()):
        return False
    try:
        found = _read_facts(folder)
    except ValueError:
        raise ValueError(f"folder {folder} holds other files; expected a new folder") from None
    hashes = found.pop(_HASHES, None)
    if found != json.loads(json.dumps(facts)):
        differing = [name for name in facts if found.get(name) != facts[name]]
        raise ValueError(
            f"folder {folder} holds other records ({', '.join(differing[:3]) or 'more'} differ); "
            "expected a new folder"
        )
    for name in found["tables"]:
        if not isinstance(hashes, dict) or hashes.get(name) != _sha256(folder / name):
            raise ValueError(
                f"{folder / name} is missing or not as it was written; expected a new folder"
            )
    return True


def _sha256(path: Path) -> str | None:
    """Return the hash of a file; None if it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None


def _write_tables(folder: Path, issue: Issue, progress: Callable[[int], None] | None) -> None:
    """Play the episodes batch by batch, and write their samples."""
    source = issue.game.source
    with ExitStack() as stack:
        append = {
            name: stack.enter_context(writing(folder / name, columns))
            for name, columns in issue.tables.items()
        }
        for first in range(0, len(issue.seeds), BATCH):
            batch = issue.seeds[first : first + BATCH]
            episodes = issue.game.episodes(batch)
            record = source.record(episodes)
            truth = episodes.x[: record.num_samples].swapaxes(0, 1)
            known = np.concatenate([record.y, record.u], axis=2)
            for (name, columns), values in zip(issue.tables.items(), (known, truth), strict=False):
                append[name](_columns(columns, batch, record.t, values))
            if progress is not None:
                progress(len(batch))


def _columns(
    names: Sequence[str], seeds: Sequence[int], t: np.ndarray, values: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the columns (batch · num_samples,) of values (batch, num_samples, n), after those of
    episode and time."""
    batch, samples, n = values.shape
    flat = values.reshape(batch * samples, n)
    index = [np.repeat(np.array(seeds), samples), np.tile(t, batch)]
    return dict(zip(names, [*index, *flat.T], strict=True))


def _read_facts(folder: Path) -> dict[str, Any]:
    path = folder / GAME_FILE
    if not path.is_file():
        raise ValueError(f"there is no {path}; expected a folder that pinnobs episodes wrote")
    try:
        facts = json_of(path)
        if not isinstance(facts, dict) or facts.get("format") != FORMAT:
            raise ValueError(f"{path} is no file of pinnobs episodes of format {FORMAT}")
        return unsealed(facts)
    except (OSError, Damaged) as error:
        raise ValueError(f"cannot read {path}: {error}") from None


def read_folder(folder: Path, system: str | None = None) -> tuple[Game, range]:
    """Return the game and the seeds of the episodes of a folder.

    Args:
        folder: the folder.
        system: the system as ``module:Class``, if it is not one of this package.

    Raises:
        ValueError: in one line, if ``game.json`` cannot be read, or the present code of the system,
            the simulation and the scores would play or score other episodes.
    """
    facts, path = _read_facts(folder), folder / GAME_FILE
    names = {name: facts.get(name) for name in GameName._fields}
    wrong = [name for name, value in names.items() if not isinstance(value, str)]
    wrong += [name for name in ("first_episode", "episodes") if type(facts.get(name)) is not int]
    if wrong:
        raise ValueError(f"{path}: {wrong[0]}={facts.get(wrong[0])!r}; it is not as it was written")
    name = GameName(**{field: str(value) for field, value in names.items()})
    game = Game.of(system or _known(name, path), name.setup, name.condition)
    if game.name != name:
        raise ValueError(f"{path} is of {', '.join(name)}; system={system!r} is {game.name.env_id}")
    seeds = seeds_of(facts["first_episode"], facts["episodes"])
    present = game_hash(game.source)
    if facts.get("game_hash") != present:
        raise ValueError(
            f"the records in {folder} are of other code or settings of the system, the simulation "
            f"or the scores (hash {str(facts.get('game_hash'))[:6]}) than the present one "
            f"({present[:6]}); write them anew with pinnobs episodes"
        )
    return game, seeds


def _known(name: GameName, path: Path) -> str:
    """Return the env id of a game, and say how to give a system that is not known.

    Raises:
        ValueError: in one line, if it is not known.
    """
    import gymnasium as gym

    if name.env_id not in gym.registry:
        raise ValueError(
            f"{path} is of {name.env_id}, which is not known here; give the system by "
            "--system module:Class"
        )
    return name.env_id
