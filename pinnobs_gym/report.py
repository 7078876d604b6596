"""Pages and files for people: a system's env page, and estimates as a table and a picture."""

from __future__ import annotations

import csv
import inspect
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pinnobs_gym.conditions import CONDITIONS, fitting
from pinnobs_gym.docstrings import field_docs
from pinnobs_gym.env import NOT_FINITE_REWARD
from pinnobs_gym.estimator import Estimates
from pinnobs_gym.record import Record
from pinnobs_gym.system import System, vector

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def page(cls: type[System], env_id: str) -> str:
    """The env page of a system in Markdown, under Gymnasium's headings: its docstring, and what
    follows from its attributes."""
    system, setup = cls.configured()
    number_of_actions = f"{setup.num_steps} actions, {setup.duration:g} s at {setup.dt:g} s"
    parts = [
        f"# {cls.__name__}: `{env_id}`\n",
        inspect.getdoc(cls) or "",
        "\n## Action Space\n",
        f"The estimate x̂(k|k), `Box(({system.nx},), float32)`. Bounds are for sampling; what is "
        "given is scored, never clipped.\n",
        _table(
            ("", "state", "unit", "bound", "scale"),
            [
                (i, name, _unit(cls, name), f"±{bound:g}", f"{scale:g}")
                for i, (name, bound, scale) in enumerate(
                    zip(system.state_names, _bound(system), system.scale, strict=True)
                )
            ],
        ),
        "\n## Observation Space\n",
        f"`Box(({system.ny + system.nu + 1},), float32)`: the outputs, the inputs, then time.\n",
        _table(
            ("", "name", "unit"),
            [
                (i, name, _unit(cls, name))
                for i, name in enumerate((*system.output_names, *system.input_names, "t/T"))
            ],
        ),
        "\n## Reward\n",
        "−mean(((x̂ − x)/scale)²) of the true state behind the observation that the action answers; "
        f"{NOT_FINITE_REWARD:g} for an action that is not finite.\n",
        "## Starting State\n",
        _setups(cls),
        "\n## Episode End\n",
        f"Truncated after {number_of_actions} in the `benchmark` setup; terminated only by an "
        "action that is not finite.\n",
        "## Arguments\n",
        f'`gym.make("{env_id}", setup="benchmark", condition="nominal", dt=None, duration=None, '
        "noise_std=None, parameters=None, render_mode=None)`. Reset options: `x0`, `xhat0`. "
        "Parameters:\n",
        _parameters(cls),
        "\n## Conditions\n",
        "Names for `condition`, joined by `+`; `estimators told` is what is known of it.\n",
        _table(
            ("name", "what changes", "estimators told"),
            [(n, CONDITIONS[n].summary, CONDITIONS[n].told) for n in fitting(system, setup)],
        ),
        "\n## Version History\n",
        f"v{cls.version}: first version.",
    ]
    return "\n".join(parts) + "\n"


def _bound(system: System) -> Sequence[float]:
    return system.state_bound or tuple(10 * scale for scale in system.scale)


def _unit(cls: type[System], name: str) -> str:
    return cls.units.get(name, "")


def _setups(cls: type[System]) -> str:
    lines = []
    for name in cls.setups:
        system, setup = cls.configured(name)
        low, high, xhat0, P0_std = (
            vector(getattr(setup, part), system.nx, part).tolist()
            for part in ("x0_low", "x0_high", "xhat0", "P0_std")
        )
        if setup.fixed_x0:
            start = f"x₀ = {low}"
        else:
            start = f"x₀ uniform in {low} to {high}, where admissible"
        noise = vector(setup.noise_std, system.ny, "noise_std").tolist()
        lines.append(
            f"- `{name}`: {start}; x̂₀ = {xhat0}, √P₀ = {P0_std}; output "
            f"noise {noise}" + (f"; {dict(setup.parameters)}" if setup.parameters else "")
        )
    note = inspect.getdoc(cls.admissible) or ""
    return "\n".join([*lines, f"\nAdmissible: {note}" if "admissible" in vars(cls) else ""])


def _parameters(cls: type[System]) -> str:
    system = cls()
    described = field_docs(cls)
    rows = [
        (name, f"{value}", " ".join(described.get(name, "").split()))
        for name, value in system.parameters.items()
    ]
    return _table(("name", "default", "meaning"), rows) if rows else "none."


def _table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(map(str, row)) + " |" for row in rows])


def write_estimates(path: Path, system: System, record: Record, estimates: Estimates) -> None:
    """Write the first episode's estimates as CSV: t, a column per state, and where there are
    covariances a column ``<state>_std`` of their standard deviations."""
    header = ["t", *system.state_names]
    columns = [record.t[:, None], estimates.xhat[0]]
    if estimates.P is not None:
        header += [f"{name}_std" for name in system.state_names]
        variance = np.diagonal(estimates.P[0], axis1=1, axis2=2)
        columns.append(np.sqrt(np.maximum(variance, 0)))
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(np.concatenate(columns, axis=1).tolist())


def write_figure(path: Path, figure: Figure) -> None:
    """Write a picture; the ending says which kind."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=120, format=path.suffix[1:])


class replacing:
    """A context whose value is a temporary path that becomes the given one if all goes well, so
    that a file is whole or not there."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._temporary = path.with_name(f".{path.name}.{os.getpid()}")

    def __enter__(self) -> Path:
        """The temporary path.

        Raises:
            ValueError: in one line, if nothing can be written there.
        """
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._temporary.touch()
        except OSError as error:
            raise ValueError(f"cannot write {self._path}: {error}") from None
        return self._temporary

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            os.replace(self._temporary, self._path)
        else:
            self._temporary.unlink(missing_ok=True)


def check_writable(folder: Path) -> None:
    """Make a folder.

    Raises:
        ValueError: in one line, if nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".write-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"cannot write to folder {folder}: {error}") from None
