"""Scripts run as by a new process of Python, whose large libraries are loaded already.

One process loads them, none of them ours, and forks for each script: to load torch, SciPy's
statistics, Matplotlib and SymPy takes several times as long as most scripts that tests run. What a
script has not imported of the package itself is not there.
"""

import atexit
import json
import os
import runpy
import signal
import subprocess
import sys
import warnings
from functools import cache

from waiting import PATIENCE

LIBRARIES = (
    *("numpy", "gymnasium", "matplotlib.pyplot", "matplotlib.animation", "pandas", "rich.console"),
    *("scipy.integrate", "scipy.optimize", "scipy.stats", "sympy", "torch", "tyro"),
    "torch.utils.tensorboard",
)


def run_script(text, folder):
    """Run a script in a folder; warnings of users are errors. Returns what it printed, and its
    log, which it must do without an error."""
    (folder / "snippet.py").write_text(text, encoding="utf-8")
    printed, log = folder / ".printed", folder / ".log"
    order = {"folder": str(folder), "environment": dict(os.environ)}
    server = _server()
    server.stdin.write(json.dumps(order) + "\n")
    server.stdin.flush()
    status = server.stdout.readline()
    assert status, "the process that forks has ended"
    told = [file.read_text(encoding="utf-8") for file in (printed, log)]
    printed.unlink()
    log.unlink()
    assert status == "0\n", f"status {status.strip()}: {text}\n{told[1]}"
    return told


@cache
def _server():
    """The process that forks; it ends with this one."""
    command = [sys.executable, "-W", "ignore", __file__]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    server = subprocess.Popen(command, text=True, **pipes)
    atexit.register(server.communicate)
    return server


def _serve():
    """Fork for each order, and say how the script ended."""
    for name in LIBRARIES:
        __import__(name)
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            return json.loads(line)
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)
    return None


def _become(folder, environment):
    """Be the process that runs the script of a folder."""
    signal.alarm(PATIENCE)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    sys.path[0] = folder
    for number, name in ((0, os.devnull), (1, ".printed"), (2, ".log")):
        flags = os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_TRUNC
        file = os.open(name, flags, 0o600)
        os.dup2(file, number)
        os.close(file)
    sys.argv = ["snippet.py"]
    warnings.resetwarnings()
    warnings.simplefilter("ignore", DeprecationWarning)
    warnings.simplefilter("error", UserWarning)
    runpy.run_path("snippet.py", run_name="__main__")


if __name__ == "__main__" and (order := _serve()):
    _become(**order)
