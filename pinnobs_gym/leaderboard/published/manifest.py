"""The list of what is published: files with sizes and hashes, games, trainings, versions, date."""

from __future__ import annotations

import hashlib
import json
import lzma
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.estimation.hints import as_tuple, check_field, field_hints
from pinnobs_gym.files import replacing
from pinnobs_gym.files.archive import Damaged, json_of
from pinnobs_gym.files.seal import sealed, unsealed

FOLDER = Path(__file__).parent
"""The folder of the results that ship with the package."""
FORMAT = 1
"""Version of the format of published results."""
CURVES = "curves"
"""The folder of errors over time, as `pinnobs_gym.scoring.curves` writes it."""
_NAME = "published.json"
_LARGEST = 2**28
"""Largest number of bytes of a file when it is unpacked."""


@dataclass(frozen=True, kw_only=True)
class PublishedFile:
    """A published file, compressed."""

    file: str
    """Its path in the folder."""
    size: int
    """Number of bytes."""
    sha256: str
    """Its hash."""
    env_id: str
    setup: str
    condition: str

    @property
    def game(self) -> GameName:
        """The game of the rows, or of the training."""
        return GameName(self.env_id, self.setup, self.condition)


@dataclass(frozen=True, kw_only=True)
class PublishedRows(PublishedFile):
    """The rows of a game."""

    game_hash: str
    """Hash of the game's code and settings; see `pinnobs_gym.scoring.provenance.game_hash`."""
    rows: int
    """Number of scored episodes."""
    floor: bool = False
    """Whether these are the rows of the floor of errors, and of nothing else."""


@dataclass(frozen=True, kw_only=True)
class PublishedTraining(PublishedFile):
    """The file of a trained estimator."""

    estimator: str
    """Name of the estimator in rows, with its recipe."""
    trainer: str
    """Name of the trainer."""
    recipe: str
    """Digest of the trainer's settings."""
    model: str
    """Digest of the parameters of system and setup."""
    code: str
    """Hash of the training's code; see `pinnobs_gym.scoring.provenance.training_code`."""
    seed: int | None = None
    """Seed of the episode that it was trained on; None for a training that serves all episodes."""
    record: str = ""
    """Hash of the record of this episode."""
    estimator_code: str = ""
    """The field of the rows of a training on one episode."""
    estimator_hash: str = ""
    """The same."""


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What a folder of published results holds."""

    folder: Path
    date: str
    """When the results were packed (UTC)."""
    versions: Mapping[str, str]
    """Versions of Python and of the packages."""
    training_seeds: tuple[int, ...]
    """Training seeds of the rows; the trained files are those of the first."""
    rows: tuple[PublishedRows, ...]
    trained: tuple[PublishedTraining, ...]
    curves: tuple[PublishedFile, ...] = ()
    """Errors over time of the floors, in the folder `CURVES`."""

    @classmethod
    def read(cls, folder: Path) -> Manifest | None:
        """Return what is published in a folder, None if nothing is.

        Raises:
            ValueError: in one line, if the list is damaged or of another version.
        """
        path = folder / _NAME
        try:
            content = json_of(path)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise ValueError(f"cannot read {path}: {error.strerror or error}") from None
        except Damaged:
            content = None
        if not isinstance(content, dict):
            raise ValueError(f"{path} is damaged: it is no JSON object")
        if content.get("format") != FORMAT:
            raise ValueError(
                f"{path} is of another version of pinnobs-gym; this one reads format {FORMAT}: "
                "install the package again"
            )
        try:
            content = unsealed(content)
            del content["format"]
            parts = {
                name: tuple(_made(kind, entry) for entry in content.pop(name))
                for name, kind in _KINDS.items()
            }
            return _made(cls, content | parts | {"folder": folder})
        except (Damaged, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} is damaged: {error}") from None

    def write(self) -> None:
        """Write the list into the folder.

        Raises:
            ValueError: in one line, if it cannot be written.
        """
        content = {"format": FORMAT, **asdict(self)}
        del content["folder"]
        with replacing(self.folder / _NAME, durable=True) as temporary:
            text = json.dumps(sealed(content), indent=1)
            temporary.write_text(text + "\n", encoding="utf-8")

    def content(self, entry: PublishedFile) -> bytes:
        """Return the content of a published file, after a check of its size and hash.

        Raises:
            ValueError: in one line, if it is missing or is not the file that was published.
        """
        path = self.folder / entry.file
        try:
            data = path.read_bytes()
        except OSError as error:
            raise ValueError(f"cannot read {path}: {error.strerror or error}") from None
        if len(data) != entry.size:
            raise ValueError(
                f"{path} has {len(data)} bytes; expected {entry.size} of the published file: "
                "install the package again"
            )
        if hashlib.sha256(data).hexdigest() != entry.sha256:
            raise ValueError(
                f"{path} is not the published file: its SHA-256 differs; install the package again"
            )
        try:
            content = lzma.LZMADecompressor().decompress(data, _LARGEST + 1)
        except lzma.LZMAError as error:
            raise ValueError(f"{path} is damaged: {error}") from None
        if len(content) > _LARGEST:
            raise ValueError(f"{path} has more than {_LARGEST} bytes when it is unpacked")
        return content


_KINDS = {"rows": PublishedRows, "trained": PublishedTraining, "curves": PublishedFile}


def _made(kind: Any, content: Any) -> Any:
    """Return an object of a dataclass from its fields.

    Raises:
        TypeError: in one line, if a field is missing or unknown.
        ValueError: in one line, if a value is not of its field's type.
    """
    if not isinstance(content, dict):
        raise TypeError(f"{kind.__name__} is no JSON object")
    hints = field_hints(kind)
    unknown = sorted(content.keys() - {f.name for f in fields(kind)})
    if unknown:
        raise TypeError(f"unknown field {unknown[0]!r} of {kind.__name__}")
    values = {name: as_tuple(value, hints[name]) for name, value in content.items()}
    for name, value in values.items():
        check_field(name, value, hints[name])
    return kind(**values)
