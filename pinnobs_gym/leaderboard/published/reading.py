"""Reading of published rows, alone or together with rows files."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.published import manifest
from pinnobs_gym.leaderboard.published.columns import unpacked
from pinnobs_gym.leaderboard.published.manifest import Manifest, PublishedRows
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.row_format import checked
from pinnobs_gym.scoring.rows import Row, Stored

PUBLISHED = Path("published")
"""What stands for the published rows where a rows file is expected."""


def present(folder: Path | None = None) -> Manifest:
    """Return what is published.

    Args:
        folder: the folder; that of the package if None.

    Raises:
        ValueError: in one line, if nothing is, or the list is damaged or of another version.
    """
    found = Manifest.read(folder or manifest.FOLDER)
    if found is None:
        raise ValueError(
            "this copy of pinnobs-gym holds no published results; make publish makes them"
        )
    return found


def rows_in(published: Manifest, entries: Iterable[PublishedRows]) -> list[Row]:
    """Return the rows of some of the published files.

    Raises:
        ValueError: in one line, if a file is not the one that was published, or holds no rows of
            this version.
    """
    return [row for entry in entries for row in _rows_of(published, entry)]


def published_floors(games: Iterable[GameName], folder: Path | None = None) -> list[Row]:
    """Return the published rows of the floors of some games; none if nothing is published.

    Args:
        games: the games.
        folder: the folder; that of the package if None.

    Raises:
        ValueError: in one line, if what is published is damaged or of another version.
    """
    published = Manifest.read(folder or manifest.FOLDER)
    if published is None:
        return []
    wanted = set(games)
    entries = [entry for entry in published.rows if entry.floor and entry.game in wanted]
    return rows_in(published, entries)


def load_rows(paths: Sequence[Path]) -> Stored:
    """Load rows files as one; the path ``published`` stands for the published rows.

    Raises:
        ValueError: in one line, as `pinnobs_gym.scoring.rows.load_all` does.
    """
    files = [path for path in paths if path != PUBLISHED]
    own = rows.load_all(files)
    if len(files) == len(paths):
        return own
    published = present()
    shipped = Stored(rows_in(published, published.rows), [])
    # Own rows first: of an episode in both they have all digits.
    return rows.merge([(Path(", ".join(map(str, files))), own), (PUBLISHED, shipped)])


def _rows_of(published: Manifest, entry: PublishedRows) -> list[Row]:
    """Return the rows of one file: a line per run, of its number of rows and its columns."""
    path = published.folder / entry.file
    content = published.content(entry)
    found: list[Row] = []
    try:
        for line in content.splitlines():
            run = json.loads(line)
            found += unpacked(run["columns"], run["rows"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} holds no published rows: {error}") from None
    # Several rows share the objects of what they have in common; the check makes new ones only
    # where it restores infinities.
    return [checked(path, number, b"", row) for number, row in enumerate(found, 1)]
