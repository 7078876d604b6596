"""The learned KKL observers, their dynamics and networks as constants."""

from __future__ import annotations

from itertools import chain
from typing import Any

import numpy as np

from pinnobs_gym.estimation.export.algorithm import Algorithm, model_parts, own
from pinnobs_gym.estimation.learned.perceptron import Layers
from pinnobs_gym.simulation.kernels.plant_code import PlantCode
from pinnobs_gym.simulation.system import System

_ACTIVATIONS = {
    "tanh": "tanh(a)",
    "silu": "a * (0.5 + 0.5 * tanh(0.5 * a))",
    "relu": "a > 0 ? a : 0",
}


_NOTE = (
    "outside of the region of its training this code gives T*(z), where the observer in Python "
    "takes the estimates of a filter that runs alongside; the field outside says when"
)


def kkl_code(trained: Any, system: System, code: PlantCode, hold: float) -> Algorithm:
    """Return the code of a trained observer.

    Args:
        trained: a `pinnobs_gym.estimators.kkl.TrainedKKL`.
        system: its system.
        code: the system's equations in C.
        hold: how long z has to be inside of its region before estimates count again, in s.
    """
    nz, ny, nx = trained.dynamics.size, system.ny, system.nx
    clock = trained.clock
    step = system.setups["benchmark"].dt
    Phi, Gamma0, Gamma1 = trained.dynamics.step(step)
    timed = trained.encoder[0][0].shape[1] > nx
    numbers = {
        "A_z": trained.A,
        "B_z": trained.B,
        "rest": trained.rest,
        "usual_step": np.array([step]),
        "usual_Phi": Phi,
        "usual_Gamma0": Gamma0,
        "usual_Gamma1": Gamma1,
        "rates": np.array(clock.rates or (0.0,)),
        "amplitudes": np.array(clock.amplitudes or (1.0,)),
        "encoder": _flat(trained.encoder),
        "decoder": _flat(trained.decoder),
    }
    sizes = {
        "NZ": nz,
        "SIZE": nz + 2 * ny,
        "RATES": len(clock.rates),
        "AMPLITUDES": len(clock.amplitudes),
        "DISCRETE": int(trained.mode == "discrete"),
        "FROM_PRIOR": int(trained.start == "prior"),
        "TIMED": int(timed),
        "WIDEST": max(max(_widths(trained.encoder)), max(_widths(trained.decoder))),
        "ENCODER_LAYERS": len(trained.encoder),
        "DECODER_LAYERS": len(trained.decoder),
    }
    fields = (
        f"@real@ z[{nz}]; /* state of the observer */",
        f"@real@ y[{ny}]; /* outputs at the last sample; predicted where missing */",
        f"@real@ Phi[{nz * nz}], Gamma0[{nz * ny}], Gamma1[{nz * ny}]; /* of a step */",
        "@real@ step; /* its length in s */",
        "double first; /* time of the first sample */",
    )
    widths = "\n".join(
        f"static const int {name}_sizes[{len(layers) + 1}] = "
        f"{{{', '.join(map(str, _widths(layers)))}}};"
        for name, layers in (("encoder", trained.encoder), ("decoder", trained.decoder))
    )
    texts = [widths, own("between.c"), own("kkl.c")]
    places = {"activation": _ACTIVATIONS[trained.activation], "unmarked": "", "mark": ""}
    region, notes = trained.region, []
    if region is not None:
        numbers |= {
            "region_mean": region.mean,
            "region_scale": region.scale,
            "region_points": region.points,
            "region_limits": np.array([region.radius, hold]),
        }
        sizes["POINTS"] = len(region.points)
        fields += (
            "double left; /* time when z was last outside of the region of its training */",
            "int32_t outside; /* whether that was lately, so that x is not to be trusted */",
        )
        texts.insert(2, own("kkl_region.c"))
        places |= {
            "unmarked": "filter->left = -INFINITY;\n    ",
            "mark": "mark_region(filter, a, t);\n    ",
        }
        notes.append(_NOTE)
    return Algorithm(
        model_parts(code), texts, numbers, fields, sizes=sizes, places=places, notes=notes
    )


def _widths(layers: Layers) -> list[int]:
    return [layers[0][0].shape[1], *(len(bias) for _, bias in layers)]


def _flat(layers: Layers) -> np.ndarray:
    """Return the weights and the biases of each layer, one after the other."""
    return np.concatenate([np.ravel(part) for part in chain.from_iterable(layers)])
