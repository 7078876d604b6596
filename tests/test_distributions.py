"""The source distribution and the wheel: what they hold, and that the wheel runs once installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

from pinnobs_gym import registry

ROOT = Path(__file__).parents[1]
NOT_SOURCE = (
    *(".git", ".venv", "__pycache__", "*.egg-info", "PKG-INFO", "setup.cfg", "build", "dist"),
    *("runs", ".*_cache", "_build", "reference", "jupyter_execute"),
)
"""What is made from the source; the names of docs/reference and its like occur nowhere else."""
NOT_IN_SDIST = {".gitignore", ".github"}
"""What only a clone has any use for."""

pytestmark = pytest.mark.slow


def run(command, **options):
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, **options)
    assert done.returncode == 0, done.stderr
    return done.stdout


def build(kind, source, into):
    """Build from a folder, as pip does but with the setuptools that is here."""
    hook = f"import setuptools.build_meta as m; m.build_{kind}({str(into)!r})"
    run([sys.executable, "-c", hook], cwd=source)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of the source, in which nothing has been built."""
    folder = tmp_path_factory.mktemp("source") / "copy"
    return shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(*NOT_SOURCE))


@pytest.fixture(scope="module")
def sdist(source, tmp_path_factory):
    """The source distribution, unpacked."""
    folder = tmp_path_factory.mktemp("sdist")
    build("sdist", source, folder)
    (archive,) = folder.glob("*.tar.gz")
    with tarfile.open(archive) as file:
        file.extractall(folder, filter="data")
    return folder / archive.name.removesuffix(".tar.gz")


@pytest.fixture(scope="module")
def wheel(sdist, tmp_path_factory):
    """The wheel, made of the source distribution alone."""
    folder = tmp_path_factory.mktemp("wheel")
    build("wheel", sdist, folder)
    (path,) = folder.glob("*.whl")
    return path


def files(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_the_source_distribution_is_the_source(source, sdist):
    held = files(sdist)
    for name in (
        *("LICENSE", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "Makefile", ".ci/run"),
        *("README.md", "docs/conf.py", "docs/architecture.svg", "scripts/leaderboard.py"),
        *("tests/conftest.py", "tests/helpers/snippets.py", "trainers/rl/__init__.py"),
    ):
        assert name in held
    missing = {name for name in files(source) - held if name.split("/")[0] not in NOT_IN_SDIST}
    assert not missing


def test_the_wheel_holds_the_packages_and_their_data(source, wheel):
    with zipfile.ZipFile(wheel) as file:
        held = set(file.namelist())
    for name in (
        *("py.typed", "leaderboard/suites/quick.toml", "leaderboard/site/page.css"),
        "simulation/kernels/templates/ekf.c",
        *("leaderboard/site/page.html", "leaderboard/site/page.js"),
    ):
        assert f"pinnobs_gym/{name}" in held
    packages = {name for name in held if ".dist-info/" not in name}
    assert packages == {
        name for name in files(source) if name.split("/")[0] in ("pinnobs_gym", "trainers")
    }


def test_the_installed_wheel_runs(wheel, tmp_path):
    """In an environment of its own, which sees this one's packages for what it depends on."""
    home = tmp_path / "venv"
    venv.create(home, symlinks=os.name != "nt")
    scripts = home / ("Scripts" if os.name == "nt" else "bin")
    python = scripts / "python"
    install = ["--no-deps", "--no-index", "--ignore-installed", "--disable-pip-version-check"]
    run([sys.executable, "-m", "pip", "--python", python, "install", "-q", *install, wheel])
    ask = "import sysconfig; print(sysconfig.get_paths()['purelib'])"
    own = Path(run([python, "-c", ask]).strip())
    shared = {sysconfig.get_paths()[kind] for kind in ("purelib", "platlib")}
    (own / "shared.pth").write_text("\n".join(sorted(shared)))

    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    systems = run([scripts / "pinnobs", "systems"], cwd=tmp_path, env=clean)
    assert "pinnobs/InductionMotor-v0" in systems
    ask = (
        "import pinnobs_gym, pinnobs_gym.registry as r\n"
        "print(pinnobs_gym.__file__, pinnobs_gym.__version__, *r.TRAINERS.sources)"
    )
    place, version, *trainers = run([python, "-c", ask], cwd=tmp_path, env=clean).split()
    assert Path(place).is_relative_to(own)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert version == project["version"]
    assert trainers == list(registry.TRAINERS.sources)
