"""The groups of `scripts/benchmark.py`."""

import importlib

import benchmark
import pytest


@pytest.mark.parametrize("name", benchmark.GROUPS)
def test_a_group_gives_figures(name):
    assert callable(importlib.import_module(f"benchmarks.{name}").figures)


def test_an_unknown_group_is_refused(capsys):
    assert benchmark.main(("nothing",)) == 2
    assert "unknown group 'nothing'; known are" in capsys.readouterr().err
