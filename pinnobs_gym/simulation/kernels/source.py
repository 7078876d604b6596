"""The whole source of a library: a plant's equations and a template."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from pinnobs_gym.simulation.kernels.plant_code import PlantCode

WIDE = 4
"""Number of episodes side by side. A filter of eight takes a fifth less time where its results fit
the cache, but one of a single episode, or a second library for that, takes half as long again."""


def library_source(plant: PlantCode, *templates: str) -> str:
    """Return C that compiles by itself: the plant's equations and the templates, for one lane and
    for `WIDE` lanes, and the entries that choose between these.

    Args:
        plant: the equations.
        templates: names of templates with an algorithm for any number of lanes, such as ``ekf``.
    """
    parts = [_template("common.h"), plant.once]
    for width in (1, WIDE):
        parts += [
            f"#undef W\n#undef AT_WIDTH\n#define W {width}\n#define AT_WIDTH(name) name##_{width}",
            _template("lanes.h"),
            plant.lanes,
            _template("steps.h"),
            plant.steps or _template("loops.h"),
            _template("motion.h"),
            _template("filter.h"),
            *(_template(f"{name}.c") for name in templates),
        ]
    entries = f"#define WIDE {WIDE}\n#define FILTER_WIDE filter_rows_{WIDE}"
    return "\n".join([*parts, entries, _template("filter.c"), _template("check.c")])


@cache
def _template(name: str) -> str:
    return (files(__package__) / "templates" / name).read_text(encoding="utf-8")
