"""The compilation of C source to a shared library, and the folder that keeps libraries."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

_FLAGS = (
    *("-std=c99", "-O2", "-ftree-loop-vectorize", "-march=native", "-fno-math-errno", "-fno-trapping-math"),
    *("-ffp-contract=off", "-fPIC", "-shared"),
)
"""Arithmetic is strict, so that NaN and reproducibility hold."""


def library(source: str) -> ctypes.CDLL:
    """Return the library of some source, compiled unless it is kept."""
    folder = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "pinnobs-gym"
    folder.mkdir(parents=True, exist_ok=True)
    key = hashlib.sha256("\n".join([source, *_FLAGS]).encode()).hexdigest()[:24]
    path = folder / f"{key}.so"
    if not path.exists():
        with tempfile.TemporaryDirectory(dir=folder) as work:
            code, made = Path(work) / "kernel.c", Path(work) / "kernel.so"
            code.write_text(source, encoding="utf-8")
            compiler = _compiler()
            assert compiler is not None
            subprocess.run(
                [compiler, *_FLAGS, str(code), "-o", str(made), "-lm"], check=True, timeout=60
            )
            made.replace(path)
    return ctypes.CDLL(str(path))


@cache
def _compiler() -> str | None:
    return next((found for name in ("cc", "clang") if (found := shutil.which(name))), None)
