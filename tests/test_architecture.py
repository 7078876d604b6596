"""Which module may import which, read from the source."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import pinnobs_gym

ROOT = Path(pinnobs_gym.__file__).parent

ALLOWED = {
    "system": set(),
    "registry": set(),
    "record": {"system"},
    "simulate": {"system"},
    "conditions": {"system"},
    "estimator": {"system", "record", "simulate"},
    "checks": {"checks", "system", "simulate", "estimator", "record"},
    "systems": {"system", "registry"},
    "actions": {"estimator", "kalman", "simulate", "system"},
    "bound": {"kalman", "metrics", "record", "simulate", "system"},
    "curves": {"figures", "report", "rows", "system"},
    "site": {"conditions", "curves", "leaderboard", "overview", "rows", "site", "systems"},
    "consistency": {"estimator", "kalman"},
    "kalman": {"estimator", "record", "simulate", "system"},
    "gains": {"simulate", "system"},
    "least_squares": {"kalman", "simulate", "system"},
    "smoother": {"kalman", "record", "simulate", "system"},
    "sigma_points": {"estimator", "kalman", "record", "simulate"},
    "network": {"system"},
    "quasi_newton": set(),
    "kkl": {
        "estimator",
        "kkl",
        "log",
        "record",
        "simulate",
        "system",
        "trained_file",
        "training",
    },
    "estimators": {
        "actions",
        "estimator",
        "estimators",
        "gains",
        "kalman",
        "kkl",
        "least_squares",
        "network",
        "record",
        "registry",
        "sigma_points",
        "simulate",
        "smoother",
        "system",
        "trained_file",
    },
    "trained_file": {"system"},
    "training": set(),
    "symbolic": {"system"},
    "docstrings": set(),
}
"""What a module or subpackage may import of ours; itself is a case of its own below."""
FORBIDDEN = {
    "env": {"estimator", "estimators", "evaluation", "trainers"},
    "agent_side": {"env", "estimator", "estimators", "evaluation", "trainers"},
    "wrappers": {"estimator", "estimators", "evaluation", "trainers"},
    "sb3_env": {"estimator", "estimators", "evaluation", "trainers"},
    "episodes": {"env", "estimator", "estimators", "evaluation", "trainers"},
    "evaluation": {"trainers"},
}


def modules() -> dict[str, Path]:
    """All modules of the package by dotted name below it; a package by its own name."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        found[name.removesuffix(".__init__") if name != "__init__" else name] = path
    return found


def imports(source: str, module: str, is_package: bool = False) -> set[str]:
    """What of ours a module's source imports, wherever it stands: dotted names below pinnobs_gym,
    and ``trainers``."""
    found = set()
    package = ["pinnobs_gym", *module.split(".")]
    package = package if is_package else package[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            names = [base]
            if base == "pinnobs_gym" or base in {"pinnobs_gym.systems", "pinnobs_gym.estimators"}:
                names = [f"{base}.{a.name}" if a.name.islower() else base for a in node.names]
        else:
            continue
        for name in names:
            if name.split(".")[0] == "trainers":
                found.add("trainers")
            elif name.split(".")[0] == "pinnobs_gym":
                found.add(name.removeprefix("pinnobs_gym").removeprefix(".") or "__init__")
    return found


def imported(module: str) -> set[str]:
    path = modules()[module]
    return imports(path.read_text(encoding="utf-8"), module, path.name == "__init__.py")


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import numpy as np\nfrom __future__ import annotations", set()),
        ("from pinnobs_gym.system import System", {"system"}),
        ("import pinnobs_gym.env", {"env"}),
        ("def f():\n    from pinnobs_gym import env, System", {"env", "__init__"}),
        ("if TYPE_CHECKING:\n    from trainers.kkl import train", {"trainers"}),
        ("from .. import env", {"env"}),
        ("from .ekf import EKF", {"estimators.ekf"}),
        ("from pinnobs_gym.estimators import ekf", {"estimators.ekf"}),
    ],
)
def test_imports_are_read(source: str, expected: set[str]) -> None:
    assert imports(source, "estimators.ukf") == expected


@pytest.mark.parametrize("module", modules())
def test_imports_only_what_it_may(module: str) -> None:
    top = module.split(".")[0]
    if top in ALLOWED:
        wrong = {name for name in imported(module) if name.split(".")[0] not in ALLOWED[top]}
        assert not wrong, f"{module} imports {wrong}; it may import {ALLOWED[top]}"


@pytest.mark.parametrize("module", FORBIDDEN)
def test_does_not_import_what_it_must_not(module: str) -> None:
    wrong = {name for name in imported(module) if name.split(".")[0] in FORBIDDEN[module]}
    assert not wrong, f"{module} imports {wrong}"


@pytest.mark.parametrize("module", modules())
def test_does_not_import_trainers(module: str) -> None:
    assert "trainers" not in imported(module)


@pytest.mark.parametrize("module", modules())
def test_nothing_imports_the_roof(module: str) -> None:
    """The command's own modules stand above all others, and beside each other."""
    above = {"cli", "commands", "console", "options"}
    wrong = {name for name in imported(module) if name.split(".")[0] in above}
    assert module.split(".")[0] in above or not wrong, f"{module} imports {wrong}"


def test_tables_name_modules_that_exist() -> None:
    tops = {name.split(".")[0] for name in modules()}
    assert set(ALLOWED) | set(FORBIDDEN) <= tops


def test_finding_estimators_loads_no_agents_library() -> None:
    code = "import sys; from pinnobs_gym.estimators import ESTIMATORS; ESTIMATORS.classes(); "
    code += "sys.exit('stable_baselines3' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.parametrize("heavy", ["torch", "matplotlib", "stable_baselines3"])
def test_import_is_light(heavy: str) -> None:
    make = "import gymnasium; gymnasium.make('pinnobs/ReverseDuffing-v0').reset(seed=0)"
    code = f"import sys, pinnobs_gym; {make}; sys.exit({heavy!r} in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
