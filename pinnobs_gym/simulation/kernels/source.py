"""The whole source of a library: a plant's equations and a template."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from pinnobs_gym.simulation.kernels.dop853_code import coefficients
from pinnobs_gym.simulation.kernels.plant_code import PlantCode

WIDE = 8
"""Number of episodes side by side."""
_ALONE = {"truth": "truth_entry.c", "model": "model_entry.c"}
"""Algorithms that are no filters, with the templates of their entries."""


def library_source(plant: PlantCode, *templates: str) -> str:
    """Return C that compiles by itself: the plant's equations and the templates, for one lane and
    for `WIDE` lanes, and the entries that choose between these.

    Args:
        plant: the equations.
        templates: names of templates with an algorithm for any number of lanes, such as ``ekf``.
    """
    alone = all(name in _ALONE for name in templates)
    parts = [_template("common.h"), plant.once]
    if "truth" in templates:
        parts.append(coefficients())
    for width in (1, WIDE):
        parts += [
            f"#undef W\n#undef AT_WIDTH\n#define W {width}\n#define AT_WIDTH(name) name##_{width}",
            _template("lanes.h"),
            plant.lanes,
            *(() if alone else (_template("motion.h"), _template("filter.h"))),
            *(_template(f"{name}.c") for name in templates),
        ]
    called = "".join(
        f"#define {name.upper()}_WIDE {name}_rows_{WIDE}\n"
        for name in ("filter", "solve", "step", "linearise")
    )
    entries = dict.fromkeys(_ALONE.get(name, "filter.c") for name in templates)
    parts += [f"#define WIDE {WIDE}\n{called}", *map(_template, entries)]
    return "\n".join([*parts, _template("check.c")])


@cache
def _template(name: str) -> str:
    return (files("pinnobs_gym.simulation.kernels") / "templates" / name).read_text(
        encoding="utf-8"
    )
