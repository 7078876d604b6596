"""The README's snippets run, and what it names is there."""

import re

import pytest
from snippets import ROOT, blocks, run_command, run_python

README = (ROOT / "README.md").read_text(encoding="utf-8")
PYTHON = [text for _, text in blocks(ROOT / "README.md", "python")]
SHELL = [text for _, text in blocks(ROOT / "README.md", "sh")]


@pytest.mark.parametrize("number", range(len(PYTHON)))
def test_python_snippet(number, tmp_path):
    printed = run_python(PYTHON[number], tmp_path)
    if "class Luenberger" in PYTHON[number]:
        tail, diverged = printed.split()
        assert float(tail) < 0.2
        assert diverged == "False"


def test_the_first_result(tmp_path):
    (command,) = (s for s in SHELL if s.startswith("pinnobs evaluate"))
    printed = run_command(command, tmp_path).splitlines()
    assert any(line.split()[:2] == ["1", "ekf"] for line in printed)
    assert printed[-1].startswith("next: pinnobs ")


def test_it_is_short():
    assert len(README.splitlines()) < 200


def test_there_is_a_snippet_of_each_kind():
    for words in ("gym.make(", "class Luenberger(Estimator)", "class VanDerPol(System)"):
        assert any(words in snippet for snippet in PYTHON), words


def test_an_env_is_made_by_the_prefix_alone_and_not_without_it(tmp_path):
    (call,) = re.findall(r'gym\.make\("pinnobs_gym:[^`]*', README)
    run_python(f"import gymnasium as gym\n{call}.reset(seed=0)", tmp_path)
    plain = call.replace("pinnobs_gym:", "")
    refused = f"try:\n    {plain}\nexcept gym.error.NamespaceNotFound:\n    print('not found')"
    assert run_python(f"import gymnasium as gym\n{refused}", tmp_path).strip() == "not found"


def test_the_custom_estimator_takes_fifteen_lines():
    (snippet,) = (s for s in PYTHON if "class Luenberger" in s)
    body = snippet.partition("@dataclass")[2].partition("\n\n\n")[0]
    assert len([line for line in ("@dataclass" + body).splitlines() if line.strip()]) <= 15


def test_the_estimate_command(tmp_path):
    (snippet,) = (s for s in PYTHON if "class VanDerPol" in s)
    (tmp_path / "my_module.py").write_text(snippet)
    (tmp_path / "log.csv").write_text("t,y1\n" + "".join(f"{k / 20},{1.5}\n" for k in range(20)))
    (command,) = (s for s in SHELL if "pinnobs estimate" in s)
    run_command(command, tmp_path)
    assert (tmp_path / "estimates.csv").read_text().startswith("t,position,velocity,position_std")
    assert (tmp_path / "estimates.png").stat().st_size > 1000


def test_make_targets_files_and_options_it_names_are_there():
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"^make ([a-z-]+)|`make ([a-z-]+)", README, re.M))
    assert len(targets) > 5
    for target in targets:
        assert f"\n{''.join(target)}:" in makefile, target
    paths = re.findall(r"(?:\]\(|`python )((?:docs|scripts)/[\w./]+)", README)
    assert len(paths) > 5
    for path in paths:
        assert (ROOT / path).exists(), path
