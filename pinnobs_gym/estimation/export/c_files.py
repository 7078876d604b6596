"""An estimator as C99 files of its own."""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimation.export.algorithm import Algorithm, own
from pinnobs_gym.estimation.export.names import check_name
from pinnobs_gym.estimation.export.notes import notes_of
from pinnobs_gym.estimation.export.places import places
from pinnobs_gym.estimation.export.pruning import needed_code, needed_fields
from pinnobs_gym.estimation.export.scalar import scalar, single
from pinnobs_gym.simulation.kernels.calls import plan_values
from pinnobs_gym.simulation.kernels.plant_code import PlantCode, plant_code
from pinnobs_gym.simulation.kernels.source import read
from pinnobs_gym.simulation.plant_form import plant_form
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import System

_PLACE = re.compile(r"@(\w+)@")
_INCLUDES = re.compile(r"^#include <.*>\n", re.M)
_A_LINE = 4
"""Number of numbers in a line."""


@dataclass(frozen=True)
class CFiles:
    """The texts of an exported estimator."""

    name: str
    """Beginning of the names of its files, types and functions."""
    header: str
    source: str
    replay: str
    """A main program that replays a CSV file."""
    checksum: str
    """Of the source, which has the model and the settings."""
    notes: tuple[str, ...] = ()
    """What the user should know, a line each."""


def c_files(estimator: BaseEstimator, prior: Prior, name: str, *, float32: bool = False) -> CFiles:
    """Return an estimator as C, with the operations by which it runs here.

    Args:
        estimator: the estimator; its model's equations can be traced.
        prior: the prior, of one row, that it starts from by default.
        name: a name in C.
        float32: whether numbers are of single precision; times remain double.

    Raises:
        ValueError: in one line, if the estimator or its model cannot be exported.
    """
    _check_exportable(estimator)
    code = _equations(estimator.system)
    found = estimator.exported(code, prior)
    if found is None:
        raise ValueError(
            f"estimator {estimator.label!r} is not exported; expected ekf, robust_ekf, "
            "strong_tracking_ekf, ukf, ckf, luenberger, or a KKL observer"
        )
    source = _filled(_source(estimator, prior, found, code), found.places)
    check_name(name, [source, own("replay.c")])
    source = needed_code(source)
    source = needed_code(needed_fields(source))  # arrays of fields that are gone
    if float32:
        source = single(source)
    checksum = f"0x{zlib.crc32(source.encode()):08x}"
    values = places(estimator, found, name, "float" if float32 else "double")
    values |= {"checksum": checksum}
    head = own("head.c").replace("@math@", "tgmath" if float32 else "math")
    texts = [own("header.h"), f"{head}\n{source.lstrip()}", own("replay.c")]
    header, source, replay = (_filled(_filled(text, values), values) for text in texts)
    notes = (*found.notes, *notes_of(code, float32, estimator.system.measured_input))
    return CFiles(name, header, source, replay, checksum, notes)


def _check_exportable(estimator: BaseEstimator) -> None:
    """Raise ValueError in one line if what the estimator is told is not that of exported code."""
    system = estimator.system
    kind = type(system).__name__
    if system.own_flow or system.stiff:
        what = "a flow of its own" if system.own_flow else "stiff equations"
        raise ValueError(f"{kind} has {what}, which is not exported")
    if estimator.noise.samples is not None:
        raise ValueError("the output noise differs between samples; expected one level")
    if any(np.size(value) > 1 for value in system.parameters.values() if np.ndim(value) == 1):
        raise ValueError(f"a parameter of {kind} has several values; expected one")


def _equations(system: System) -> PlantCode:
    """Return the model's equations in C."""
    try:
        return plant_code(plant_form(system))
    except Exception as error:  # whatever the equations raise when they are given symbols
        what = " ".join(str(error).split())
        raise ValueError(
            f"the equations of {type(system).__name__} cannot be traced: {what}"
        ) from None


def _source(estimator: BaseEstimator, prior: Prior, found: Algorithm, code: PlantCode) -> str:
    """Return the code, with places that are to be filled."""
    lanes = [read("common.h"), code.once, read("lanes.h"), code.lanes, *found.lanes]
    sizes = "".join(f"#define {name} {value}\n" for name, value in found.sizes.items())
    text = _INCLUDES.sub("", scalar("\n".join(lanes)))
    numbers = _numbers(estimator, prior, found, code)
    return "\n".join([text, sizes, numbers, *found.own, own("entry.c")])


def _numbers(estimator: BaseEstimator, prior: Prior, found: Algorithm, code: PlantCode) -> str:
    """Return the plan, and the numbers of the algorithm."""
    L = estimator.noise.L(0.0)[..., 0]
    values = plan_values(estimator.system, code.numbers, L) | dict(found.plan)
    arrays, fields = [], []
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            if value.size:
                kind = "seconds" if name == "breaks" else "real"
                arrays.append(_array(f"plan_{name}", value, kind))
                fields.append(f"    .{name} = plan_{name},")
        elif value is not None:
            fields.append(f"    .{name} = {value},")
    own_arrays = {"prior_mean": prior.mean[0], **found.numbers}
    arrays += [_array(name, value) for name, value in own_arrays.items()]
    return "\n".join([*arrays, "static const struct plan plan = {", *fields, "};\n"])


def _array(name: str, values: np.ndarray, kind: str = "real") -> str:
    """Return an array of numbers in C."""
    numbers = [_number(float(value)) for value in values.flat]
    lines = [", ".join(numbers[i : i + _A_LINE]) for i in range(0, len(numbers), _A_LINE)]
    text = ",\n    ".join(lines)
    return f"static const {kind} {name}[{len(numbers)}] = {{\n    {text}}};"


def _number(value: float) -> str:
    return repr(value).replace("inf", "INFINITY").replace("nan", "NAN")


def _filled(text: str, values: Mapping[str, str]) -> str:
    """Return a text with those of its places filled that are given."""
    return _PLACE.sub(lambda found: values.get(found[1], found[0]), text)
