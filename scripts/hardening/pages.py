"""Pages with hostile names, opened in Chromium: nothing runs, nothing is asked for, and every chart
is drawn."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from random import Random
from typing import Any

from hardening.material import Material
from hardening.names import hostile
from hardening.trial import Outcome, Trial
from pinnobs_gym.leaderboard.site.model import page_model
from pinnobs_gym.leaderboard.site.page import draw
from pinnobs_gym.scoring.rows import Row, Stored
from pinnobs_gym.scoring.rows import read as read_rows

MOST = 20
ARGUMENTS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking")
SIZE = {"width": 1280, "height": 900}
_DRAW = """async () => {
    document.querySelectorAll("details").forEach((each) => { each.open = true; });
    const charts = [...document.querySelectorAll("[data-chart]")];
    for (let i = 0; i < 200 && !charts.every((chart) => chart.dataset.drawn); i++) {
        charts.find((chart) => !chart.dataset.drawn).scrollIntoView();
        await new Promise((done) => setTimeout(done, 20));
    }
    const marks = ".mark-line path, .mark-symbol path, .mark-rule line, .mark-rect path";
    return charts.filter((chart) => !chart.querySelector(marks)).map((c) => c.dataset.chart);
}"""
"""Draws every chart, and returns those that are empty."""


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield pages of which every name is hostile; none without a browser."""
    chromium = shutil.which("chromium")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        return
    if chromium is None:
        return
    rows = read_rows(material.rows_file)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(ARGUMENTS))
        while True:
            names = [hostile(rng) for _ in range(8)]
            yield Trial(
                f"page of {json.dumps(names)}", lambda n=names: _opened(browser, n, rows, material)
            )


def _opened(browser: Any, names: list[str], rows: list[Row], material: Material) -> Outcome:
    """Open the page of rows with these names, and return how it ended."""
    try:
        text = draw(page_model(Stored(_named(names, rows), []), []))
    except Exception as error:
        return Outcome("traceback", f"{type(error).__name__}: {error}")
    path, said = material.file("index.html"), []
    path.write_text(text, encoding="utf-8")
    with browser.new_context(offline=True, viewport=SIZE) as context:
        page = context.new_page()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("dialog", lambda dialog: (said.append("a dialog"), dialog.dismiss()))
        page.on("request", lambda request: _note(said, request.url))
        page.goto(path.as_uri())
        empty = page.evaluate(_DRAW)
    if empty or said:
        return Outcome("wrong", f"not drawn: {empty}; said or asked: {said}"[:500])
    return Outcome("accepted")


def _note(said: list[str], url: str) -> None:
    if not url.startswith(("file:", "data:")):
        said.append(f"request of {url}")


def _named(names: list[str], rows: list[Row]) -> list[Row]:
    """Return the rows of five estimators on two systems under two conditions, of these names."""
    estimators, (system, condition, label) = dict.fromkeys(names[:5]), names[5:]
    made = []
    for i, estimator in enumerate(estimators):
        for env_id in (f"{system}/{system}-v0", "pinnobs/X-v0"):
            for played in ("nominal", condition):
                facts = {"env_id": env_id, "condition": played, "estimator": estimator}
                facts |= {"estimator_hash": str(i), "knows": [label], "ranked": True}
                facts |= {"options": {label: label}, "versions": {label: label}, "setup": label}
                made += [{**row, **facts} for row in rows]
    return made
