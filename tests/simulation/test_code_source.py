"""What a source says is the same whether it was parsed just now or by an earlier process."""

import os
import sys
from pathlib import Path

import pytest

from pinnobs_gym.simulation import code_source
from pinnobs_gym.simulation.code_source import told

SOURCE = "import math\nfrom . import near\n\nGAIN = 1\n"


@pytest.fixture
def source(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    monkeypatch.setattr(sys, "pycache_prefix", None)
    file = tmp_path / "thing.py"
    file.write_text(SOURCE)
    return file


def kept(file: Path) -> list[Path]:
    return sorted(file.parent.rglob("*.code.json"))


def unparsed(monkeypatch):
    """From now on nothing can be parsed."""
    monkeypatch.setattr(code_source.ast, "parse", None)


def test_a_source_is_parsed_once(source, monkeypatch):
    first = told(source, "home")
    assert set(first[1]) == {("math", ""), ("home", "near")}
    assert len(kept(source)) == 1
    unparsed(monkeypatch)
    assert told(source, "home") == first


@pytest.mark.parametrize("damage", ["", "{", '{"of": 1}', "[1]", None])
def test_what_is_kept_and_damaged_counts_for_nothing(source, damage):
    first = told(source, "home")
    (file,) = kept(source)
    file.write_text(file.read_text()[:-9] if damage is None else damage)
    assert told(source, "home") == first


def test_an_edit_of_the_same_size_at_the_same_time_counts(source):
    first = told(source, "home")
    state = source.stat()
    source.write_text(SOURCE.replace("1", "2"))
    os.utime(source, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert told(source, "home")[0] != first[0]


def test_another_package_has_other_relative_imports(source):
    told(source, "home")
    assert ("away", "near") in told(source, "away")[1]


def test_another_version_of_python_parses_anew(source, monkeypatch):
    told(source, "home")
    monkeypatch.setattr(code_source, "_parser", lambda: b"another")
    unparsed(monkeypatch)
    with pytest.raises(TypeError):
        told(source, "home")


def test_nothing_is_written_where_python_writes_no_compiled_files(source, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    told(source, "home")
    assert not kept(source)
