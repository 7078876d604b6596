"""Rows and curves that no estimator was run for, of one estimator in one game or in several."""

import numpy as np

from pinnobs_gym.scoring.curves import Curves, Example
from pinnobs_gym.scoring.metrics import OPTIONAL_SCORES, SCORES


def row(seed=0, **changes):
    base = dict.fromkeys(SCORES, 0.1) | dict.fromkeys(OPTIONAL_SCORES)
    facts = {"env_id": "pinnobs/A-v0", "setup": "benchmark", "condition": "nominal"}
    facts |= {"ranked": True, "nx": 2, "estimator": "ekf", "track": "online", "knows": ["model"]}
    facts |= {"options": {}, "settings": {}, "training": {}, "training_seed": None}
    facts |= {"game_hash": "g", "estimator_code": "c", "estimator_hash": "h"}
    facts |= {"us_per_step": 1.0, "date": "2030-01-02T00:00:00", "versions": {"numpy": "2"}}
    return (
        base
        | facts
        | {
            "diverged": False,
            "episode": f"seed:{seed}",
            "state_rmse": {},
            "free_over_known": None,
            "nominal_over_free": None,
        }
        | changes
    )


def curves(error, t=(0.0, 1.0, 2.0), reference=None, seeds=None, seed=0):
    error, t = np.asarray(error, dtype=np.float32), np.asarray(t)
    x = np.stack([t, -t], axis=-1)
    example = Example(seed, t, x, x + 1, x[:, :1], np.full(x.shape, 0.25))
    seeds = np.arange(len(error)) if seeds is None else np.asarray(seeds)
    reference = None if reference is None else np.asarray(reference)
    return Curves(t, seeds, error, reference, example, ("a", "b (m)"), {0: 0})


def lines_of(table, name):
    keys = [key for key in table if key != "estimator"]
    places = [i for i, each in enumerate(table["estimator"]) if each == name]
    return [tuple(table[key][i] for key in keys) for i in places]
