"""Faults between processes: workers, clients and schedulers that are killed, told to end, or hang,
and several clients at once. Whatever ends a run, the same command does the rest."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.util import find_spec
from itertools import count
from random import Random

from hardening import plug_ins
from hardening.material import Material
from hardening.processes import PATIENCE, children, dask, started, until, workers
from hardening.runs import Run, difference, undisturbed
from hardening.trial import Outcome, Trial

MOST = 40
GONE = 3.0
"""Seconds after which a client that was told to end, and its workers, are gone."""
ORPHANED = 10.0
"""Seconds after which the workers of a killed client are gone."""
PLAYED = (plug_ins.spec("slow"), "open_loop", "luenberger")


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield faults of processes, in turn."""
    if os.name != "posix":
        return
    numbers = count(10_000)
    expected = undisturbed(material, next(numbers), *PLAYED)
    kinds: list[Callable[..., Outcome]] = [killed_worker, killed_client, told_to_end, interrupted]
    kinds += [two_clients, dying_plug_in, hanging_plug_in, full_device]
    if find_spec("distributed") is not None:
        kinds += [killed_scheduler, killed_dask_worker]
    while True:
        for kind in kinds:
            number, seed = next(numbers), rng.random()
            what = f"{kind.__name__.replace('_', ' ')}, {seed:.3f}"
            yield Trial(what, lambda k=kind, n=number, s=seed: k(material, n, expected, Random(s)))


def _wait(run: Run, rng: Random) -> None:
    """Wait until a run is somewhere between its beginning and its end."""
    wanted = rng.randrange(1, 5)
    until(lambda: len(run.facts()) >= wanted, 20.0)
    time.sleep(rng.random() * 0.3)


def _again(run: Run, expected: list[str], wrong: str = "") -> Outcome:
    """Start a run again, and compare its rows with those of an undisturbed one."""
    end = run.here()
    wrong = wrong or difference(run.facts(), expected)
    run.removed()
    if end.status or wrong:
        last = end.err.strip().split("\n")[-1]
        return Outcome("wrong", f"{wrong}; then status {end.status} {last}"[:500])
    return Outcome("accepted")


def killed_worker(m: Material, number: int, expected: list[str], rng: Random) -> Outcome:
    """Kill a worker: the client goes on."""
    run = Run(m, number, PLAYED)
    with started(run, "--jobs", "2") as client:
        found = until(lambda: workers(client), 30.0)
        _wait(run, rng)
        if found:
            with suppress(ProcessLookupError):
                os.kill(rng.choice(found), signal.SIGKILL)
        _, err = client.communicate(timeout=PATIENCE)
    wrong = f"status {client.returncode}: {err[-200:]!r}" if client.returncode else ""
    return _again(run, expected, wrong)


def killed_client(m: Material, number: int, expected: list[str], rng: Random) -> Outcome:
    """Kill a client: its workers end by themselves."""
    run = Run(m, number, PLAYED)
    with started(run, "--jobs", "2") as client:
        _wait(run, rng)
        client.kill()
        client.wait()
        gone = until(lambda: not children(client.pid), ORPHANED)
    return _again(run, expected, "" if gone else f"workers lived for {ORPHANED:g} s")


def _signalled(run: Run, which: signal.Signals, status: int, rng: Random) -> str:
    """Signal a client; return what is wrong with its end."""
    with started(run, "--jobs", "2") as client:
        _wait(run, rng)
        if client.poll() is not None:
            return ""
        client.send_signal(which)
        gone = until(lambda: client.poll() is not None and not children(client.pid), GONE)
        if not gone:
            return f"client or workers lived for {GONE:g} s after {which.name}"
        _, err = client.communicate()
    if client.returncode not in (0, status):  # it may have been done
        return f"status {client.returncode}"
    return "a traceback" if "Traceback" in err else ""


def told_to_end(m: Material, number: int, expected: list[str], rng: Random) -> Outcome:
    """Tell a client to end: it does, with its workers."""
    run = Run(m, number, PLAYED)
    return _again(run, expected, _signalled(run, signal.SIGTERM, 143, rng))


def interrupted(m: Material, number: int, expected: list[str], rng: Random) -> Outcome:
    """Interrupt a client: it ends, with its workers."""
    run = Run(m, number, PLAYED)
    return _again(run, expected, _signalled(run, signal.SIGINT, 130, rng))


def two_clients(m: Material, number: int, expected: list[str], rng: Random) -> Outcome:
    """Run the same command twice at once: no row is lost or contradicts another."""
    run = Run(m, number, PLAYED)
    with started(run, "--jobs", "1") as one:
        time.sleep(rng.random())
        with started(run, "--jobs", "1") as other:
            ends = [each.communicate(timeout=PATIENCE)[1] for each in (one, other)]
    said = zip((one, other), ends, strict=True)
    wrong = [f"status {c.returncode}: {err[-200:]!r}" for c, err in said if c.returncode]
    return _again(run, expected, "; ".join(wrong))


def dying_plug_in(m: Material, number: int, expected: list[str], rng: Random) -> Outcome:
    """Play an estimator that ends its process: one job fails, and all others are done."""
    name = rng.choice(list(plug_ins.DYING))
    run = Run(m, number, (*PLAYED, plug_ins.spec(name)))
    with started(run, "--jobs", "2") as client:
        _, err = client.communicate(timeout=PATIENCE)
    wrong = difference(run.facts("slow", "open_loop", "luenberger"), expected)
    if client.returncode != 1:
        wrong = f"status {client.returncode} with {name}: {err[-200:]!r}"
    run.removed()
    return Outcome("wrong", wrong) if wrong else Outcome("accepted")


def hanging_plug_in(m: Material, number: int, expected: list[str], rng: Random) -> Outcome:
    """Play an estimator that never ends: its job fails after the time limit."""
    run = Run(m, number, (*PLAYED, plug_ins.spec("hangs")))
    with started(run, "--jobs", rng.choice("12"), "--timeout", "4") as client:
        try:
            _, err = client.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            return Outcome("hung", f"no end after {PATIENCE:g} s")
        gone = until(lambda: not children(client.pid), GONE)
    wrong = difference(run.facts("slow", "open_loop", "luenberger"), expected)
    wrong = wrong or ("" if gone else "a process is left")
    if client.returncode != 1:
        wrong = f"status {client.returncode}: {err.strip()[-200:]!r}"
    run.removed()
    return Outcome("wrong", wrong) if wrong else Outcome("accepted")


def full_device(m: Material, number: int, expected: list[str], rng: Random) -> Outcome:
    """Fill the device of the rows file, or of a folder beside it: one line says so."""
    run = Run(m, number, PLAYED)
    what = rng.choice(("rows.jsonl", "curves", "tensorboard", "trained"))
    run.out.mkdir()
    (run.out / what).symlink_to("/dev/full")
    with started(run, "--jobs", "1") as client:
        _, err = client.communicate(timeout=PATIENCE)
    (run.out / what).unlink()
    wrong = "" if client.returncode in (0, 1, 2) else f"status {client.returncode}"
    if "Traceback" in err:
        return Outcome("traceback", f"{what}: {err.strip().split(chr(10))[-1]}")
    return _again(run, expected, wrong)


def killed_scheduler(m: Material, number: int, expected: list[str], rng: Random) -> Outcome:
    """Kill the scheduler: the client ends with a line."""
    run = Run(m, number, PLAYED)
    with (
        dask(m.file(f"dask{number}")) as (scheduler, address, _),
        started(run, "--backend", "dask", "--scheduler", address) as client,
    ):
        _wait(run, rng)
        scheduler.kill()
        _, err = client.communicate(timeout=PATIENCE)
    wrong = "" if client.returncode in (0, 1) else f"status {client.returncode}: {err[-200:]!r}"
    return _again(run, expected, "a traceback" if "Traceback" in err else wrong)


def killed_dask_worker(m: Material, number: int, expected: list[str], rng: Random) -> Outcome:
    """Kill a worker of the scheduler: the client goes on."""
    run = Run(m, number, PLAYED)
    with (
        dask(m.file(f"dask{number}")) as (_, address, own),
        started(run, "--backend", "dask", "--scheduler", address) as client,
    ):
        _wait(run, rng)
        rng.choice(own).kill()
        _, err = client.communicate(timeout=PATIENCE)
    wrong = f"status {client.returncode}: {err[-200:]!r}" if client.returncode else ""
    return _again(run, expected, wrong)
