"""The whole source of a library: a plant's equations and a template."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from pinnobs_gym.simulation.kernels.dop853_code import coefficients
from pinnobs_gym.simulation.kernels.plant_code import PlantCode

_WIDE = 8
"""Number of episodes side by side."""
_WIDE_FILTER = 4
"""The number in filters. A filter of eight takes a fifth less time where its results fit the cache,
but one of a single episode, or a second library for that, takes half as long again."""

WIDEST = 256
"""Largest number of neurons in a layer of a network in compiled code."""


@dataclass(frozen=True)
class _Parts:
    """The files of which a library consists beside the plant's equations."""

    entries: tuple[str, ...]
    """Entries, which choose the number of lanes."""
    lanes: tuple[str, ...]
    """What is written for each number of lanes, after the parts of a filter."""
    algorithm: str = ""
    """Template of a filter's ``predict`` and ``correct``, or of what takes their place; empty for
    an algorithm that is no filter."""
    once: str = ""
    """Text before all of these."""


def _parts(template: str) -> _Parts:
    """Return the files of an algorithm."""
    filters, windows = ("given_inputs.c", "filter.c"), ("given_inputs.c", "window_entry.c")
    rows = ("filter_rows.c",)
    match template:
        case "truth":
            return _Parts(("truth_entry.c",), ("truth.c",), once=coefficients())
        case "model":
            return _Parts(("model_entry.c",), ("model.c",))
        case "smoother":
            lanes = *rows, "smoother.c"
            return _Parts(("smoother_entry.c",), lanes, "ekf", "#define SMOOTHED")
        case "window":
            return _Parts(windows, ("window.c",), "window_samples", read("window.h"))
        case "moving_window":
            lanes = "roots.c", "linear_window.c", "moving_window.c"
            return _Parts(windows, lanes, "window_samples", read("window.h"))
        case "observer":
            once = f"#define OBSERVER\n#define CARRIED NY\n{read('solve.c')}"
            return _Parts(filters, rows, template, once)
        case "high_gain":
            once = "#define FORGETTING\n#define CARRIED (4 + NX * NX)"
            return _Parts(filters, ("forgetting.c", *rows), "ekf", once)
        case "learned_gain":
            once = f"#define CARRIED NY\n#define WIDEST {WIDEST}"
            return _Parts(filters, rows, template, once)
        case _:
            return _Parts(filters, rows, template)


def library_source(plant: PlantCode, template: str) -> str:
    """Return C that compiles by itself: the plant's equations and a template, for one lane and for
    several, and the entries that choose between these.

    Args:
        plant: the equations.
        template: name of a template with an algorithm for any number of lanes, such as ``ekf``.
    """
    own = _parts(template)
    wide = _WIDE_FILTER if own.algorithm else _WIDE
    parts = [read("common.h"), plant.once, own.once]
    for width in (1, wide):
        parts += [
            f"#undef W\n#undef AT_WIDTH\n#define W {width}\n#define AT_WIDTH(name) name##_{width}",
            read("lanes.h"),
            read("rows.h"),
            plant.lanes,
        ]
        if own.algorithm:
            parts += filter_parts(plant, own.algorithm, (read("inputs.h"), read("marks.h")))
        parts += map(read, own.lanes)
    called = "".join(
        f"#define {name.upper()}_WIDE {name}_rows_{wide}\n"
        for name in ("filter", "smooth", "solve", "step", "linearise", "window")
    )
    parts += [f"#define WIDE {wide}\n{called}", *map(read, own.entries), read("check.c")]
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
