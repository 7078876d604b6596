"""Compilers that do what they are told, and processes that compile."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REAL = next(filter(None, map(shutil.which, ("cc", "clang", "gcc"))), None)
needs_compiler = pytest.mark.skipif(REAL is None, reason="there is no C compiler")
posix = pytest.mark.skipif(os.name == "nt", reason="the compilers of these tests are shell scripts")

SOURCE = "double answer(void) { return 42.0; }\n"

FAILS = "echo 'kernel.c:1:10: fatal error: math.h: No such file' >&2; echo done; exit 1"
GARBAGE = 'while [ $# -gt 1 ]; do [ "$1" = -o ] && echo garbage > "$2"; shift; done'
COMPILES = f'exec {REAL} "$@"'


def fake(folder: Path, name: str, does: str) -> Path:
    """Return a compiler that adds a line to ``name.calls`` and runs some commands."""
    folder.mkdir(exist_ok=True)
    path = folder / name
    path.write_text(f"#!/bin/sh\necho called >> {path}.calls\n{does}\n")
    path.chmod(0o755)
    return path


def calls(compiler: Path) -> int:
    """Return how often a compiler was called."""
    counted = compiler.with_name(f"{compiler.name}.calls")
    return len(counted.read_text().splitlines()) if counted.exists() else 0


def in_process(code: str, *arguments: str, **changes: str) -> subprocess.Popen[str]:
    """Start a process that runs some code, with changes of the environment."""
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, **changes},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def output_of(process: subprocess.Popen[str]) -> str:
    """Return what a process printed, which must succeed."""
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return out.strip()
