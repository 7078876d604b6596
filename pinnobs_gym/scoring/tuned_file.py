"""Files of tuned settings, one for each system, in the folder of its module.

The file of the class ``ReverseDuffing`` is ``ReverseDuffing.tuned.json``, a list with an entry for
each setup and estimator. An entry has a digest of its values: settings that were changed since do
not have the error that was found for them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

from pinnobs_gym.estimation.hints import check_field, field_hints
from pinnobs_gym.files import file_name, holding, replacing
from pinnobs_gym.files.archive import Damaged, json_of
from pinnobs_gym.files.seal import SEAL, sealed, unsealed
from pinnobs_gym.simulation.system import System


@dataclass(frozen=True)
class TunedEntry:
    """The settings found for one estimator on one system."""

    env_id: str
    """Env id of the system; settings of another version of the system are not used."""
    setup: str
    """Setup whose episodes were used."""
    estimator: str
    """Name of the estimator, or ``module:Class`` of one that the package does not have."""
    settings: Mapping[str, Any]
    """The settings that were searched, by name."""
    error: float
    """Geometric mean NRMSE with these settings; see `pinnobs_gym.scoring.tuning.Search.error`."""
    default_error: float
    """The same with the default settings."""
    trials: int
    """Number of settings that were tried."""
    episodes: int
    """Number of episodes of each trial."""
    condition: str
    """Condition of these episodes."""
    versions: Mapping[str, str]
    """Versions as in rows."""
    date: str
    """Date and time (UTC) as in rows."""

    @property
    def key(self) -> tuple[str, str, str]:
        """What identifies an entry in a file."""
        return self.env_id, self.setup, self.estimator


def path_of(system: type[System]) -> Path:
    """Return the file for the tuned settings of a system, whether it exists or not.

    Raises:
        ValueError: in one line, if the system's class is not in a file.
    """
    file = getattr(sys.modules.get(system.__module__), "__file__", None)
    if file is None:
        raise ValueError(
            f"system {system.__name__} is defined in {system.__module__}, which is no file; "
            "tuned settings are stored beside the file of a system"
        )
    return Path(file).with_name(f"{file_name(system.__name__)}.tuned.json")


def read(path: Path) -> tuple[TunedEntry, ...]:
    """Return the entries of a file; none if it does not exist.

    Raises:
        ValueError: in one line that names the file, if it is damaged or cannot be read.
    """
    try:
        found = path.stat()
    except OSError:
        return ()
    return _read(path, found.st_mtime_ns, found.st_size)


def store(system: type[System], entry: TunedEntry) -> Path:
    """Write an entry to the file of its system, in place of an earlier one of the same setup and
    estimator and of those of other versions of the system. Returns the file.

    Raises:
        ValueError: in one line, if the file is damaged or cannot be written.
    """
    path = path_of(system)
    try:
        with holding(path):
            kept = [e for e in read(path) if e.env_id == entry.env_id and e.key != entry.key]
            entries = [sealed(asdict(each)) for each in sorted([*kept, entry], key=lambda e: e.key)]
            with replacing(path, durable=True) as temporary:
                text = json.dumps(entries, indent=2, ensure_ascii=False, allow_nan=False)
                temporary.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise ValueError(f"cannot write {path}: {error}") from None
    return path


@lru_cache(maxsize=64)
def _read(path: Path, _changed: int, _size: int) -> tuple[TunedEntry, ...]:
    """Read a file; time of change and size tell whether it is the one that was read before."""
    try:
        content = json_of(path)
        if not isinstance(content, list):
            raise ValueError("expected a list of entries")
        return tuple(map(_entry, content))
    except (OSError, ValueError, Damaged) as error:
        raise ValueError(f"cannot read tuned settings from {path}: {error}") from None


def _entry(content: Any) -> TunedEntry:
    """Return an entry from its content in a file.

    Raises:
        ValueError: in one line, if it lacks a field, or has another one, or one of a wrong type.
        Damaged: if it is not as it was written.
    """
    names = {SEAL, *(field.name for field in fields(TunedEntry))}
    if not isinstance(content, dict) or content.keys() != names:
        found = sorted(content) if isinstance(content, dict) else content
        raise ValueError(f"an entry with {found!r:.200}; expected {', '.join(sorted(names))}")
    for name, hint in field_hints(TunedEntry).items():
        check_field(name, content[name], hint)
    return TunedEntry(**unsealed(content))
