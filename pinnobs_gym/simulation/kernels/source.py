"""The whole source of a library: a plant's equations and a template."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from pinnobs_gym.simulation.kernels.dop853_code import coefficients
from pinnobs_gym.simulation.kernels.plant_code import PlantCode

_WIDE = 8
"""Number of episodes side by side."""
_WIDE_FILTER = 4
"""The number in filters. A filter of eight takes a fifth less time where its results fit the cache,
but one of a single episode, or a second library for that, takes half as long again."""
_ALONE = {"truth": "truth_entry.c", "model": "model_entry.c"}
"""Algorithms that are no filters, with the templates of their entries."""
_AFTER = {"smoother": ("ekf", "smoother_entry.c")}
"""Algorithms that follow a filter, with its template and those of their entries."""


def library_source(plant: PlantCode, *templates: str) -> str:
    """Return C that compiles by itself: the plant's equations and the templates, for one lane and
    for several, and the entries that choose between these.

    Args:
        plant: the equations.
        templates: names of templates with an algorithm for any number of lanes, such as ``ekf``.
    """
    entries = [(_ALONE.get(n) or _AFTER.get(n, ("", "filter.c"))[1]) for n in templates]
    templates = tuple(part for n in templates for part in (*_AFTER.get(n, ())[:1], n))
    alone = all(name in _ALONE for name in templates)
    wide = _WIDE if alone else _WIDE_FILTER
    parts = [_template("common.h"), plant.once]
    if "truth" in templates:
        parts.append(coefficients())
    filters = [
        _template("steps.h"),
        plant.steps or _template("loops.h"),
        _template("motion.h"),
        _template("filter.h"),
    ]
    for width in (1, wide):
        parts += [
            f"#undef W\n#undef AT_WIDTH\n#define W {width}\n#define AT_WIDTH(name) name##_{width}",
            _template("lanes.h"),
            plant.lanes,
            *(() if alone else filters),
            *(_template(f"{name}.c") for name in templates),
        ]
    called = "".join(
        f"#define {name.upper()}_WIDE {name}_rows_{wide}\n"
        for name in ("filter", "smooth", "solve", "step", "linearise")
    )
    parts += [f"#define WIDE {wide}\n{called}", *map(_template, dict.fromkeys(entries))]
    return "\n".join([*parts, _template("check.c")])


@cache
def _template(name: str) -> str:
    return (files("pinnobs_gym.simulation.kernels") / "templates" / name).read_text(
        encoding="utf-8"
    )
