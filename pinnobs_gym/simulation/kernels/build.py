"""The compilation of C source to a shared library, and the libraries that are kept.

A library is called in a process of its own before it is moved to the folder of `cache_folder`. A
compiler that fails is not tried again by this process, unless it has made another library before.
All processes of the user remember a failure for ten minutes, so that parallel workers do not repeat
it. A source is compiled by one process at a time; the others wait for it.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from filelock import FileLock, Timeout

from pinnobs_gym.simulation.kernels.cache_folder import (
    ABOUT,
    FAILED,
    LIBRARY,
    WORK,
    distrusted,
    kernel_folder,
    leave,
    read_json,
    trim,
    write_json,
)
from pinnobs_gym.simulation.kernels.calls import PlanStructure
from pinnobs_gym.simulation.kernels.compilers import Compiler, compilers, processor, tools
from pinnobs_gym.simulation.notices import say_once

NO_COMPILER = "there is no C compiler"
PATIENCE = 120.0
"""Seconds after which a compiler, or the first call of a library, is stopped."""
REMEMBERED = 600.0
"""Seconds for which other processes do not repeat a compilation that failed."""

_FIRST_CALL = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
plan, room = (ctypes.c_char * 65536)(), [(ctypes.c_double * 65536)() for _ in range(9)]
ctypes.c_void_p.from_buffer(plan, int(sys.argv[2])).value = ctypes.addressof(room[0])
if hasattr(library, "evaluate"):
    library.evaluate(plan, ctypes.c_int64(1), *map(ctypes.byref, room[1:]))
"""
"""Loads a library and evaluates the plant at zero."""

_broken: set[str] = set()
"""Identities of the compilers that failed in this process."""
_proven: set[str] = set()
"""Identities of those that made a library."""


def usable_compilers() -> list[Compiler]:
    """Return the compilers that have not failed in this process."""
    return [compiler for compiler in compilers() if compiler.identity not in _broken]


def library(source: str, about: Mapping[str, str] | None = None) -> tuple[ctypes.CDLL, str] | str:
    """Return the library of some source and its name in the folder, or the reason in one line why
    there is none, which the log says once.

    Args:
        source: the whole source, in C99.
        about: what is told of the library where it is listed, such as its ``plant``.
    """
    candidates = usable_compilers()
    made: tuple[ctypes.CDLL, str] | str = without_compiler()
    for i, compiler in enumerate(candidates):
        made = _with(source, compiler, dict(about or {}))
        if not isinstance(made, str):
            _proven.add(compiler.identity)
            return made
        if compiler.identity not in _proven:
            _broken.add(compiler.identity)
        others = candidates[i + 1 :]
        instead = f"{others[0].name} is tried" if others else "NumPy is used"
        say_once(f"{made}; {instead}")
    return made


def without_compiler() -> str:
    """Return the reason why nothing is compiled if no compiler is usable."""
    return "no C compiler works" if _broken else NO_COMPILER


def kept(name: str) -> ctypes.CDLL | None:
    """Return a library that the folder keeps by its name; None if there is none to trust."""
    try:
        return _loaded(kernel_folder() / f"{name}{LIBRARY}")
    except OSError:
        return None


def _with(source: str, compiler: Compiler, about: dict[str, str]) -> tuple[ctypes.CDLL, str] | str:
    """Return the library that a compiler makes and its name, or the reason why it makes none."""
    parts = [source, *tools(compiler)]
    name = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:24]
    try:
        path = kernel_folder() / f"{name}{LIBRARY}"
        if path.is_symlink() or (path.exists() and distrusted(path)):
            path = leave(f"{distrusted(path)}; remove it") / path.name
        found = _loaded(path)
        if found is not None:
            return found, name
        # One process compiles it; the lock of a killed one is free.
        lock = FileLock(path.with_name(f".{name}.lock"), mode=0o600)
        with lock.acquire(timeout=2 * PATIENCE + 10, poll_interval=0.05):
            return _made_or_found(source, compiler, path, about)
    except Timeout:
        return f"another process has been compiling for {2 * PATIENCE + 10:.0f} s"
    except (OSError, NotImplementedError) as error:
        return f"{compiler.name} cannot be used: {' '.join(str(error).split())}"


def _made_or_found(
    source: str, compiler: Compiler, path: Path, about: dict[str, str]
) -> tuple[ctypes.CDLL, str] | str:
    """Return what `_with` does, while no other process does it for the same source."""
    found = _loaded(path)
    if found is not None:
        return found, path.stem
    failure = path.with_suffix(FAILED)
    earlier = read_json(failure)
    if isinstance(earlier, dict) and abs(time.time() - earlier["time"]) < REMEMBERED:
        return earlier["reason"]
    reason = _compile(source, compiler, path)
    if reason:
        write_json(failure, {"time": time.time(), "reason": reason})
        return reason
    about |= {"compiler": compiler.name, "processor": processor()}
    write_json(path.with_suffix(ABOUT), about)
    trim(path.parent)
    found = _loaded(path)
    return (found, path.stem) if found else f"{path} was removed as soon as it was written"


def _loaded(path: Path) -> ctypes.CDLL | None:
    """Return a library, None if it does not exist, is not trusted or is not whole."""
    try:
        if distrusted(path):
            return None
        found = ctypes.CDLL(str(path))
    except OSError:
        return None
    with suppress(OSError):
        os.utime(path)  # those used last are kept longest
    return found


def _compile(source: str, compiler: Compiler, path: Path) -> str:
    """Compile a source to a library. Return why that failed, an empty text if it did not."""
    work = Path(tempfile.mkdtemp(prefix=WORK, dir=path.parent))
    try:
        code, made = work / "kernel.c", work / f"kernel{LIBRARY}"
        code.write_text(source, encoding="utf-8")
        failed = _stopped_or_failed(compiler.arguments(code, made), work)
        if failed:
            return f"the C compiler {compiler.name} {failed}"
        if not made.exists():
            return f"the C compiler {compiler.name} wrote no library"
        made.chmod(0o700)
        first = [sys.executable, "-I", "-S", "-c", _FIRST_CALL, str(made)]
        failed = _stopped_or_failed([*first, str(PlanStructure.p.offset)], work)
        if failed:
            return f"the library that {compiler.name} made cannot be called: the call {failed}"
        os.replace(made, path)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return ""


def _stopped_or_failed(command: Sequence[str], work: Path) -> str:
    """Run a command, and stop it with all its children if it takes too long. Return what happened,
    an empty text if it succeeded."""
    said = work / "said.txt"
    # A file rather than a pipe, which a child that lives on would keep open
    with said.open("wb") as output:
        try:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                cwd=work,
                start_new_session=os.name != "nt",
            )
        except OSError as error:
            return f"cannot be started: {error.strerror or error}"
        try:
            status = process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            return f"did not end within {PATIENCE:g} s"
        finally:  # also when this process is interrupted
            _end(process)
    if status < 0:
        return f"was ended by signal {-status}"
    if status == 0:
        return ""
    lines = said.read_text(encoding="utf-8", errors="replace").split("\n")
    told = [" ".join(line.split()) for line in lines if line.strip()]
    errors = [line for line in told if "error" in line.lower()] or told[-1:]
    return f"failed with status {status}" + (f": {errors[0][:200]}" if errors else "")


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process that still runs, with its children."""
    running = process.poll() is None
    if os.name == "nt":
        if running:
            tree = ["taskkill", "/F", "/T", "/PID", str(process.pid)]
            subprocess.run(tree, capture_output=True, check=False)
    elif running:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    if running:
        process.wait()
