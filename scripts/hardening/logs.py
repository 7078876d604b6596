"""Damaged sensor logs."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from hardening.material import SYSTEM, Material
from hardening.mutations import TEXT, mutated
from hardening.trial import Expected, Trial, call, command, written
from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.simulation.record import Prior

MOST = 300
CELLS: tuple[tuple[str, Expected], ...] = (
    *(
        (text, "refused")
        for text in ("1_000", "１２", "٣", "0x10", "1e400", "nan(1)", "x", "1,5", "--1")
    ),
    *((text, "refused") for text in ("infinity", "inf", "1e", "true", "=1+1", "1 2", "\x1b[2J1")),
    *((text, "accepted") for text in ("", " 0.5", "0.5 ", "+0.5", "5e-1", "-0", ".5", '"0.5"')),
)
"""What an output may and may not be."""
FILES: tuple[tuple[str, Expected], ...] = (
    *(("utf-8-sig", "accepted"), ("crlf", "accepted"), ("last line without end", "accepted")),
    *(("nul", "refused"), ("one huge sample", "either"), ("no header", "refused")),
    *(("header alone", "refused"), ("times back", "refused"), ("long cell", "refused")),
)
"""Files as a whole."""


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield logs: with a cell whose right reading is known, changed as a whole, and damaged. Some
    are read alone, some estimated."""
    path, good = material.file("log.csv"), material.log
    source = material.game.source
    prior = Prior.of(source.system, source.setup, 1)
    estimate = ["estimate", "--system", SYSTEM, "--log", path, "--out", material.file("e.csv")]

    def read(data: bytes) -> None:
        read_log(written(path, data), source.system, prior, ())

    for text, expected in CELLS:
        what, data = f"log: cell {text!r}", _with_cell(good, text)
        yield call(what, lambda d=data: read(d), [str(path)], expected)
    for what, expected in FILES:
        data = _whole(good, what)
        yield call(f"log: {what}", lambda d=data: read(d), [str(path)], expected)
    while True:
        what, data = mutated(rng, good, TEXT)
        if rng.random() < 0.8:
            yield call(f"log: {what}", lambda d=data: read(d), [str(path)])
            continue
        trial = command(estimate, [str(path)])
        yield Trial(
            f"estimates of a log: {what}",
            lambda t=trial, d=data: (written(path, d), t.run())[1],
        )


def _with_cell(good: bytes, text: str) -> bytes:
    """Return the log with a text as one of its outputs."""
    lines = good.decode().split("\n")
    lines[5] = f"{lines[5].split(',')[0]},{text}"
    return "\n".join(lines).encode()


def _whole(good: bytes, what: str) -> bytes:
    """Return the log changed as a whole."""
    header, *lines = good.decode().strip().split("\n")
    if what == "utf-8-sig":
        return b"\xef\xbb\xbf" + good
    if what == "crlf":
        return good.replace(b"\n", b"\r\n")
    if what == "last line without end":
        return good.strip()
    if what == "nul":
        return good[:40] + b"\0" + good[40:]
    if what == "no header":
        return "\n".join(lines).encode()
    if what == "header alone":
        return header.encode()
    if what == "times back":
        return "\n".join([header, *lines[::-1]]).encode()
    long = "1e308" if what == "one huge sample" else "1" * 200_000
    return _with_cell(good, long)
