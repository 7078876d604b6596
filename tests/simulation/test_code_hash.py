"""Hashes of code: what changes them, and what does not."""

import importlib
import itertools
import os
import py_compile
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.code_hash import Unreadable, code_hash, content
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

MODULE = '''"""A module."""
import {imports}

GAIN = {gain}  # {comment}


class Thing:
    """{docstring}"""

    def gain(self):
        {inner}
        return GAIN
'''
PLAIN = {
    "imports": "math",
    "gain": "3.0",
    "comment": "a comment",
    "docstring": "A thing.",
    "inner": "pass",
}


@pytest.fixture
def hash_of(tmp_path, monkeypatch):
    """Writes modules, imports the first and hashes its class."""
    monkeypatch.syspath_prepend(tmp_path)
    before, times = set(sys.modules), itertools.count(10**9, 10)

    def write(files):
        for name, text in files.items():
            path = tmp_path / f"{name}.py"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
            os.utime(path, (next(times),) * 2)  # as if some time after the last
        for name in set(sys.modules) - before:
            del sys.modules[name]
        importlib.invalidate_caches()
        first = next(iter(files)).replace("/", ".")
        return code_hash(importlib.import_module(first).Thing)

    yield write
    for name in set(sys.modules) - before:
        del sys.modules[name]


def text(**changes):
    return MODULE.format(**{**PLAIN, **changes})


@pytest.mark.parametrize(
    ("changes", "same"),
    [
        ({"comment": "another"}, True),
        ({"docstring": "Another."}, True),
        ({"inner": "# nothing\n        pass"}, True),
        ({"gain": "3.00"}, True),
        ({"gain": "-50.0"}, False),
        ({"inner": "print()"}, False),
        ({"imports": "cmath"}, False),
    ],
)
def test_the_syntax_tree_counts_and_nothing_else(hash_of, changes, same):
    before = hash_of({"first_thing": text()})
    assert (hash_of({"first_thing": text(**changes)}) == before) == same


@pytest.mark.parametrize(
    ("imports", "helper"),
    [
        ("a_helper", "a_helper"),
        ("between", "a_helper"),
        ("math", "a_helper"),
        ("a_package.part", "a_package/part"),
    ],
)
def test_what_is_imported_counts_too(hash_of, imports, helper):
    """Directly, through another module, inside a function, and in a package of one's own."""
    files = {
        "first_thing": text(imports=imports, inner="from a_helper import K"),
        "between": "from a_helper import K",
        "a_helper": "K = 1",
        "a_package/__init__": "",
        "a_package/part": "K = 1",
    }
    before = hash_of(files)
    assert hash_of(files) == before
    assert hash_of({**files, "unrelated": "K = 2"}) == before
    assert hash_of({**files, helper: "K = 2"}) != before


PACKAGE = {
    "my_pkg/est": text(imports="my_pkg.sub.util", inner="return my_pkg.GAIN"),
    "my_pkg/__init__": "from my_pkg.names import GAIN",
    "my_pkg/names": "GAIN = 1",
    "my_pkg/sub/__init__": "K = 1",
    "my_pkg/sub/util": "K = 1",
    "my_pkg/other": "K = 1",
    "my_pkg/elsewhere/__init__": "K = 1",
}


@pytest.mark.parametrize(
    ("file", "counts"),
    [
        ("my_pkg/names", True),
        ("my_pkg/__init__", True),
        ("my_pkg/sub/__init__", True),
        ("my_pkg/other", False),
        ("my_pkg/elsewhere/__init__", False),
    ],
)
def test_packages_around_a_module_count_as_python_runs_them(hash_of, file, counts):
    before = hash_of(PACKAGE)
    assert (hash_of({**PACKAGE, file: PACKAGE[file] + "\nMORE = 2"}) != before) == counts


def test_the_packages_of_the_class_itself_count(hash_of):
    """Its module imports nothing of them."""
    files = {"my_pkg/sub/est": text(), "my_pkg/__init__": "", "my_pkg/sub/__init__": ""}
    hashes = {hash_of(files)}
    for package in ("my_pkg/__init__", "my_pkg/sub/__init__"):
        hashes.add(hash_of({**files, package: "import numpy\n\nGAIN = numpy.pi"}))
    assert len(hashes) == 3


def test_packages_without_a_file_of_their_own_have_no_code(hash_of):
    files = {"my_space/est": text(imports="my_space.part"), "my_space/part": "K = 1"}
    before = hash_of(files)
    assert hash_of({**files, "my_space/part": "K = 2"}) != before


@pytest.mark.parametrize(
    ("call", "counts"),
    [
        ("importlib.import_module('a_helper')", True),
        ("K = [import_module('a_helper').K for _ in range(3)]", True),
        ("return __import__('a_helper').K", True),
        ("importlib.import_module(name='a_helper')", True),
        ("importlib.import_module('.a_helper', __package__)", False),  # it is in no package
        ("importlib.import_module('a_' + 'helper')", False),
        ("importlib.reload('a_helper')", False),
        ("if TYPE_CHECKING:\n            __import__('a_helper')", False),
    ],
)
def test_imports_by_a_constant_name_count(hash_of, call, counts):
    files = {"first_thing": text(inner=call), "a_helper": "K = 1"}
    before = hash_of(files)
    assert (hash_of({**files, "a_helper": "K = 2"}) != before) == counts


def test_imports_by_a_relative_name_count(hash_of):
    call = "importlib.import_module('.part', __package__)"
    files = {"my_pkg/est": text(inner=call), "my_pkg/__init__": "", "my_pkg/part": "K = 1"}
    before = hash_of(files)
    assert hash_of({**files, "my_pkg/part": "K = 2"}) != before


@pytest.mark.parametrize(
    ("block", "counts"),
    [
        ("try:\n            from a_helper import K\n        finally:\n            pass", 1),
        ("try:\n            pass\n        except ImportError:\n            import a_helper", 1),
        ("with open('x'):\n            import a_helper", 1),
        ("for _ in ():\n            pass\n        else:\n            import a_helper", 1),
        ("match 1:\n            case 2:\n                import a_helper", 1),
        ("if typing.TYPE_CHECKING:\n            import a_helper", 0),
        ("if TYPE_CHECKING:\n            pass\n        else:\n            import a_helper", 1),
    ],
)
def test_imports_count_in_any_block_but_those_for_type_checkers(hash_of, block, counts):
    files = {"first_thing": text(inner=block), "a_helper": "K = 1"}
    before = hash_of(files)
    assert (hash_of({**files, "a_helper": "K = 2"}) != before) == bool(counts)


def test_a_module_counts_as_it_was_loaded(hash_of, tmp_path):
    """An edit of the file alone does not change what runs."""
    before = hash_of({"first_thing": text()})
    module = sys.modules["first_thing"]
    (tmp_path / "first_thing.py").write_text(text(gain="4.0"))
    os.utime(tmp_path / "first_thing.py", (2 * 10**9,) * 2)
    assert code_hash(module.Thing) == before
    importlib.reload(module)
    assert code_hash(module.Thing) != before


@pytest.mark.parametrize("edit", ["4.0", "3.0"])
def test_code_that_python_did_not_compile_anew_is_not_taken_for_the_source(tmp_path, edit):
    """Edited within a second of its compilation, in as many characters: Python runs the old."""
    source = tmp_path / "quick_module.py"
    source.write_text("class Thing:\n    gain = 3.0\n")
    second = int(source.stat().st_mtime) - 5
    os.utime(source, ns=(second * 10**9, second * 10**9))
    compiled = Path(py_compile.compile(str(source), doraise=True))
    os.utime(compiled, ns=(second * 10**9 + 10**8,) * 2)
    source.write_text(f"class Thing:\n    gain = {edit}\n")
    os.utime(source, ns=(second * 10**9 + 5 * 10**8,) * 2)
    run = """
import quick_module
from pinnobs_gym.simulation.code_hash import code_hash
print(quick_module.Thing.gain)
try:
    code_hash(quick_module.Thing)
except ValueError as error:
    print(error)
"""
    call = [sys.executable, "-c", run]
    first, again = (
        subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    )
    assert first.startswith("3.0")  # which is Python's
    assert ("within a second of being compiled" in first) == (edit != "3.0")
    assert again == f"{edit}\n"


def test_a_plug_in_is_not_loaded_from_stale_bytecode(tmp_path):
    source = tmp_path / "quick_part.py"
    source.write_text("GAIN = 3\n")
    os.utime(source, ns=(10**18,) * 2)
    os.utime(py_compile.compile(str(source), doraise=True), ns=(10**18 + 10**8,) * 2)
    source.write_text("GAIN = 4\n")
    os.utime(source, ns=(10**18 + 5 * 10**8,) * 2)
    (tmp_path / "quick_plug.py").write_text(
        "from pinnobs_gym.estimators.open_loop import OpenLoop\n"
        "from quick_part import GAIN\n\n\n"
        "class Mine(OpenLoop):\n    name = 'quick_plug'\n    gain = GAIN\n"
    )
    run = """
from pinnobs_gym.estimators import ESTIMATORS
print(ESTIMATORS.resolve("quick_plug:Mine").gain)
"""
    call = [sys.executable, "-c", run]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout == "4\n"


def test_an_estimator_counts_with_the_mathematics_that_it_imports_and_not_with_others(monkeypatch):
    read = []

    def spy(path):
        read.append(path.name)
        return original(path)

    from pinnobs_gym.simulation import code_hash as module

    original = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", spy)
    monkeypatch.setattr(module, "_LOADED", {})
    code_hash(EKF)
    assert {"ekf.py", "kalman.py", "gaussian.py", "model.py"} <= set(read)
    assert not {"smoother.py", "ukf.py", "evaluation.py", "tensorboard.py"} & set(read)


def test_code_without_source_is_refused():
    scope = {"__name__": "nowhere"}
    exec("class Thing: pass", scope)
    with pytest.raises(Unreadable, match="module nowhere has no source file"):
        code_hash(scope["Thing"])
    for value in (lambda: 1, np.random.default_rng(0), object()):
        with pytest.raises(Unreadable, match="is neither data nor code with a source of its own"):
            content({"option": value})


@dataclass(frozen=True)
class Settings:
    numbers: tuple = (1, 2)
    array: object = None


def test_equal_values_have_equal_content_and_others_have_not():
    values = [
        None,
        True,
        1,
        1.5,
        "1",
        (1, 2),
        {"a": 1},
        {"a": 2},
        np.array([1.0, 2.0]),
        np.array([1.0, 3.0]),
        np.array([1.0, 2.0], dtype=np.float32),
        np.array([[1.0, 2.0]]),
        Settings(),
        Settings((1, 3)),
        Settings(array=np.arange(3)),
        Settings(array=np.arange(4)),
        ReverseDuffing(),
        EKF,
        test_code_without_source_is_refused,
    ]
    shown = [repr(content(value)) for value in values]
    assert len(set(shown)) == len(values)
    assert content({"a": 1, "b": 2}) == content({"b": 2, "a": 1})
    assert content(np.array([1.0, 2.0])) == content(np.array([1.0, 2.0]))


def test_templates_of_compiled_code_count(monkeypatch):
    module = "pinnobs_gym.simulation.code_hash"
    before = code_hash("pinnobs_gym.estimators.ekf"), code_hash("pinnobs_gym.files")
    monkeypatch.setattr(f"{module}._templates", lambda: "another")
    after = code_hash("pinnobs_gym.estimators.ekf"), code_hash("pinnobs_gym.files")
    assert after[0] != before[0]
    assert after[1] == before[1]
