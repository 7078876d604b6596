"""Files from which a training of a shared gain goes on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.estimation.learned.trained_file import check_same, identity, read, write
from trainers.pinn_gain.run import Best, Run

_FREE = ("iterations", "budget", "checkpoint_every", "log_every")
"""Settings that may change when training is resumed: they decide nothing but when it ends."""


def save(run: Run, path: Path) -> None:
    """Write all that `restore` needs to go on exactly."""
    assert run.best is not None
    state, best = run.state(), run.best
    found = {"loss": best.loss, "iteration": best.iteration, "seed": best.seed}
    facts = {**_expected(run), "best": found, **state.pop("facts")}
    layers = [[torch.tensor(a) for a in layer] for layer in best.layers]
    write(path, {"facts": json.dumps(facts), "record": _record(run), "best": layers, **state})


def restore(run: Run, path: Path) -> None:
    """Take up the training of a checkpoint.

    Raises:
        ValueError: in one line, if it cannot be read or belongs to another training.
    """
    saved = read(path)
    try:
        facts = json.loads(saved["facts"])
        check_same(path, facts, _expected(run))
        for name, value in _record(run).items():
            kept = saved["record"][name].numpy()
            if not np.array_equal(kept, value.numpy(), equal_nan=True):
                raise ValueError(f"{path} was trained on another record: its {name} differs")
        layers = tuple((W.numpy(), b.numpy()) for W, b in saved["best"])
        run.take_up({**saved, "facts": facts}, Best(**facts["best"], layers=layers))
    except (KeyError, TypeError, AttributeError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"{path} is not a checkpoint of this trainer: {reason}") from None


def _expected(run: Run) -> dict[str, Any]:
    """What a checkpoint must agree with."""
    config = {k: v for k, v in asdict(run.config).items() if k not in _FREE}
    return {**identity(run.system), "config": config, "noise_std": run.noise_std.tolist()}


def _record(run: Run) -> Mapping[str, Tensor]:
    record = run.record
    parts = {"t": record.t, "y": record.y, "u": record.u, "xhat0": record.prior.mean}
    return {name: torch.tensor(np.ascontiguousarray(a)) for name, a in parts.items()}
