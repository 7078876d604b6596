"""The floor that a rows file has, in what `evaluate` and `tables` print."""

import pytest

from pinnobs_gym import evaluate
from pinnobs_gym.cli import main
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.row_format import FLOOR


@pytest.fixture
def folder(tmp_path):
    """A folder with the rows of a floor: half of the errors of the UKF."""
    path = tmp_path / "rows.jsonl"
    scored = evaluate("ukf", "ReverseDuffing", episodes=10)
    made = {"estimator": "exact_bayes", "estimator_hash": "exact", "track": FLOOR}
    made["effective_sample_size"] = 900.0
    for row in scored:
        row |= made
        for name in ("nrmse_steady", "nrmse_steady_modulo", "nrmse_transient"):
            row[name] /= 2
    rows.append(path, scored)
    return tmp_path


def evaluated(folder):
    chosen = ["--system", "ReverseDuffing", "--estimator", "ukf", "--episodes", "10"]
    assert main(["evaluate", *chosen, "--out", str(folder)]) == 0


def test_an_evaluation_is_compared_with_the_floor_in_its_file(folder, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    evaluated(folder)
    lines = capsys.readouterr().out.splitlines()
    header = next(line for line in lines if line.startswith("rank")).split("  ")
    assert "/ Bayes" in [part.strip() for part in header]
    assert "  2  " in next(line for line in lines if line.split()[1:2] == ["ukf"])
    assert any(line.split()[:1] == ["exact_bayes"] for line in lines)
    assert "Floor: exact Bayes, with at least 900 effective draws." in " ".join(lines)
    assert main(["tables", str(folder / "rows.jsonl"), "--table", "ReverseDuffing"]) == 0
    assert "/ Bayes" in capsys.readouterr().out


def test_a_floor_of_other_code_is_left_out_and_told(folder, capsys):
    path = folder / "rows.jsonl"
    old = [row | {"game_hash": "older"} for row in rows.read(path)]
    path.unlink()
    rows.append(path, old)
    evaluated(folder)
    told = " ".join(capsys.readouterr().out.split())
    assert "10 episodes of the floor of pinnobs/ReverseDuffing-v0, benchmark, nominal are" in told
    assert "exact_bayes" not in told
