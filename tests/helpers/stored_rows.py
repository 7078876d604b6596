"""Rows as a file holds them, and a writer that other processes can import."""

from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.metrics import SCORES


def row(seed=0, **changes):
    scores = dict.fromkeys(SCORES, 0.5)
    names = dict.fromkeys(rows.KEY, "x")
    facts = {
        "diverged": False,
        "episode": f"seed:{seed}",
        "state_rmse": {},
        "ranked": True,
        "nx": 2,
    }
    facts |= {"estimator_code": "x", "date": "2030-01-02", "training_seed": None, "track": "online"}
    facts |= {"knows": ["model"], "options": {}, "training": {}, "versions": {}, "us_per_step": 1.0}
    base = {"schema": rows.SCHEMA, "kind": "score", **names, **scores, **facts}
    return {**base, **changes}


def write_fifty(path, first):
    for i in range(50):
        rows.append(path, [row(first + i)])
