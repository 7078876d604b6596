"""Code blocks of Markdown files, and how tests run them."""

import json
import re
import shlex
from pathlib import Path

from new_process import run_script

ROOT = Path(__file__).parents[2]


def blocks(path, *kinds):
    """The blocks of these kinds in a file, in order: (kind, text)."""
    found = re.findall(r"^```(\w+)\n(.*?)^```", path.read_text(encoding="utf-8"), re.M | re.S)
    return [(kind, text) for kind, text in found if kind in kinds]


def cells(path):
    """The cells of a page that is executed when the documentation is built, in order: (options,
    text); those of a notebook have no options."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        found = json.loads(text)["cells"]
        return [("", "".join(c["source"])) for c in found if c["cell_type"] == "code"]
    return re.findall(
        r"^```\{code-cell\} ipython3\n((?::[^\n]*\n)*)\n?(.*?)^```", text, re.M | re.S
    )


def run_cells(path, folder):
    """Run a page's cells in one process, in which they share their names. Returns what they print.

    Of the notations of notebooks, cells may have ``%%writefile name.py``, lines ``!pinnobs ...``
    and ``%matplotlib inline``, which says nothing here."""
    parts = []
    for _, text in cells(path):
        first, _, rest = text.partition("\n")
        if first.startswith("%%writefile "):
            (folder / first.split()[1]).write_text(rest, encoding="utf-8")
            continue
        text = text.replace("%matplotlib inline\n", "")
        parts.append(re.sub(r"^!pinnobs (.*)$", _called, text, flags=re.M))
    return run_python("from pinnobs_gym.cli import main\n" + "\n".join(parts), folder)


def _called(line):
    """A line of Python that does what a line of a shell does."""
    return f"assert main({shlex.split(line.group(1))!r}) == 0, {line.group(1)!r}"


def run_python(text, folder):
    """Run a block by itself. Returns what it printed."""
    return run_script(text, folder)[0]


def run_page(path, folder):
    """Run a file's blocks of Python and lines of ``pinnobs``, in order, in one process. A block
    that begins with a comment ``# name.py`` is a module that later ones may import."""
    parts = []
    for kind, text in blocks(path, "python", "sh"):
        if kind == "sh":
            for line in text.splitlines():
                assert line.startswith("pinnobs "), line
                parts.append(f"assert main({line.split()[1:]!r}) == 0, {line!r}\n")
            continue
        named = re.match(r"# (\w+)\.py\n", text)
        name = named.group(1) if named else f"part{len(parts)}"
        (folder / f"{name}.py").write_text(text, encoding="utf-8")
        parts.append(f"import {name}\n")
    whole = "from pinnobs_gym.cli import main\n" + "".join(parts)
    return run_python(whole, folder) if parts else ""


def run_command(line, folder):
    """Run a line that begins with ``pinnobs``. Returns what it printed."""
    name, *arguments = line.split()
    assert name == "pinnobs", line
    return run_python(f"from pinnobs_gym.cli import main\nassert main({arguments!r}) == 0", folder)
