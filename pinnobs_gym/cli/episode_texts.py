"""The texts in a folder of episodes: what the records are, the model, and how to have estimates
scored."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

from pinnobs_gym.cli.model_code import equations_text, matlab_model
from pinnobs_gym.cli.system_page import bounded, field_docs, repeating
from pinnobs_gym.leaderboard.grid import markdown_table
from pinnobs_gym.scoring.episode_folder import GAME_FILE
from pinnobs_gym.scoring.issue import Issue
from pinnobs_gym.simulation.conditions import CONDITIONS
from pinnobs_gym.simulation.system import System
from pinnobs_gym.systems import SYSTEMS


def texts_of(issue: Issue, facts: Mapping[str, Any]) -> dict[str, str]:
    """Return the texts of a folder by file: ``README.md`` and, where the equations can be written
    in MATLAB, ``model.m``.

    Args:
        issue: what the folder has.
        facts: `Issue.facts`.
    """
    system = issue.game.source.system
    constants = {
        "states": tuple(facts["states"]),
        "xhat0": [[value] for value in facts["prior_mean"]],
        "P0": facts["prior_covariance"],
        "R": facts["output_noise_covariance"],
        "Q": facts["process_noise_covariance"],
        "dt": facts["sample_time"],
    }
    code = matlab_model(system, constants)
    texts = {} if code is None else {"model.m": code}
    return {"README.md": _readme(issue, facts, [*texts]), **texts}


def _readme(issue: Issue, facts: Mapping[str, Any], others: Sequence[str]) -> str:
    system, (env_id, setup, condition) = issue.game.source.system, issue.game.name
    last = facts["first_episode"] + facts["episodes"] - 1
    parts = [
        f"# Records of {type(system).__name__}",
        f"{facts['episodes']} episodes ({facts['first_episode']} to {last}) of `{env_id}`, setup "
        f"`{setup}`, condition `{condition}`, each with {facts['num_samples']} samples at "
        f"{facts['sample_time']:g} {_time(system, facts['sample_time'])}.",
        "## Files",
        _files(issue, others),
        "## Task",
        _task(issue),
        "## Model",
        inspect.getdoc(type(system)) or "",
        _equations(system, others),
        _names(system, facts),
        *(line.strip() for line in repeating(system, system.output_names, system.output_period)),
        *(line.strip() for line in repeating(system, system.state_names, system.state_period)),
        *(line.strip() for line in bounded(system)),
        _parameters(system),
        "## What every estimator is told",
        _known(system, facts),
        _condition(condition),
        "## Scores",
        _scores(system, facts),
    ]
    return "\n\n".join(part.strip() for part in parts if part.strip()) + "\n"


def _time(system: System, length: float) -> str:
    return "step" if system.discrete and length == 1 else system.time_unit


def _files(issue: Issue, others: Sequence[str]) -> str:
    described = {
        "records": "the outputs and inputs; an empty output is missing",
        "truth": "the true states, for training: these episodes are never scored",
    }
    lines = []
    for name, columns in issue.tables.items():
        listed = ", ".join(f"`{column}`" for column in columns)
        lines.append(f"- `{name}`: {described[name.partition('.')[0]]}. Columns: {listed}.")
    lines += [f"- `{name}`: the model as code of MATLAB and Octave." for name in others]
    lines.append(f"- `{GAME_FILE}`: all numbers of this page with all their digits.")
    return "\n".join(lines)


def _task(issue: Issue) -> str:
    """Return what is to be brought back, and how it is scored."""
    system = issue.game.source.system
    states = ",".join(system.state_names)
    stds = ",".join(f"{name}_std" for name in system.state_names)
    known = type(system).__name__ in SYSTEMS.sources
    own = "" if known else f" --system {issue.game.system}"
    if issue.with_truth:
        return (
            "Train or try an estimator on these records and true states. For scores, write other "
            "records: `pinnobs episodes` without `--with-truth`."
        )
    return (
        "Estimate the states at every sample of every episode. An online estimate at a sample may "
        "use the outputs up to and including that sample, and no later ones.\n\n"
        f"Write a file `estimates.csv` with the header\n\n    episode,t,{states}\n\n"
        "a line for each line of the records, and all digits of the numbers. Standard deviations "
        f"of the estimates are optional: `{stds}`, all or none. `inf` marks an estimate that has "
        "diverged; empty cells and NaN are refused. Then, with the file in this folder,\n\n"
        f'    pinnobs score estimates.csv --name "my observer" --track online{own}'
    )


def _equations(system: System, others: Sequence[str]) -> str:
    try:
        text = equations_text(system)
    except ValueError as error:
        return f"The equations as text are those above alone ({error})."
    indented = "\n".join(f"    {line}" for line in text.splitlines())
    where = ", as in `model.m`" if others else ""
    return f"The equations, taken from the code{where}:\n\n{indented}"


def _names(system: System, facts: Mapping[str, Any]) -> str:
    rows = []
    kinds = (
        ("state", system.state_names),
        ("output", system.output_names),
        ("input", system.input_names),
    )
    scales = dict(zip(system.state_names, facts["scale"], strict=True))
    for kind, names in kinds:
        for name in names:
            scale = f"{scales[name]:g}" if kind == "state" else ""
            rows.append((kind, name, system.units.get(name, ""), scale))
    return markdown_table(("", "name", "unit", "scale of errors"), rows)


def _parameters(system: System) -> str:
    described = field_docs(type(system))
    rows = [
        (name, f"{value!r}", " ".join(described.get(name, "").split()))
        for name, value in system.parameters.items()
    ]
    if not rows:
        return "There are no parameters."
    return "Parameters:\n\n" + markdown_table(("name", "value", "meaning"), rows)


def _known(system: System, facts: Mapping[str, Any]) -> str:
    noise, time = facts["process_noise_covariance"], "step" if system.discrete else "second"
    between = "linearly interpolated" if system.input_hold == "linear" else "held from the last one"
    at = " at t = 0; it depends on time" if facts["noise_depends_on_time"] else ""
    lines = [
        "- The initial state has the mean x̂₀ and the covariance P₀ (rows):",
        f"  - x̂₀ = {facts['prior_mean']}",
        f"  - P₀ = {facts['prior_covariance']}",
        "- The output noise is white and Gaussian, with the covariance R = "
        f"{facts['output_noise_covariance']}{at}.",
        f"- The model has process noise, whose covariance grows per {time} by Q = {noise}{at}."
        if any(map(any, noise))
        else "- The model has no process noise.",
    ]
    if system.nu and system.measured_input:
        lines.append(f"- Inputs between two samples are {between}.")
    elif system.nu:
        lines.append("- Inputs are known at any time, by the equations above.")
    return "\n".join(lines)


def _condition(name: str) -> str:
    """Return what the condition changes, and what is known of it."""
    if name == "nominal":
        return "The plant is the model: nothing else differs."
    lines = [
        f"- `{part}`: {CONDITIONS[part].summary}. Known to estimators: "
        f"{CONDITIONS[part].known_to_estimators}."
        for part in name.split("+")
        if part in CONDITIONS
    ]
    return "\n".join([f"What the condition `{name}` changes:", "", *(lines or [f"- {name}"])])


def _scores(system: System, facts: Mapping[str, Any]) -> str:
    end = f"{facts['transient_end']:g} {_time(system, facts['transient_end'])}"
    text = (
        "NRMSE: the root mean square of (estimate − truth)/scale over the states and the samples "
        f"of a window. The transient window lasts from the second sample to {end} after the first, "
        "the steady window from there to the end. An episode has diverged if the NRMSE of its last "
        "25 % is above 0.2, or an estimate is not finite."
    )
    own = inspect.getdoc(type(system).observable) if "observable" in vars(type(system)) else ""
    return f"{text} Errors that count: {own}" if own else text
