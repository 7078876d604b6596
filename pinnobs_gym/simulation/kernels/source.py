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
_WIDE_ALONE = 4
"""The number where the code for one lane is not compiled: a single episode takes little longer in
four lanes, but half as long again in eight."""

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
    wide: int = _WIDE
    """Number of lanes."""


_SETS = {"ensemble": ("ensemble.c",), "particles": ("weights.c", "particles.c")}
"""Algorithms of sets of points, of which those of one episode are side by side."""
_OF_SETS = ("given_inputs.c", "streams.c", "members.c", "members_moments.c", "members_motion.c")
"""What these share."""


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
            return _Parts(("smoother_entry.c",), lanes, "ekf", "#define SMOOTHED", _WIDE_ALONE)
        case "window":
            once = read("window.h")
            return _Parts(windows, ("window.c",), "window_samples", once, _WIDE_ALONE)
        case "moving_window":
            lanes = "roots.c", "linear_window.c", "moving_window.c"
            return _Parts(windows, lanes, "window_samples", read("window.h"), _WIDE_ALONE)
        case "observer":
            once = f"#define OBSERVER\n#define CARRIED NY\n{read('solve.c')}"
            return _Parts(filters, rows, template, once)
        case "high_gain":
            once = "#define FORGETTING\n#define CARRIED (4 + NX * NX)"
            return _Parts(filters, ("forgetting.c", *rows), "ekf", once)
        case "learned_gain":
            once = f"#define CARRIED NY\n#define WIDEST {WIDEST}"
            return _Parts(filters, rows, template, once)
        case "ensemble" | "particles":
            return _Parts((*_OF_SETS, *_SETS[template]), ())
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
    parts = [read("common.h"), plant.once, own.once]
    for width in (1, own.wide):
        parts += [
            f"#undef W\n#undef AT_WIDTH\n#define W {width}\n#define AT_WIDTH(name) name##_{width}",
            read("lanes.h"),
            read("rows.h"),
            plant.lanes,
        ]
        if template in _SETS:
            parts += set_parts(plant, width)
        if own.algorithm:
            parts += filter_parts(plant, own.algorithm, (read("inputs.h"), read("marks.h")))
        parts += map(read, own.lanes)
    called = "".join(
        f"#define {name.upper()}_WIDE {name}_rows_{own.wide}\n"
        for name in ("filter", "smooth", "solve", "step", "linearise", "window")
    )
    parts += [f"#define WIDE {own.wide}\n{called}", *map(read, own.entries), read("check.c")]
    return "\n".join(parts)


def set_parts(plant: PlantCode, width: int) -> list[str]:
    """Return the parts of algorithms of sets of points, for points side by side, or for one lane:
    matrices of an episode."""
    if width == 1:
        return [read("filter.h"), read("marks.h")]
    steps = plant.steps or read("loops.h")
    return [read("steps.h"), steps, read("inputs.h"), read("interval.h")]


def filter_parts(plant: PlantCode, algorithm: str, between: Sequence[str]) -> list[str]:
    """Return the parts of a filter for W lanes.

    Args:
        plant: the equations.
        algorithm: name of the template of its ``predict`` and ``correct``.
        between: the texts of ``known_input`` of ``inputs.h`` and of the functions of ``marks.h``.
    """
    steps = plant.steps or read("loops.h")
    inputs, marks = between
    motion = inputs, read("interval.h"), read("motion.h")
    return [read("steps.h"), steps, *motion, read("filter.h"), marks, read(f"{algorithm}.c")]


@cache
def read(name: str) -> str:
    """Return the text of a file of the folder ``templates``."""
    return (files("pinnobs_gym.simulation.kernels") / "templates" / name).read_text(
        encoding="utf-8"
    )
