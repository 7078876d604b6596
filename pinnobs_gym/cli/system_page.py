"""The page of a system: its equations, spaces and setups as text."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from math import isfinite
from types import ModuleType
from typing import Any

from docstring_parser import parse_from_object

from pinnobs_gym.cli.agent_section import for_agents
from pinnobs_gym.cli.told_section import compiled, jacobians, told
from pinnobs_gym.envs.arguments import NOT_FINITE_REWARD
from pinnobs_gym.leaderboard.grid import markdown_table
from pinnobs_gym.simulation.conditions import CONDITIONS, fitting
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.model import described
from pinnobs_gym.simulation.noise import noise_std
from pinnobs_gym.simulation.residual import Periods
from pinnobs_gym.simulation.system import Setup, System


def page(cls: type[System], env_id: str) -> str:
    """Return the env page of a system in Markdown under Gymnasium's headings, from its docstring
    and attributes."""
    system, setup = cls.configured()
    number_of_actions = (
        f"{setup.num_steps} actions, {_time(system, setup.duration)} at {_time(system, setup.dt)}"
    )
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
        *repeating(system, system.state_names, system.state_period),
        *bounded(system),
        "\n## Observation Space\n",
        f"`Box(({system.ny + system.nu + 1},), float32)`: the outputs, the inputs, then time. "
        "Under a condition that loses outputs, the latest present value stands for a missing one, "
        "and a mask follows the outputs: 1 for present, 0 for missing.\n",
        _table(
            ("", "name", "unit"),
            [
                (i, name, _unit(cls, name))
                for i, name in enumerate((*system.output_names, *system.input_names, "t/T"))
            ],
        ),
        *repeating(system, system.output_names, system.output_period),
        "\n## Motion of the Model\n",
        _motion(system, setup),
        jacobians(system, setup),
        f"\n{compiled(system)}",
        "\n## What the Outputs Tell\n",
        told(system, setup),
        "\n## Reward\n",
        "−mean(((x̂ − x)/scale)²) of the true state behind the observation that the action answers; "
        f"{NOT_FINITE_REWARD:g} for an action that is not finite.\n",
        "## For Agents\n",
        for_agents(cls, env_id),
        "\n## Starting State\n",
        _setups(cls),
        "\n## Episode End\n",
        f"Truncated after {number_of_actions} in the `benchmark` setup; terminated only by an "
        "action that is not finite.\n",
        "## Arguments\n",
        f'`gym.make("{env_id}", setup="benchmark", condition="nominal", action_mode="estimate", '
        'reward="error", stack_outputs=1, dt=None, duration=None, noise_std=None, '
        "parameters=None, render_mode=None)`. Reset options: `x0`, `xhat0`.\n",
        _parameters(cls),
        "\n## Conditions\n",
        "Names for `condition`, joined by `+`; `known to estimators` is what is known of it.\n",
        _table(
            ("name", "what changes", "known to estimators"),
            [
                (name, CONDITIONS[name].summary, CONDITIONS[name].known_to_estimators)
                for name in fitting(system, setup)
            ],
        ),
        "\n## Version History\n",
        f"v{cls.version}: first version.",
    ]
    return "\n".join(parts) + "\n"


def _time(system: System, length: float) -> str:
    """Return a length of time with its unit, the step for a map."""
    unit = system.time_unit
    return f"{length:g} {'step' if system.discrete and length == 1 else unit}"


def _bound(system: System) -> Sequence[float]:
    return system.state_bound or tuple(10 * scale for scale in system.scale)


def _motion(system: System, setup: Setup) -> str:
    """Return in a sentence how the model moves between samples, and what the inputs of a log are
    there."""
    moves = described(system, setup.dt)
    if not system.nu:
        return f"{moves[0].upper()}{moves[1:]}.\n"
    held = "held from the last sample on"
    joined = "joined by straight lines"
    between = held if system.input_hold == "previous" else joined
    whose = "inputs, drawn anew in each episode," if system.draws_input else "inputs of a log"
    return f"{moves[0].upper()}{moves[1:]}; the {whose} are {between}.\n"


def _unit(cls: type[System], name: str) -> str:
    return cls.units.get(name, "")


def repeating(system: System, names: Sequence[str], periods: Periods | None) -> list[str]:
    """Return a line about the states or outputs that repeat, if there are any."""
    found = [
        f"`{name}` repeats every {period:.6g} {_unit(type(system), name)}".rstrip()
        for name, period in zip(names, periods or [None] * len(names), strict=True)
        if period is not None
    ]
    return [f"\n{'; '.join(found)}: whole periods do not count."] if found else []


def bounded(system: System) -> list[str]:
    """Return a line about the states that have bounds, if there are any."""
    box, found = system.state_box, []
    if box is None:
        return []
    for name, low, high in zip(system.state_names, box.low, box.high, strict=True):
        unit = _unit(type(system), name)
        sides = [
            f"{what} {side:.6g} {unit}".rstrip()
            for what, side in (("at least", low), ("at most", high))
            if isfinite(side)
        ]
        if sides:
            found.append(f"`{name}` is {' and '.join(sides)}")
    return [f"\n{'; '.join(found)}: the plant and all estimates stay within these bounds."]


def _rounded(values: Any) -> Any:
    """Return numbers, or rows of them, with six digits."""
    if isinstance(values, list | tuple):
        return [_rounded(each) for each in values]
    return float(f"{values:.6g}")


def _setups(cls: type[System]) -> str:
    lines, time = [], "step" if cls.discrete else "√s"
    for name in cls.setups:
        system, setup = cls.configured(name)
        xhat0, P0 = (_rounded(moments.tolist()) for moments in prior_moments(system, setup))
        law = setup.start(system.nx)
        start = law.sentence + ("" if law.fixed else ", where admissible")
        noise = noise_std(setup.noise_std, system.ny, "noise_std")
        process = noise_std(setup.process_noise, system.nx, "process_noise")
        lines.append(
            f"- `{name}`: {start}; x̂₀ = {xhat0}, P₀ = {P0}; output "
            f"noise {_rounded(noise.tolist())}"
            + (f"; process noise {_rounded(process.tolist())} per {time}" if process.any() else "")
            + "".join(f"; `{name}` = {value:g}" for name, value in setup.parameters.items())
        )
        if setup.poor_prior is not None:
            poor = setup.poor_prior
            xhat0, P0 = _rounded(list(poor.xhat0)), _rounded([list(row) for row in poor.P0])
            lines[-1] += f"; under `poor_prior`, x̂₀ = {xhat0}, P₀ = {P0}"
    note = inspect.getdoc(cls.admissible) or ""
    return "\n".join([*lines, f"\nAdmissible: {note}" if "admissible" in vars(cls) else ""])


def _parameters(cls: type[System]) -> str:
    system = cls()
    described = field_docs(cls)
    rows = [
        (
            name,
            f"{value:.6g}" if type(value) in (int, float) else f"{value}",
            " ".join(described.get(name, "").split()),
        )
        for name, value in system.parameters.items()
    ]
    if not rows:
        return "The plant has no parameters."
    return "Parameters:\n\n" + _table(("name", "default", "meaning"), rows)


def _table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a table in Markdown, of cells in Markdown, without columns of units that are empty."""
    lines = [[str(cell) for cell in row] for row in rows]
    kept = [i for i, name in enumerate(header) if name != "unit" or any(line[i] for line in lines)]
    return markdown_table([header[i] for i in kept], [[line[i] for i in kept] for line in lines])


def field_docs(cls: type) -> dict[str, str]:
    """Return the docstring below each attribute of a class, including inherited ones."""
    docs: dict[str, str] = {}
    for each in reversed(cls.__mro__[:-1]):
        docs |= variable_docs(each)
    return docs


def variable_docs(where: ModuleType | type) -> dict[str, str]:
    """Return the docstring below each variable of a module, or of a class's own body."""
    return {
        p.arg_name: inspect.cleandoc(p.description or "")
        for p in parse_from_object(where).params
        if p.args[0] == "attribute"
    }
