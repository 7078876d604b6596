"""The texts that stand for the places of exported files, such as their names and comments."""

from __future__ import annotations

from importlib.metadata import version

from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimation.export.algorithm import Algorithm
from pinnobs_gym.simulation.system import System


def places(estimator: BaseEstimator, found: Algorithm, name: str, real: str) -> dict[str, str]:
    """Return the texts of the places in the templates."""
    system, has_P = estimator.system, found.covariance
    inputs = system.nu if system.measured_input else 0
    states = f"{name.upper()}_STATES"
    std = (
        f"for (int i = 0; i < {states}; i++)\n"
        f'            printf(",%.17g", sqrt((double)filter.P[i * ({states} + 1)]));'
    )
    start = f"xhat0 ({system.nx}) is the initial estimate; NULL stands for that of the export."
    if has_P:
        start = (
            f"xhat0 ({system.nx}) and P0 ({system.nx} x {system.nx}) are the mean and the "
            "covariance of the\n   initial state; NULL stands for those of the export."
        )
    return {
        "name": name,
        "NAME": name.upper(),
        "real": real,
        "NX": str(system.nx),
        "NY": str(system.ny),
        "NU": str(inputs),
        "LU": str(max(system.nu, 1)),
        "time_unit": system.time_unit,
        "or_whole": ", or is no whole number" if system.discrete else "",
        "states": _listed(system, system.state_names),
        "fields": "\n    ".join(found.fields),
        "inputs": f" ({inputs})" if inputs else ", of which there are none: NULL will do",
        "start": start,
        "P0": f", const {real} *P0" if has_P else "",
        "no_P0": ", NULL" if has_P else "",
        "print_std": std if has_P else "",
        "columns": _columns(system, inputs),
        "intro": _intro(estimator),
    }


def _columns(system: System, inputs: int) -> str:
    """Return the names that each column of a record may have, as C: those of logs and,
    where it is no other column's and has a plain text in C, the plant's own."""
    pairs = [("t", "t")]
    pairs += [(f"y{i}", name) for i, name in enumerate(system.output_names, 1)]
    pairs += [(f"u{i}", name) for i, name in enumerate(system.input_names[:inputs], 1)]
    taken = [name for pair in pairs for name in set(pair)]
    rows = []
    for given, own in pairs:
        plain = own.isprintable() and not set(own) & set('"\\?,') and taken.count(own) == 1
        rows.append(f'{{"{given}", "{own if plain else given}"}},')
    return "\n    ".join(rows)


def _listed(system: System, names: tuple[str, ...]) -> str:
    units = system.units
    return ", ".join(f"{n} ({units[n]})" if n in units else n for n in names)


def _intro(estimator: BaseEstimator) -> str:
    """Return the comment at the head of the files."""
    system = estimator.system
    lines = [
        f"{estimator.label} of {type(system).__name__}, exported by pinnobs-gym "
        f"{version('pinnobs-gym')}.",
        f"Outputs: {_listed(system, system.output_names)}.",
    ]
    if system.measured_input:
        lines.append(f"Inputs: {_listed(system, system.input_names)}.")
    settings = ", ".join(f"{k}={v}" for k, v in estimator.options.items())
    lines += [f"Settings: {settings}."] if settings else []
    return "/* " + "\n   ".join(lines) + " */"
