"""The documentation: every page is there, links lead somewhere, and its code runs."""

import importlib
import json
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass, fields, is_dataclass
from xml.etree import ElementTree

import nbformat
import numpy as np
import pytest
from myst_nb.core.read import read_myst_markdown_notebook
from snippets import ROOT, cells, run_cells, run_page
from waiting import PATIENCE

import pinnobs_gym
from pinnobs_gym import Setup, System
from pinnobs_gym.cli import COMMANDS
from pinnobs_gym.cli.system_page import page
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import Estimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.open_loop import OpenLoop
from pinnobs_gym.leaderboard.suites import Entry, Suite
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.scoring.metrics import OPTIONAL_SCORES, SCORES
from pinnobs_gym.scoring.playing import play
from pinnobs_gym.scoring.row_format import JOB, KEY
from pinnobs_gym.simulation.conditions import CONDITIONS
from pinnobs_gym.simulation.system import stack
from pinnobs_gym.systems import SYSTEMS
from trainers.pinn_obs import PinnObsTrainer

DOCS = ROOT / "docs"
WRITTEN = sorted(path for path in DOCS.rglob("*.md") if path.parts[len(DOCS.parts)] != "reference")
GUIDES = sorted((DOCS / "guides").glob("*.md"))
PLANTS = [path for path in GUIDES if any("%%writefile" in text for _, text in cells(path))]
"""Guides to a kind of plant and its log. Other pages with cells train networks in them, and are run
only when the documentation is built."""
EXECUTED = [path for path in (*WRITTEN, DOCS / "first_steps.ipynb") if cells(path)]


@pytest.fixture(scope="module")
def generated():
    """The module that makes pages, and the pages."""
    sys.path.insert(0, str(DOCS))
    try:
        import mathml  # noqa: F401
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


def test_every_public_name_has_an_entry(generated):
    """Against the lines of the sources that begin a class or a function of a module."""
    _, texts = generated
    entries = "\n".join(text for name, text in texts.items() if name.startswith("api/"))
    seen = 0
    for folder in (ROOT / "pinnobs_gym", ROOT / "trainers"):
        for path in folder.rglob("*.py"):
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            module = module.removesuffix(".__init__")
            defined = r"^(?:async def|def|class) ([A-Za-z]\w*)"
            for name in re.findall(defined, path.read_text(encoding="utf-8"), re.MULTILINE):
                entry = rf"\n`+\{{py:(class|function)\}} {name}\b"
                own = entries.partition(f"\n## `{module}`\n")[2].partition("\n## `")[0]
                assert re.search(entry, own), f"{module}.{name}"
                seen += 1
    assert seen > 1000
    for name in pinnobs_gym.__all__:
        assert name.startswith("_") or f"{{py:obj}}`{name} <" in texts["api/index.md"], name


def test_every_option_of_a_command_is_on_their_page(generated):
    text = generated[1]["commands.md"]
    seen = 0
    for name in COMMANDS:
        section = text.partition(f"\n## {name}\n")[2].partition("\n## ")[0]
        module = importlib.import_module(f"pinnobs_gym.cli.commands.{name}")
        commands = [c for c in vars(module).values() if is_dataclass(c) and hasattr(c, "run")]
        for command in (each for each in commands if each.__module__ == module.__name__):
            for field in fields(command):
                if "Positional" in str(field.type) or "Options" in str(field.type):
                    continue
                if field.name != "config":  # of `train`, which are on the trainers' pages
                    assert f"--{field.name.replace('_', '-')}" in section, f"{name} {field.name}"
                    seen += 1
    assert seen > 80
    assert "| `--seed INT` | Seed of the first episode. (default: 0) |" in text
    assert "| `--trained PATH` | Trained estimator to load; published" in text
    assert "None}" not in text


def test_every_key_of_a_suite_is_on_their_page(generated):
    text = generated[1]["suites.md"]
    for cls in (Suite, Entry):
        for field in fields(cls):
            assert field.kw_only or f"| `{field.name}` | " in text
    assert "| `episodes` | `100` | at least 1, at most 10000000 | Episodes of each" in text
    assert "| `systems` | `[]` | a list of names | Names or" in text
    assert "| `budgets` | `[45.0]` | a list of positive" in text
    assert "`quick`:\n\n```toml\n# Less than a minute" in text


@pytest.mark.parametrize("name", ESTIMATORS.classes())
def test_an_estimators_page_says_when_to_choose_it(generated, name):
    pages, texts = generated
    _, choice = pages.split_choice(ESTIMATORS.classes()[name])
    assert len(choice) > 40, f"its docstring has no paragraph that begins with {pages.CHOICE!r}"
    assert f"\n## When to choose it\n\n{choice}\n" in texts[f"estimators/{name}.md"]
    assert pages.CHOICE not in texts[f"estimators/{name}.md"]


def test_pages_have_the_published_scores(generated):
    _, texts = generated
    system, estimator = texts["systems/Academic.md"], texts["estimators/ukf.md"]
    line = re.search(r"\| \[ukf\]\(../estimators/ukf.md\) \| online \| (.*) \|", system)
    assert line is not None
    assert f"| [Academic](../systems/Academic.md) | ukf | `nominal` | {line[1]} |" in estimator
    rank, steady, transient, *_ = line[1].split(" | ")
    assert int(rank) >= 1
    assert 0 < float(steady) < float(transient) < 1


def test_an_estimator_without_published_scores_has_a_page(generated):
    class Unheard(OpenLoop):
        """Says when."""

        name = "unheard"

    text = generated[0].estimator_page("unheard", Unheard)
    assert "Published scores" not in text
    assert "When to choose" not in text


def test_every_equation_becomes_mathml(generated):
    from mathml import mathml

    _, texts = generated
    seen = 0
    for name, text in texts.items():
        for equation in re.findall(r"^```\{math\}\n(.*?)\n```$", text, re.MULTILINE | re.DOTALL):
            tree = ElementTree.fromstring(mathml(equation, block=True))
            said = "".join(tree.itertext())
            assert not re.search(r"[\\&]|begin|frac|left", said), name
            assert tree.find(".//mtr") is not None
            assert tree.get("display") == "block"
            seen += 1
    assert seen > 30


def test_an_index_stands_beside_a_sign_with_an_accent(generated):
    from mathml import mathml

    tree = ElementTree.fromstring(mathml(r"\hat x_k^-", block=False))
    (index,) = tree
    base, below, above = index
    assert (index.tag, base.tag, below.text, above.text) == ("msubsup", "mover", "k", "−")
    assert [part.text for part in base] == ["x", "ˆ"]


def test_fractions_bars_and_labels_are_drawn_as_they_are_written(generated):
    """docutils reads \\tfrac12 e as twelve over e, and bars grow by what follows them."""
    from mathml import mathml

    def drawn(latex):
        return ElementTree.fromstring(mathml(latex, block=False))

    half, after = drawn(r"\tfrac12 e")
    assert ([part.text for part in half], after.text) == (["1", "2"], "e")
    norm = drawn(r"\|v\|_M^2 + |a|")
    bars = [each for each in norm.iter("mo") if each.text in "‖|"]
    assert [each.get("stretchy") for each in bars] == ["false"] * 4
    grown = drawn(r"\left|\frac{x}{y}\right|")
    assert all(each.get("stretchy") != "false" for each in grown.iter("mo"))
    (label,) = drawn(r"\text{process noise: }").iter("mtext")
    assert label.text == "process\xa0noise:\xa0"


SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_a_system_has_a_moving_picture(generated, name):
    """Which begins at the first guess, and whose lines are the truth and the estimate."""
    pages, texts = generated
    assert f"({name}.svg)" in texts[f"systems/{name}.md"]
    game = Game.of(name)
    played = play(game, OpenLoop.for_setup(game.source.system, game.source.setup), [0])
    text = pages.moving_picture(played, "a < b")
    assert len(text) < 300_000
    tree = ElementTree.fromstring(text)
    assert tree.findtext(f"{SVG}title") == "a < b"
    groups = [g for g in tree.iter(f"{SVG}g") if g.get("clip-path")]
    guesses = [c for c in tree.iter(f"{SVG}circle") if c.get("fill") == "none"]
    assert len(groups) == len(guesses) == game.source.system.nx
    motion = re.findall(r"prefers-reduced-motion:reduce\)\{([^}]*)\}", text)
    assert motion == [".cover,.dot{display:none"]
    end = 3 * game.source.setup.transient_end
    last = np.flatnonzero(played.record.t <= min(end, game.source.setup.duration))[-1]
    for i, (group, guess) in enumerate(zip(groups, guesses, strict=True)):
        truth, estimate = [
            [tuple(map(float, point.split())) for point in re.split("[ML]", path.get("d", ""))[1:]]
            for path in group
            if path.get("fill") == "none"
        ]
        assert estimate[0] == (float(guess.get("cx", 0)), float(guess.get("cy", 0)))
        x, prior = played.truth[0, :, i], played.record.prior.mean[0, i]
        # Heights are linear in values: two of them give the scale, a third one has to fit.
        heights = np.array([truth[0][1], estimate[0][1], truth[-1][1]])
        values = np.array([x[0], prior, x[last]])
        if abs(values[1] - values[0]) > 0.05 * np.ptp(values):
            slope = (heights[1] - heights[0]) / (values[1] - values[0])
            assert heights[2] == pytest.approx(heights[0] + slope * (values[2] - values[0]), abs=4)


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
    assert "| name | what it is | what it changes of `guided` |" in text
    assert "| `depth` | `3` | Number of hidden layers" in text
    first, presets = PinnObsTrainer.configured({}), text.partition("## Config")[0].splitlines()
    for preset in PinnObsTrainer.presets:
        (line,) = [each for each in presets if each.startswith(f"| `{preset}` |")]
        other = PinnObsTrainer.configured({"preset": preset})
        for field in fields(first):
            told = f"`{field.name}=" in line
            assert told == (getattr(other, field.name) != getattr(first, field.name))
    assert "`depth=9`" in text
    assert "[`pinn_obs_replay`](../estimators/pinn_obs_replay.md)" in text
    assert "| `cutoff` | `None` |" in texts["trainers/kkl_pinn.md"]  # of its base class
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


@pytest.mark.parametrize("path", EXECUTED, ids=lambda path: path.stem)
def test_pictures_of_cells_have_an_alternative_text(path):
    """Without one, myst-nb gives the name of a file, which says nothing to who cannot see it."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        notebook = nbformat.reads(text, as_version=4)
    else:
        notebook = read_myst_markdown_notebook(text)
    drawing = ("Image(", ".figure(", "plt.subplots(", "plot(record", "shown(")
    for cell in notebook.cells:
        hidden = "hide-input" in cell.metadata.get("tags", [])  # which define and draw nothing
        if cell.cell_type == "code" and not hidden and any(d in cell.source for d in drawing):
            image = cell.metadata.get("mystnb", {}).get("image", {})
            assert len(image.get("alt", "").split()) > 4, cell.source


@pytest.mark.parametrize("path", EXECUTED, ids=lambda path: path.stem)
def test_cells_print_whole_lines(path):
    """Where myst-nb joins what a cell has printed, it begins a line at each flush."""
    assert all("end=" not in text for _, text in cells(path))


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
    satellite = (site / "reference/systems/Satellite.html").read_text(encoding="utf-8")
    assert "_images/Satellite.svg" in satellite
    assert "<mtable" in satellite
    for path in site.rglob("*.html"):
        scripts = re.findall(r"<script[^>]*>", path.read_text(encoding="utf-8").lower())
        assert not any("mathjax" in script for script in scripts)
        for link in re.findall(
            r'(?:href|src)="(?!https?:|#|data:|mailto:)([^"#?]+)', path.read_text()
        ):
            assert (path.parent / link).exists(), f"{path.relative_to(site)}: {link}"
            seen += 1
    assert seen > 1000
