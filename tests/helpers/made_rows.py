"""Rows that no estimator was run for."""

from pinnobs_gym.scoring.metrics import DIVERGED, OPTIONAL_SCORES, SCORES


def rows_of(estimator, nrmse, track="online", diverged=None, **changes):
    diverged = [False] * len(nrmse) if diverged is None else diverged
    return [
        {
            **dict.fromkeys(SCORES, value),
            **dict.fromkeys(OPTIONAL_SCORES),
            "kind": "score",
            "ranked": True,
            "nx": 2,
            "options": {},
            "settings": {},
            "training_seed": None,
            "env_id": "pinnobs/X-v0",
            "setup": "benchmark",
            "condition": "nominal",
            "estimator": estimator,
            "game_hash": "game",
            "estimator_code": "code",
            "estimator_hash": estimator,
            "date": "2030-01-02",
            "track": track,
            "knows": ["model"],
            "training": {},
            "us_per_step": 1.0,
            "diverged": bad,
            "nrmse_tail": float("inf") if bad else min(value, DIVERGED),
            "episode": f"seed:{i}",
            "state_rmse": {},
            "free_over_known": None,
            "nominal_over_free": None,
            **changes,
        }
        for i, (value, bad) in enumerate(zip(nrmse, diverged, strict=True))
    ]
