"""Rows as a file holds them, and a writer that other processes can import."""

from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.metrics import SCORES
from pinnobs_gym.scoring.row_format import KEY, SCHEMA


def row(seed=0, **changes):
    tail = float("inf") if changes.get("diverged") else 0.1
    scores = {**dict.fromkeys(SCORES, 0.5), "nrmse_tail": tail}
    names = dict.fromkeys(KEY, "x")
    facts = {
        "diverged": False,
        "episode": f"seed:{seed}",
        "state_rmse": {},
        "ranked": True,
        "nx": 2,
    }
    facts |= {"estimator_code": "x", "date": "2030-01-02", "training_seed": None, "track": "online"}
    facts |= {"knows": ["model"], "options": {}, "settings": {}, "training": {}, "versions": {}}
    facts |= {"us_per_step": 1.0}
    base = {"schema": SCHEMA, "kind": "score", **names, **scores, **facts}
    return {**base, **changes}


def write_fifty(path, first):
    for i in range(50):
        rows.append(path, [row(first + i)])
