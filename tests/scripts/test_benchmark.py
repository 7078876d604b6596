"""The groups of `scripts/benchmark.py`."""

import importlib

import benchmark
import pytest
import three_recipes
from benchmarks import kernels, pinn, ranking
from made_rows import rows_of


@pytest.mark.parametrize("name", benchmark.GROUPS)
def test_a_group_gives_figures(name):
    assert callable(importlib.import_module(f"benchmarks.{name}").figures)


def test_an_unknown_group_is_refused(capsys):
    assert benchmark.main(("nothing",)) == 2
    assert "unknown group 'nothing'; known are" in capsys.readouterr().err


def test_missing_peers_are_named(monkeypatch, capsys):
    monkeypatch.setattr(kernels, "find_spec", lambda name: name == "filterpy" or None)
    assert next(kernels.figures(1)).value == 2
    assert capsys.readouterr().err == "not installed: dynamax, cuthbert; left out\n"


def test_the_table_of_pinn_obs_has_a_line_for_each_recipe(monkeypatch):
    """Errors of 1 to 5 by the seed: median 3, worst 5; a replay that diverges for one seed."""

    class Trained:
        def __init__(self, seed):
            self.seconds = self.error = 1.0 + seed

    class Made:
        of = staticmethod(lambda name: Made())
        trained = staticmethod(lambda config: Trained(config.seed))
        direct = staticmethod(lambda trained: trained.error)
        replayed = staticmethod(lambda t: float("nan") if t.error == 2 else 10 * t.error)

    monkeypatch.setattr(three_recipes, "Case", Made)
    found = [vars(figure) for figure in three_recipes.paper_setup("ReverseDuffing")]
    table = pinn.readme_table(found).splitlines()
    cells = "3 | 5 | 40 | diverges | 3.0 |"
    assert table[-3].startswith("| ReverseDuffing | paper | 0.045 | 0.045 | 0.253 | 0.253 |")
    assert table[-2] == f"| ReverseDuffing | fast, paper's loss | {cells}"
    assert table[-1] == f"| ReverseDuffing | fast, guided by a smoother | {cells}"


def test_errors_over_the_floor_and_its_precision_are_figures():
    rows = rows_of("ukf", [0.2] * 12)
    exact = rows_of("exact_bayes", [0.1] * 12, track="floor", effective_sample_size=700.0)
    exact[3]["effective_sample_size"] = 400.0
    found = {figure.figure: figure for figure in ranking.over_floor(rows, exact)}
    steady = found["X-v0, benchmark, nominal: ukf over the floor, steady (2-2)"]
    assert steady.value == pytest.approx(2)
    size = found["X-v0, benchmark, nominal, floor: smallest effective sample size of 12 episodes"]
    assert (size.value, size.holds) == (400, False)
    assert len(found) == 3
    assert list(ranking.over_floor(rows)) == []
