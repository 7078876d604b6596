"""What CONTRIBUTING.md and CHANGELOG.md say is so."""

import re
import tomllib

from snippets import ROOT

TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]


def test_targets_and_files_it_names_are_there():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^make ([a-z]+)|`make (?:PYTHON=\S+ )?([a-z]+)`", TEXT, re.M))
    assert len(targets) > 3
    for target in targets:
        assert f"\n{''.join(target)}:" in makefile, target
    paths = re.findall(r"\]\((?!https?:)([^)]+)\)|`((?:\w+/)+(?:\w+\.py)?)`", TEXT)
    assert len(paths) > 5
    for path in paths:
        assert (ROOT / "".join(path)).exists(), path


def test_it_states_the_import_contract():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    assert " > ".join(layers) in " ".join(TEXT.split())


def test_versions_agree():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.*)$", citation, re.M) == [VERSION]


def test_the_changelog_has_unreleased_on_top_and_known_headings():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    first, *released = re.findall(r"^## (.*)$", text, re.M)
    assert first == "[Unreleased]"
    assert all(re.fullmatch(r"\[\d+\.\d+\.\d+\] - \d{4}-\d\d-\d\d", each) for each in released)
    kinds = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
    assert set(re.findall(r"^### (.*)$", text, re.M)) <= kinds
