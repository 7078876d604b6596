"""The rooms of the package: what they may import, and what importing them loads."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from waiting import PATIENCE

import pinnobs_gym
from pinnobs_gym.estimators import ESTIMATORS

ROOT = Path(pinnobs_gym.__file__).parent
REPOSITORY = Path(__file__).parents[1]  # the package may be installed elsewhere


def test_rooms_import_downwards_only() -> None:
    """The contract of pyproject.toml, indirect imports included."""
    command = [
        sys.executable,
        "-c",
        "from importlinter.cli import lint_imports_command as run; run()",
    ]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stdout


def test_the_root_has_at_most_a_dozen_names() -> None:
    names = {path.stem for path in ROOT.iterdir() if not path.name.startswith(("_", "."))}
    assert len(names - {"py"}) <= 12, names


def loaded(code: str, *modules: str) -> set[str]:
    """Which of these modules a fresh process has loaded after it ran the code."""
    ask = f"import sys\n{code}\nprint(*[m for m in {modules!r} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", ask], capture_output=True, text=True, timeout=PATIENCE, check=True
    )
    return set(done.stdout.splitlines()[-1].split())


HEAVY = ("torch", "matplotlib", "stable_baselines3", "scipy.stats", "scipy.optimize")


def test_importing_the_package_and_making_an_env_is_light() -> None:
    make = "import gymnasium; gymnasium.make('pinnobs/ReverseDuffing-v0').reset(seed=0)"
    assert not loaded(f"import pinnobs_gym\n{make}", *HEAVY)


def test_importing_the_package_imports_no_system() -> None:
    assert not loaded("import pinnobs_gym", "pinnobs_gym.simulation.system", "numpy.polynomial")


def zoo_exceptions() -> list[str]:
    """The imports within the zoos that the contract allows, as "importer -> imported"."""
    settings = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))
    return settings["tool"]["importlinter"]["contracts"][2]["ignore_imports"]


RESOLVED = """
import json, os, sys
from pinnobs_gym.estimators import ESTIMATORS

def resolve(names):
    for name in names:
        read, write = os.pipe()
        if not os.fork():
            ESTIMATORS.resolve(name)
            with open(write, "w") as file:
                json.dump(sorted(sys.modules), file)
            os._exit(0)
        os.close(write)
        with open(read) as file:
            found[name] = json.load(file)
        os.wait()

found, (light, others) = {}, json.loads(sys.argv[1])
resolve(light)
if others:
    import torch
resolve(others)
print(json.dumps(found))
"""


def learns(name: str) -> bool:
    return bool({"needs_training", "trains_on_record"} & set(ESTIMATORS.sources[name].constants))


@pytest.fixture(scope="module")
def resolved() -> dict[str, list[str]]:
    """What a process has loaded that has resolved nothing but one estimator, by its name: a fork
    of one that has loaded the registry, and for those that learn, torch."""
    kinds = [[n for n in ESTIMATORS.sources if learns(n) == kind] for kind in (False, True)]
    command = [sys.executable, "-W", "ignore", "-c", RESOLVED, json.dumps(kinds)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=True)
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", ESTIMATORS.sources)
def test_an_estimator_is_resolved_alone(name: str, resolved: dict[str, list[str]]) -> None:
    """Neither the others, but for those that it derives from, nor what they need are imported."""
    source = ESTIMATORS.sources[name]
    own = {each.__module__ for each in ESTIMATORS.resolve(name).__mro__}
    # What the contract of imports allows one estimator to run inside of it
    allowed = [line.split(" -> ") for line in zoo_exceptions()]
    own |= {imported for importer, imported in allowed if importer == source.module}
    others = {each.module for each in ESTIMATORS.sources.values()} - {source.module, *own}
    assert others
    assert source.module in resolved[name]
    assert not {*(() if learns(name) else HEAVY), *others} & {*resolved[name]}


def test_the_leaderboard_loads_no_statistics_before_they_are_computed() -> None:
    paths = [path.relative_to(ROOT.parent) for path in (ROOT / "leaderboard").rglob("*.py")]
    names = [".".join(path.with_suffix("").parts) for path in paths]
    assert {"pinnobs_gym.leaderboard.ranks", "pinnobs_gym.leaderboard.site.page"} < set(names)
    # It plays networks, and is imported where there is one.
    names.remove("pinnobs_gym.leaderboard.published.on_record")
    assert not loaded("\n".join(f"import {name}" for name in names), *HEAVY)


def test_evaluating_a_filter_loads_neither_torch_nor_statistics(tmp_path) -> None:
    arguments = [
        "evaluate",
        "--system",
        "ReverseDuffing",
        "--episodes",
        "1",
        "--out",
        str(tmp_path),
    ]
    code = f"from pinnobs_gym.cli import main; assert main({arguments!r}) == 0"
    assert not loaded(code, "torch", "scipy.stats", "scipy.integrate", "stable_baselines3")


def test_finding_all_estimators_loads_no_agents_library() -> None:
    code = "from pinnobs_gym.estimators import ESTIMATORS; ESTIMATORS.classes()"
    assert not loaded(code, "stable_baselines3")


def test_the_names_of_trainers_are_known_without_importing_them() -> None:
    code = "from pinnobs_gym.registry import TRAINERS; assert 'pinn_obs' in TRAINERS.sources"
    assert not loaded(code, "torch", "trainers.pinn_obs")
