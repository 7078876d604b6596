"""The C compilers of this machine, in the order in which they are tried, and its processor."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path

from pinnobs_gym.simulation.notices import say_once

_NAMES = ("cc", "clang", "gcc")
_STRICT = (
    *("-std=c99", "-O2", "-ftree-loop-vectorize", "-fno-math-errno", "-fno-trapping-math"),
    *("-ffp-contract=off", "-fno-tree-slp-vectorize", "-shared"),
)
"""Arithmetic is strict, so that NaN and reproducibility hold. gcc 12 contracts operations of
statements that it joins (``slp``) even where contraction is off, such as in the code for one lane,
whose results would differ from those in several."""
_CPUINFO = Path("/proc/cpuinfo")


@dataclass(frozen=True)
class Compiler:
    """A command that compiles C."""

    name: str
    """Its name in messages."""
    command: tuple[str, ...]
    """The command without flags and files."""
    identity: str
    """What differs between compilers that may make other code: path, size and date, or version."""

    def arguments(self, code: Path, made: Path) -> list[str]:
        """Return the command line that compiles a source to a shared library."""
        return [*self.command, *flags(), str(code), "-o", str(made), *_libraries()]


def compilers() -> list[Compiler]:
    """Return the compilers that are found: that of the environment variable CC, then ``cc``,
    ``clang`` and ``gcc``, and that of the package ``ziglang`` if it is installed."""
    found = []
    chosen = os.environ.get("CC", "").strip()
    if chosen:
        own = _compiler(tuple(shlex.split(chosen, posix=os.name != "nt")))
        if own is None:
            say_once(f"CC={chosen} is not found; the usual names of C compilers are tried")
        found.append(own)
    found += [_compiler((name,)) for name in _NAMES]
    found.append(_zig())
    unique: dict[str, Compiler] = {}
    for compiler in found:
        if compiler is not None:
            unique.setdefault(compiler.identity, compiler)
    return list(unique.values())


def _compiler(command: tuple[str, ...]) -> Compiler | None:
    path = shutil.which(command[0])
    if path is None:
        return None
    try:
        real = Path(path).resolve(strict=True)
        stat = real.stat()
    except OSError:
        return None
    # A link to ccache runs the compiler whose name the link has.
    called = Path(path).name if "ccache" in real.name else ""
    identity = repr((str(real), called, stat.st_size, stat.st_mtime_ns, command[1:]))
    return Compiler(" ".join(command), (path, *command[1:]), identity)


def _zig() -> Compiler | None:
    if importlib.util.find_spec("ziglang") is None:
        return None
    command = (sys.executable, "-m", "ziglang", "cc")
    return Compiler("ziglang", command, f"ziglang {version('ziglang')} {sys.executable}")


@cache
def flags() -> tuple[str, ...]:
    """Return the flags of every compilation. Code is made for this very processor only where it can
    be told from others."""
    native = ()
    if processor():
        machine = platform.machine().lower()
        if machine in ("x86_64", "amd64"):
            native = ("-march=native",)
        elif machine in ("aarch64", "arm64"):
            native = ("-mcpu=native",)
    return (*_STRICT, *native, *(() if os.name == "nt" else ("-fPIC",)))


def _libraries() -> tuple[str, ...]:
    return () if os.name == "nt" else ("-lm",)


@cache
def processor() -> str:
    """Return the processor's name and, where the system tells it, a hash of what it can do; empty
    if it is not known."""
    try:
        first = _CPUINFO.read_text(errors="replace").partition("\n\n")[0]
    except OSError:
        return _named_processor()
    lines = (line.partition(":") for line in first.splitlines())
    told = {key.strip(): value.strip() for key, _, value in lines}
    able = told.get("flags") or told.get("Features")
    if not able:
        return ""
    kind = ("vendor_id", "cpu family", "model", "stepping", "CPU implementer", "CPU part")
    parts = [*(told.get(name, "") for name in kind), *sorted(able.split())]
    name = told.get("model name") or platform.machine()
    return f"{name} ({hashlib.sha256(repr(parts).encode()).hexdigest()[:8]})"


def _named_processor() -> str:
    if sys.platform == "darwin":
        try:
            asked = ["/usr/sbin/sysctl", "-n", "machdep.cpu.brand_string"]
            return subprocess.run(asked, capture_output=True, text=True, timeout=5).stdout.strip()
        except (OSError, subprocess.SubprocessError):
            return ""
    return os.environ.get("PROCESSOR_IDENTIFIER", "")


def tools(compiler: Compiler) -> tuple[str, ...]:
    """Return all that a library depends on beside its source."""
    return (compiler.identity, *flags(), processor(), platform.machine(), sys.platform)
