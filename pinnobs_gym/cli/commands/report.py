"""`report ROWS -o site/`: make the page of a leaderboard."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pinnobs_gym.cli.console import console, print_next
from pinnobs_gym.cli.options import parse
from pinnobs_gym.files import check_writable, replacing
from pinnobs_gym.leaderboard.published import manifest
from pinnobs_gym.leaderboard.published.reading import load_rows, published_floors
from pinnobs_gym.scoring import curves
from pinnobs_gym.scoring.rows import game_of


@dataclass(frozen=True)
class Report:
    """Make a static page of scores that needs no server and no network. Needs the extra
    "report"."""

    rows: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Rows files, such as runs/leaderboard/rows.jsonl; the curves in a folder "curves" beside each
    are drawn too. "published" stands for the rows that ship with the package, without curves."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("site")
    """Folder of the page, index.html."""

    def run(self) -> int:
        """Write the page."""
        if not self.rows:
            raise ValueError(
                "no rows file is given; expected one, such as runs/leaderboard/rows.jsonl"
            )
        try:
            from pinnobs_gym.leaderboard.site.model import page_model
            from pinnobs_gym.leaderboard.site.page import draw
        except ImportError as error:
            raise ValueError(
                f"the page needs {error.name}: pip install 'pinnobs-gym[report]'"
            ) from None
        stored = load_rows(self.rows)
        if stored.warning:
            console.print(stored.warning, style="yellow", soft_wrap=True)
        if not stored.rows:
            raise ValueError(f"no scored episodes in {', '.join(map(str, self.rows))}")
        check_writable(self.out)
        folders = list(dict.fromkeys(map(curves.folder_of, self.rows)))
        folders.append(manifest.FOLDER / manifest.CURVES)
        shipped = published_floors({game_of(row) for row in stored.rows})
        text = draw(page_model(stored, folders, shipped))
        path = self.out / "index.html"
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
        console.print(f"page: {path} ({path.stat().st_size / 1e6:.1f} MB)", soft_wrap=True)
        print_next("tables", *self.rows)
        return 0


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Report, "report", arguments).run()
