"""What the page of a system says of its Jacobians, of compiled code, and of what its outputs
tell."""

from __future__ import annotations

import numpy as np

from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.leaderboard.grid import markdown_table
from pinnobs_gym.simulation.derivatives import origin
from pinnobs_gym.simulation.kernels.plant_library import why_not
from pinnobs_gym.simulation.observability import TRAJECTORIES, Observability, observability
from pinnobs_gym.simulation.system import Setup, System, initial_states

_MOST_STATES = 100
"""Number of states beyond which the page would take minutes."""
_HARDLY = np.sqrt(0.5)
"""Part of the prior's standard deviation above which the outputs tell less than the prior."""


def jacobians(system: System, setup: Setup) -> str:
    """Return a sentence on where the Jacobians of f and h come from."""
    x = initial_states(system, setup, 1)
    t = np.zeros(1)
    u = np.asarray(system.input(t))
    f, h = (origin(system, name, t, x, u) for name in ("f", "h"))
    if f == h and not f.startswith("found"):
        if f == "written by hand":
            return "The Jacobians of f and h are written by hand."
        return "f and h can be traced: their Jacobians are derived from the equations."
    return f"The Jacobian of f is {f}; that of h is {h}."


def compiled(system: System) -> str:
    """Return which estimators are compiled for a plant, and otherwise why not; see
    `pinnobs_gym.simulation.kernels`."""
    kinds: dict[str, list[str]] = {}
    for name, cls in ESTIMATORS.classes().items():
        template = getattr(cls, "template", "")
        if template:
            kinds.setdefault(template, []).append(name)
    lines = []
    for template, names in kinds.items():
        reason = why_not(system, template)
        how = f"computed in NumPy: {reason}" if reason else "compiled"
        lines.append(f"- {', '.join(f'`{name}`' for name in names)}: {how}")
    rest = "- all others: computed in NumPy, but for filters of these kinds within them"
    return "\n".join(["Compiled code:\n", *lines, rest])


def told(system: System, setup: Setup) -> str:
    """Return what the outputs of an episode tell of the initial state, as a table and sentences;
    see `pinnobs_gym.simulation.observability`."""
    if system.nx > _MOST_STATES:
        return f"This is not computed for more than {_MOST_STATES} states."
    found = observability(system, setup)
    left = np.median(found.left, axis=0)
    units = [system.units.get(name, "") for name in system.state_names]
    rows = [
        (name, unit, f"{std:.3g}", _remainder(std, part))
        for name, unit, std, part in zip(
            system.state_names, units, found.prior_std, left, strict=True
        )
    ]
    header = ("state", "unit", "standard deviation of the prior", "what the outputs leave of it")
    if not any(units):
        header, rows = (header[0], *header[2:]), [(row[0], *row[2:]) for row in rows]
    return "\n".join([markdown_table(header, rows), "", _sentences(system, found, left)])


def _remainder(std: float, part: float) -> str:
    """Return what is left of a standard deviation, given which part it is."""
    if np.isnan(part):
        return "known"
    return f"{std * part:.3g} ({100 * part:.3g} %)" if part > 1e-6 else "less than a millionth"


def _sentences(system: System, found: Observability, left: np.ndarray) -> str:
    """Return the rank and the condition number of the Gramian, and the states that are not or
    hardly seen, given what is left of each state (nx,)."""
    nx, low = system.nx, int(found.rank.min())
    full = found.condition[found.rank == nx]
    parts = [
        f"The initial state of an episode, given all its outputs: the median of {TRAJECTORIES} "
        f"trajectories at which the plant without process noise is linearised. The observability "
        f"Gramian has rank {low} of {nx}"
        + (f" along the worst and {found.rank.max()} along the best" if np.ptp(found.rank) else "")
    ]
    if len(full):
        median, worst = np.median(full), full.max()
        parts[0] += f", and the condition number {median:.2g} (at worst {worst:.2g})"
    parts[0] += " in scaled states."
    if found.unseen:
        parts.append(f"The outputs never see {_listed(found.unseen)}.")
    if found.mixed:
        parts.append(
            f"The outputs see {_listed(found.mixed)} only in combination with other states."
        )
    named = {*found.unseen, *found.mixed}
    hardly = [
        name
        for name, part in zip(system.state_names, left, strict=True)
        if part > _HARDLY and name not in named
    ]
    if hardly:
        parts.append(f"The outputs tell less than the prior of {_listed(hardly)}.")
    return " ".join(parts)


def _listed(names: tuple[str, ...] | list[str]) -> str:
    """Return names as code, joined."""
    quoted = [f"`{name}`" for name in names]
    return " and ".join([", ".join(quoted[:-1]), quoted[-1]] if len(quoted) > 1 else quoted)
