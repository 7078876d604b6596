"""Make the README's picture and table from stored scores.

python scripts/readme.py [--rows runs/leaderboard/rows.jsonl]
"""

from __future__ import annotations

import platform
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import tyro

from pinnobs_gym import leaderboard, rows
from pinnobs_gym.episodes import EpisodeSource, Stream
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.figures import state_figure
from pinnobs_gym.report import replacing, write_figure

ROOT = Path(__file__).parents[1]
START, END = "<!-- leaderboard: written by scripts/readme.py -->", "<!-- end -->"


def picture(path: Path, seed: int = 3) -> None:
    """Draw the EKF on one episode of ReverseDuffing."""
    source = EpisodeSource("ReverseDuffing")
    episodes = source.play(source.draw([Stream(np.random.SeedSequence(seed))]))
    record = source.record(episodes)
    estimates = EKF.for_setup(source.system, source.setup).run(record)
    assert estimates.P is not None
    figure = state_figure(
        source.system,
        record.t,
        estimates.xhat[0],
        x=episodes.x[:-1, 0],
        y=record.y[0],
        P=estimates.P[0],
        title="ReverseDuffing: x2 is estimated from noisy x1 (band: two standard deviations)",
    )
    write_figure(path, figure)


def processor() -> str:
    """What the machine calls its processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def summary(tables: list[leaderboard.Table]) -> str:
    """A line per system and estimator: divergence, settling, NRMSE and tail."""
    date = datetime.now(UTC).date().isoformat()
    lines = [
        f"Measured on {date} with Python {platform.python_version()}, one thread a job "
        f"({processor()}), by `make leaderboard`; medians of the episodes.",
        "",
        "| system | condition | estimator | track | episodes | diverged % | settled s | NRMSE | "
        "tail NRMSE |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for table in tables:
        name = table.env_id.removeprefix("pinnobs/")
        for s, cells in zip(table.standings, leaderboard.cells(table, False), strict=True):
            line = [name, table.condition, cells[1], s.track, str(s.episodes), *cells[4:8]]
            lines.append("| " + " | ".join(line) + " |")
    return "\n".join(lines)


def main(rows_file: Path = ROOT / "runs/leaderboard/rows.jsonl") -> int:
    """Rewrite the picture and the table.

    Args:
        rows_file: the scores.
    """
    scored = rows.read(rows_file)
    if not scored:
        print(f"no rows in {rows_file}; run make leaderboard first", file=sys.stderr)
        return 2
    picture(ROOT / "docs" / "reverse_duffing.png")
    readme = ROOT / "README.md"
    text = readme.read_text(encoding="utf-8")
    before, _, rest = text.partition(START)
    after = rest.partition(END)[2]
    table = summary(leaderboard.tables(scored))
    with replacing(readme) as temporary:
        temporary.write_text(f"{before}{START}\n\n{table}\n\n{END}{after}", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
