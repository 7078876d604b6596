"""The whole source of a library: a plant's equations and a template."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib.resources import files

from pinnobs_gym.simulation.kernels.dop853_code import coefficients
from pinnobs_gym.simulation.kernels.plant_code import PlantCode

_WIDE = 8
"""Number of episodes side by side."""
_WIDE_FILTER = 4
"""The number in filters. A filter of eight takes a fifth less time where its results fit the cache,
but one of a single episode, or a second library for that, takes half as long again."""
_ALONE = ("truth", "model")
"""Algorithms that are no filters."""
_SMOOTHERS = {"smoother": "ekf"}
"""Algorithms that follow a filter, with the template of that."""


def library_source(plant: PlantCode, template: str) -> str:
    """Return C that compiles by itself: the plant's equations and a template, for one lane and for
    several, and the entries that choose between these.

    Args:
        plant: the equations.
        template: name of a template with an algorithm for any number of lanes, such as ``ekf``.
    """
    alone, smooths = template in _ALONE, template in _SMOOTHERS
    wide = _WIDE if alone else _WIDE_FILTER
    parts = [read("common.h"), plant.once]
    if template == "truth":
        parts.append(coefficients())
    if smooths:
        parts.append("#define SMOOTHED")
    for width in (1, wide):
        parts += [
            f"#undef W\n#undef AT_WIDTH\n#define W {width}\n#define AT_WIDTH(name) name##_{width}",
            read("lanes.h"),
            read("rows.h"),
            plant.lanes,
        ]
        if not alone:
            between = read("inputs.h"), read("marks.h")
            parts += filter_parts(plant, _SMOOTHERS.get(template, template), between)
            parts.append(read("filter_rows.c"))
        if alone or smooths:
            parts.append(read(f"{template}.c"))
    called = "".join(
        f"#define {name.upper()}_WIDE {name}_rows_{wide}\n"
        for name in ("filter", "smooth", "solve", "step", "linearise")
    )
    entry = f"{template}_entry.c" if alone or smooths else "filter.c"
    parts += [f"#define WIDE {wide}\n{called}", read(entry), read("check.c")]
    return "\n".join(parts)


def filter_parts(plant: PlantCode, algorithm: str, between: Sequence[str]) -> list[str]:
    """Return the parts of a filter for W lanes.

    Args:
        plant: the equations.
        algorithm: name of the template of its ``predict`` and ``correct``.
        between: the texts of ``known_input`` of ``inputs.h`` and of the functions of ``marks.h``.
    """
    steps = plant.steps or read("loops.h")
    inputs, marks = between
    files = inputs, read("motion.h"), read("filter.h"), marks, read(f"{algorithm}.c")
    return [read("steps.h"), steps, *files]


@cache
def read(name: str) -> str:
    """Return the text of a file of the folder ``templates``."""
    return (files("pinnobs_gym.simulation.kernels") / "templates" / name).read_text(
        encoding="utf-8"
    )
