"""Every command and every block of the page of twenty tasks works, in its order, in one folder."""

import importlib.util
import re
import shlex
import shutil

import pytest
from snippets import ROOT, blocks, run_python

PAGE = ROOT / "docs" / "tasks.md"
COMPILER = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
LEFT_OUT = ("tensorboard ", "cc ") if COMPILER is None else ("tensorboard ",)
"""Beginnings of lines that are not run: a server, which does not end, and an absent compiler."""
SHORT = {
    r"(robust_gain .*) --budget 10": r"\1 --iterations 4 --per-condition 1",
    r"--budget \d+": "--budget 0.5",
    r"(kkl_pinn .*) --budget 0.5 --resume": r"\1 --budget 1 --resume",
    r"learn\(4096\)": "learn(8)",
    r'"MlpPolicy", env': '"MlpPolicy", env, n_steps=8, batch_size=8',
    r"--trials 5 --episodes 8": "--trials 2 --episodes 2",
    r"\ncheck_env\((.*)\)": r"""
import warnings
with warnings.catch_warnings(action="ignore"):
    check_env(\1)""",
}
"""What is made shorter in the test, and the one call that is meant to warn."""


def own_modules(folder):
    """Write the two classes of the README as the files that the page names."""
    classes = [text for _, text in blocks(ROOT / "README.md", "python")]
    for name, module, rest in (
        ("Luenberger", "my_module", "\n\ncheck_estimator("),
        ("VanDerPol", "my_plant", "\n\nenv = "),
    ):
        (text,) = (each for each in classes if f"class {name}(" in each)
        assert rest in text
        (folder / f"{module}.py").write_text(text.partition(rest)[0] + "\n", encoding="utf-8")


def calls():
    """What the page does, as Python, in its order."""
    parts = []
    for kind, text in blocks(PAGE, "python", "sh"):
        for pattern, shorter in SHORT.items():
            text = re.sub(pattern, shorter, text)
        if kind == "python":
            parts.append(text)
            continue
        for line in text.splitlines():
            if line.startswith("pinnobs "):
                parts.append(f"assert main({shlex.split(line)[1:]!r}) == 0, {line!r}\n")
            elif not line.startswith(LEFT_OUT):
                words = [str(COMPILER), *shlex.split(line)[1:]]
                assert line.startswith("cc "), line
                parts.append(f"import subprocess\nsubprocess.run({words!r}, check=True)\n")
    return parts


def test_the_tasks_are_twenty_and_short():
    text = PAGE.read_text(encoding="utf-8")
    numbers = re.findall(r"^## (\d+)\. ", text, re.MULTILINE)
    assert numbers == [str(number) for number in range(1, 21)]
    for section in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        words = re.sub(r"^```.*?^```", "", section, flags=re.MULTILINE | re.DOTALL)
        assert len([line for line in words.splitlines()[1:] if line.strip()]) <= 2, section
    assert "\ntasks\n" in (ROOT / "docs" / "index.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_tasks_work(tmp_path):
    for name in ("pandas", "altair", "optuna", "moviepy"):
        if importlib.util.find_spec(name) is None:
            pytest.skip(f"{name} is not installed")
    own_modules(tmp_path)
    run_python("from pinnobs_gym.cli import main\n" + "".join(calls()), tmp_path)
    for name in ("estimates.png", "also.csv", "ekf.c", "site/index.html", "ekf.mp4"):
        assert (tmp_path / name).stat().st_size > 0
