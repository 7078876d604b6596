"""Code blocks of Markdown files, and how tests run them."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def blocks(path, *kinds):
    """The blocks of these kinds in a file, in order: (kind, text)."""
    found = re.findall(r"^```(\w+)\n(.*?)^```", path.read_text(encoding="utf-8"), re.M | re.S)
    return [(kind, text) for kind, text in found if kind in kinds]


def run_python(text, folder, timeout=120):
    """Run a block; one that begins with a comment ``# name.py`` is kept under that name, and later
    ones may import it. Returns what it printed."""
    named = re.match(r"# (\w+\.py)\n", text)
    path = folder / (named.group(1) if named else "snippet.py")
    path.write_text(text, encoding="utf-8")
    return _run([sys.executable, "-W", "error::UserWarning", path.name], folder, timeout)


def run_command(line, folder, timeout=120):
    """Run a line that begins with ``pinnobs``. Returns what it printed."""
    name, *arguments = line.split()
    assert name == "pinnobs", line
    return _run([sys.executable, "-m", "pinnobs_gym.cli", *arguments], folder, timeout)


def _run(command, folder, timeout):
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=timeout)
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout
