"""The documentation: every page is there, links lead somewhere, and its code runs."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest
from snippets import ROOT, cells, run_cells, run_page
from waiting import PATIENCE

from pinnobs_gym import Setup, System
from pinnobs_gym.cli.system_page import page
from pinnobs_gym.estimation.estimator import Estimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.scoring.metrics import OPTIONAL_SCORES, SCORES
from pinnobs_gym.scoring.row_format import JOB, KEY
from pinnobs_gym.simulation.conditions import CONDITIONS
from pinnobs_gym.simulation.system import stack
from pinnobs_gym.systems import SYSTEMS

DOCS = ROOT / "docs"
WRITTEN = sorted(path for path in DOCS.rglob("*.md") if path.parts[len(DOCS.parts)] != "reference")
GUIDES = sorted((DOCS / "guides").glob("*.md"))
PLANTS = [path for path in GUIDES if any("%%writefile" in text for _, text in cells(path))]
"""Guides to a kind of plant and its log. Other pages with cells train networks in them, and are run
only when the documentation is built."""


@pytest.fixture(scope="module")
def generated():
    """The module that makes pages, and the pages."""
    sys.path.insert(0, str(DOCS))
    try:
        import pages
    finally:
        sys.path.remove(str(DOCS))
    return pages, pages.pages()


def test_everything_that_is_found_has_a_page(generated):
    _, texts = generated
    names = {"systems": SYSTEMS.classes(), "estimators": ESTIMATORS.classes()}
    names["trainers"] = TRAINERS.sources
    for kind, found in names.items():
        assert len(found) > 5
        for name in found:
            assert f"{kind}/{name}.md" in texts
            assert f"[{name}]({name}.md)" in texts[f"{kind}/index.md"]
            assert f"\n{name} <{name}>\n" in texts[f"{kind}/index.md"]  # in the contents, too
    for name in CONDITIONS:
        assert f"| `{name}` " in texts["conditions.md"]
    for name in (*SCORES, *OPTIONAL_SCORES, "diverged"):
        assert re.search(rf"``?{name}``?", texts["metrics.md"]), name
    for name in (*KEY, *JOB):
        assert f"``{name}``" in texts["row_schema.txt"]


def test_a_systems_page_is_the_commands_and_its_equations(generated):
    pages, texts = generated
    text = pages.system_page(SYSTEMS.resolve("InductionMotor"))
    for part in page(SYSTEMS.resolve("InductionMotor"), "pinnobs/InductionMotor-v0").split("\n\n"):
        assert part.strip() in text
    assert r"\dot{\omega} &= - \frac{T_{L}}{J}" in text
    assert "| $T_{L}$ | `T_L` | 10 | Load torque (N·m). |" in text
    for name in SYSTEMS.classes():
        assert r"\frac{\partial f}{\partial x} &= " in texts[f"systems/{name}.md"]


@dataclass(frozen=True)
class Tabulated(System):
    """x' falls with x, by a table that cannot be traced."""

    state_names = ("x",)
    output_names = ("y",)
    scale = (1.0,)
    setups = {"benchmark": Setup((-1,), (1,), duration=1, dt=0.1)}

    def f(self, t, x, u):
        return stack(x, np.interp(np.asarray(x[..., 0], dtype=float), (-1.0, 1.0), (1.0, -1.0)))

    def h(self, t, x, u):
        return x


def test_the_page_of_a_system_that_cannot_be_traced_says_so(generated):
    text = generated[0].system_page(Tabulated)
    assert "x' falls with x, by a table that cannot be traced." in text
    assert "Tabulated cannot be traced: TypeError" in text


def test_an_estimators_page_has_its_settings_and_equations(generated):
    _, texts = generated
    text = texts["estimators/ekf.md"]
    assert "| `patience` | `15` | How many samples in a row may be beyond the gate. |" in text
    assert "| `assumed_noise` | `0.003` | Standard deviation" in text  # inherited
    assert "model, prior, noise" in text
    for name, cls in ESTIMATORS.classes().items():
        assert cls.equations.strip() in texts[f"estimators/{name}.md"]


@pytest.mark.parametrize("name", ESTIMATORS.classes())
def test_equations_are_balanced(name):
    text = ESTIMATORS.classes()[name].equations
    assert text.strip()
    assert not re.search(r"[^\x00-\x7f]", text)  # MathJax and LaTeX take no Unicode in words
    plain = re.sub(r"\\[{}]", "", text)
    assert plain.count("{") == plain.count("}")
    assert text.count(r"\left") == text.count(r"\right")
    for size in ("big", "Big"):
        assert len(re.findall(rf"\\{size}l\b", text)) == len(re.findall(rf"\\{size}r\b", text))
    lines = re.split(r"\\\\(?:\n|$)", text.strip())
    assert all(line.count("&") == 1 for line in lines), lines


def test_an_estimator_needs_no_equations(generated):
    class Silent(Estimator):
        """Says nothing."""

        def reset(self, prior): ...

        def update(self, state, t, y, u): ...

    assert Silent.equations == ""
    assert "Equations" not in generated[0].estimator_page("silent", Silent)


def test_a_trainers_page_has_each_preset(generated):
    _, texts = generated
    text = texts["trainers/pinn_obs.md"]
    assert "| name | guided | plain | transfer | paper | meaning |" in text
    assert "| `depth` | `3` | `3` | `3` | `9` | Number of hidden layers. |" in text
    assert "[`pinn_obs_replay`](../estimators/pinn_obs_replay.md)" in text
    assert "| `cutoff` | `None` | `None` |" in texts["trainers/kkl_pinn.md"]  # of its base class
    assert "| `faithful` | Niazi et al.'s recipe: " in texts["trainers/kkl_pinn.md"]


def test_links_of_written_pages_lead_to_files(generated):
    _, texts = generated
    known = {(DOCS / "reference" / name).resolve() for name in texts}
    seen = 0
    for path in WRITTEN:
        text = path.read_text(encoding="utf-8")
        links = re.findall(r"\]\((?!https?:)([^)#]+)", text)
        links += re.findall(r"^```\{include\} (\S+)", text, re.M)
        for link in links:
            target = (path.parent / link).resolve()
            assert target in known or target.is_file(), f"{path.name}: {link}"
        seen += len(links)
    assert seen > 15
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    for path in GUIDES:
        assert f"\nguides/{path.stem}\n" in index


@pytest.mark.parametrize("path", GUIDES, ids=lambda path: path.stem)
def test_the_code_of_a_guide_runs(path, tmp_path):
    run_page(path, tmp_path)


@pytest.mark.parametrize("path", PLANTS, ids=lambda path: path.stem)
def test_the_cells_of_a_guide_run_and_take_few_lines(path, tmp_path):
    """What a reader writes is the model and the calls; the cell that simulates a log is hidden."""
    printed = run_cells(path, tmp_path)
    assert "estimates: estimates.csv; picture: estimates.png" in printed
    wrong = "ekf.csv" in printed  # of an estimator that does not suit the plant, as is shown
    assert printed.count("warning: ") == wrong
    own = [text for options, text in cells(path) if "hide-input" not in options]
    assert any("assert" in text for text in own)  # that the estimates are right
    assert any('Image("estimates.png"' in text for text in own)
    assert len([line for text in own for line in text.splitlines() if line.strip()]) < 60


def test_the_first_steps_run_and_are_stripped(tmp_path):
    path = DOCS / "first_steps.ipynb"
    printed = run_cells(path, tmp_path).splitlines()
    ekf, mine = (float(line.split()[-1]) for line in printed[-2:])
    assert ekf < mine < 0.2  # as the picture shows
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        assert cell["cell_type"] == "markdown" or not cell["outputs"]
    links = re.findall(r"\]\(([^)]+)\)", path.read_text(encoding="utf-8"))
    assert links
    assert all((DOCS / link).is_file() for link in links)


@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: path.stem)
def test_no_place_of_a_page_is_left_to_be_filled(path):
    assert not re.search(r"^[A-Z]+(_[A-Z]+)+$", path.read_text(encoding="utf-8"), re.MULTILINE)


def test_there_are_guides_to_many_kinds_of_plants():
    assert len(PLANTS) > 6


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_shows_what_it_ran(tmp_path):
    shutil.copytree(DOCS, tmp_path / "docs", ignore=shutil.ignore_patterns("_build", "reference"))
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "docs", "site"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    site, seen = tmp_path / "site", 0
    tutorial = (site / "tutorial.html").read_text(encoding="utf-8")
    assert tutorial.count('src="_images/') == 2  # the pictures of its episodes
    assert "mine is better than the EKF in" in tutorial
    assert "<img" in (site / "reference/systems/Satellite.html").read_text(encoding="utf-8")
    for path in site.rglob("*.html"):
        for link in re.findall(
            r'(?:href|src)="(?!https?:|#|data:|mailto:)([^"#?]+)', path.read_text()
        ):
            assert (path.parent / link).exists(), f"{path.relative_to(site)}: {link}"
            seen += 1
    assert seen > 1000
