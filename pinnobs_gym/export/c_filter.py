"""An estimator as a C99 file of its own, made from the templates that it runs by."""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from typing import Any

import numpy as np

from pinnobs_gym.estimation.compiled_code import _changed
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.export.pruning import needed_code
from pinnobs_gym.export.scalar import scalar, single
from pinnobs_gym.simulation.kernels.calls import plan_values
from pinnobs_gym.simulation.kernels.plant_code import PlantCode, plant_code
from pinnobs_gym.simulation.kernels.source import filter_parts, read
from pinnobs_gym.simulation.plant_form import plant_form
from pinnobs_gym.simulation.record import Prior

_PLACE = re.compile(r"@(\w+)@")
_IDENTIFIER = re.compile(r"[A-Za-z_]\w*", re.ASCII)
TEMPLATES = ("ekf", "sigma_points")
"""The algorithms that are exported as filters."""


@dataclass(frozen=True)
class CFiles:
    """The text of an exported estimator."""

    name: str
    """Beginning of the names of its files, types and functions."""
    header: str
    source: str
    replay: str
    """A main program that replays a CSV file."""


def c_files(estimator: BaseEstimator, prior: Prior, name: str, *, float32: bool = False) -> CFiles:
    """Return an estimator as C.

    Args:
        estimator: the estimator; its model's equations can be traced.
        prior: the prior that the filter starts from by default, of one row.
        name: an identifier of C.
        float32: whether numbers are of single precision; times remain double.

    Raises:
        ValueError: in one line, if the estimator, or its model, cannot be exported.
    """
    if not _IDENTIFIER.fullmatch(name):
        raise ValueError(f"name={name!r}; expected a name in C: letters, digits and underscores")
    template = _template(estimator)
    code = _equations(estimator)
    real = "float" if float32 else "double"
    source = _source(estimator, prior, template, code)
    source = needed_code(source)
    if float32:
        source = single(source)
    checksum = f"0x{zlib.crc32(source.encode()):08x}"
    values = _values(estimator, name, real) | {"checksum": checksum}
    math = "tgmath" if float32 else "math"
    head = f"#include <{math}.h>\n#include <string.h>\n\n#include \"{name}.h\"\n\ntypedef {real} real;\n"
    own = filled(source, values)
    return CFiles(
        name,
        filled(_own("header.h"), values),
        f"{values['intro']}\n{head}{own}",
        filled(_own("replay.c"), values),
    )


def _template(estimator: BaseEstimator) -> str:
    """Return the algorithm of an estimator."""
    cls, system = type(estimator), estimator.system
    template = getattr(cls, "template", "")
    if template not in TEMPLATES:
        raise ValueError(f"estimator {estimator.label!r} is not exported; expected ekf, ukf or ckf")
    if changed := _changed(cls):
        raise ValueError(f"{cls.__name__} defines {changed}, which the exported code has not")
    if estimator.noise.samples is not None:
        raise ValueError("the noise differs between samples; expected one level")
    if system.own_flow or system.stiff:
        kind = "a flow of its own" if system.own_flow else "stiff equations"
        raise ValueError(f"{type(system).__name__} has {kind}, which is not exported")
    if template == "sigma_points" and system.state_box is not None:
        raise ValueError(
            f"{type(system).__name__} has bounds of states, which {estimator.label} is not exported "
            "with; expected ekf"
        )
    return template


def _equations(estimator: BaseEstimator) -> PlantCode:
    """Return the model's equations in C."""
    try:
        return plant_code(plant_form(estimator.system))
    except Exception as error:  # whatever the equations raise when they are given symbols
        what = " ".join(str(error).split())
        raise ValueError(
            f"the equations of {type(estimator.system).__name__} cannot be traced: {what}"
        ) from None


def _source(estimator: Any, prior: Prior, template: str, code: PlantCode) -> str:
    """Return the code of the filter, with places that are to be filled."""
    settings = estimator.plan_settings()
    restarts = "gate" in settings
    own = _own("leaves.c"), _own(f"{template}.c")
    parts = [
        read("common.h"),
        code.once,
        "#define RESTARTS" if restarts else "",
        read("lanes.h"),
        code.lanes,
        *filter_parts(code, template, own),
    ]
    text = scalar("\n".join(parts)).replace("#include <math.h>\n#include <stdint.h>\n", "").replace("#include <string.h>\n", "")
    constants = _constants(estimator, prior, code, settings)
    return "\n".join([text, constants, _own(f"{template}_after.c"), _own("filter_entry.c")])


def _constants(estimator: Any, prior: Prior, code: PlantCode, settings: Mapping[str, Any]) -> str:
    """Return the numbers of the filter."""
    L = estimator.noise.L(0.0)[..., 0]
    values = plan_values(estimator.system, code.numbers, L) | dict(settings)
    arrays, fields = [], []
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            if not value.size:
                continue
            kind = "seconds" if name == "breaks" else "real"
            arrays.append(array(f"plan_{name}", value, kind))
            value = f"plan_{name}"
        if value is not None:
            fields.append(f"    .{name} = {value},")
    more = {
        "prior_mean": prior.mean[0],
        "prior_cov": prior.cov[0],
        "output_noise": estimator.noise.R(0.0)[..., 0],
    }
    arrays += [array(name, value) for name, value in more.items()]
    return "\n".join([*arrays, "static const struct plan plan = {", *fields, "};\n"])


def array(name: str, values: np.ndarray, kind: str = "real") -> str:
    """Return an array of numbers in C."""
    numbers = [repr(float(v)).replace("inf", "INFINITY").replace("nan", "NAN") for v in values.flat]
    lines = [", ".join(numbers[i : i + 4]) for i in range(0, len(numbers), 4)]
    text = ",\n    ".join(lines)
    return f"static const {kind} {name}[{len(numbers)}] = {{\n    {text}}};"


def _values(estimator: Any, name: str, real: str) -> dict[str, str]:
    """Return the texts of the places in the templates."""
    system = estimator.system
    nx, ny, nu = system.nx, system.ny, system.nu
    gate = "gate" in estimator.plan_settings()
    fields = [
        f"{real} P[{nx * nx}];       /* their covariance */",
        f"{real} u[{max(nu, 1)}];          /* inputs at the last sample */",
        f"{real} innovation[{ny}]; /* outputs less their predictions */",
        f"{real} S[{ny * ny}];          /* covariance of the innovation */",
    ]
    if gate:
        fields += [
            f"{real} P_restart[{nx * nx}]; /* covariance after a restart */",
            "int64_t beyond;        /* samples in a row beyond the gate */",
        ]
    given = system.nu and system.measured_input
    return {
        "name": name,
        "NAME": name.upper(),
        "real": real,
        "NX": str(nx),
        "NY": str(ny),
        "NU": str(nu if given else 0),
        "time_unit": system.time_unit,
        "or_whole": ", or is no whole number" if system.discrete else "",
        "states": ", ".join(_named(system, n) for n in system.state_names),
        "fields": "\n    ".join(fields),
        "inputs": "" if given else "; none, and NULL will do",
        "before": "memory.beyond[0] = filter->beyond;\n    memcpy(memory.P_restart, filter->P_restart, sizeof memory.P_restart);" if gate else "",
        "after": "filter->beyond = memory.beyond[0];" if gate else "",
        "print_std": f"for (int i = 0; i < {name.upper()}_STATES; i++)\n            printf(\",%.17g\", sqrt((double)filter.P[i * ({name.upper()}_STATES + 1)]));",
        "intro": _intro(estimator, name),
    }


def _named(system: Any, name: str) -> str:
    unit = system.units.get(name)
    return f"{name} ({unit})" if unit else name


def _intro(estimator: Any, name: str) -> str:
    """Return the comment at the head of the files."""
    system = estimator.system
    listed = {
        "States": system.state_names,
        "Outputs": system.output_names,
        "Inputs": system.input_names if system.measured_input else (),
    }
    lines = [f"{estimator.label} of {type(system).__name__}, exported by pinnobs-gym {version('pinnobs-gym')}."]
    lines += [
        f"{what}: {', '.join(_named(system, n) for n in names)}." for what, names in listed.items() if names
    ]
    settings = ", ".join(f"{k}={v}" for k, v in estimator.options.items())
    lines.append(f"Settings: {settings}.")
    return "/* " + "\n   ".join(lines) + " */"


def filled(text: str, values: Mapping[str, str]) -> str:
    """Return a template with its places filled."""
    return _PLACE.sub(lambda found: values[found[1]], text)


@cache
def _own(name: str) -> str:
    return (files("pinnobs_gym.export") / "templates" / name).read_text(encoding="utf-8")
