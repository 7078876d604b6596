"""`pinnobs report`: what it refuses, what it writes, and the page in a browser."""

import json
import re
import sys
from functools import cache

import altair as alt
import pytest
from made_rows import rows_of
from waiting import PATIENCE, until

from pinnobs_gym import evaluate
from pinnobs_gym.cli import main
from pinnobs_gym.leaderboard.site.charts import Styled
from pinnobs_gym.leaderboard.site.comparisons import cost, factors, over_floor, ratios
from pinnobs_gym.leaderboard.site.drawings import charts_of
from pinnobs_gym.leaderboard.site.model import page_model
from pinnobs_gym.leaderboard.site.over_time import error, errors, settling, state
from pinnobs_gym.leaderboard.site.page import draw
from pinnobs_gym.leaderboard.site.palette import styles
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.rows import Stored
from pinnobs_gym.systems import SYSTEMS

DUFFING, MOTOR = "pinnobs/ReverseDuffing-v0", "pinnobs/InductionMotor-v0"


@pytest.fixture(scope="module")
def scored(tmp_path_factory):
    """A rows file with curves: two systems, one of them ranked under a condition of its own."""
    path = tmp_path_factory.mktemp("scored") / "rows.jsonl"
    for name in ("ekf", "open_loop", "rts_smoother"):
        evaluate(name, DUFFING, episodes=4, results=path)
    evaluate("strong_tracking_ekf", DUFFING, episodes=4, results=path, condition="noise5")
    evaluate("ekf", DUFFING, episodes=4, results=path, condition="noise5")
    for condition in ("nominal", "load_step"):
        evaluate("ekf", MOTOR, episodes=2, results=path, condition=condition)
    failed = {"schema": rows.SCHEMA, "kind": "failure", "env_id": DUFFING, "setup": "benchmark"}
    failed |= {"condition": "nominal", "estimator": "broken", "episode": "seed:0", "episodes": 4}
    failed |= {"job": "x", "error": "ZeroDivisionError: <by zero>", "date": "2030-01-01"}
    rows.append(path, [failed])
    return path


@pytest.fixture(scope="module")
def site(scored, tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    floor = {"estimator": "exact_bayes", "estimator_hash": "floor", "track": "floor"}
    floor |= {"effective_sample_size": 900.0}
    played = [row for row in rows.read(scored) if row["env_id"] == DUFFING]
    played = [row for row in played if row["estimator"] == "ekf" and row["condition"] == "nominal"]
    floors = tmp_path_factory.mktemp("floors") / "rows.jsonl"
    rows.append(floors, [row | floor for row in played])
    assert main(["report", str(scored), str(floors), "-o", str(folder)]) == 0
    return folder / "index.html"


def test_the_page_is_one_file_that_fetches_nothing(site):
    text = site.read_text(encoding="utf-8")
    assert [path.name for path in site.parent.iterdir()] == ["index.html"]
    assert len(text) < 5e6
    assert "src=" not in text.split("<script")[0]
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    for part in ("default-src 'none'", "base-uri 'none'", "form-action 'none'"):
        assert part in policy.split("; ")
    scripts = policy.split("script-src ")[1].split(";")[0].split()
    assert len(scripts) == 2
    assert all(source.startswith("'sha256-") for source in scripts)  # nothing inline, no eval
    assert "<link" not in text


def with_plain_options(text):
    """The text of a page without the marks that keep options on one line."""
    return re.sub(r"<span>(--[a-z-]+)</span>", r"\1", text)


def test_the_page_tells_how_scores_were_made(site):
    text = site.read_text(encoding="utf-8")
    assert "<b>broken</b>" in text
    assert "&lt;by zero&gt;" in text
    whole = "--systems ReverseDuffing --estimators ekf strong_tracking_ekf --condition noise5"
    assert whole in with_plain_options(text)
    assert f"python {sys.version.split()[0]}" in text
    assert "assumed_noise=0.003" in text
    assert "A conservative oscillator" in text


def refused(capsys, *arguments):
    assert main(["report", *map(str, arguments)]) == 2
    told = capsys.readouterr().err
    assert told.startswith("pinnobs: error: ")
    assert told.count("\n") == 1
    return told


def test_without_rows_it_says_so(capsys, tmp_path):
    assert "no rows file" in refused(capsys, "-o", tmp_path)
    assert "there is no rows file" in refused(capsys, tmp_path / "none.jsonl")
    (tmp_path / "empty.jsonl").write_text("")
    assert "no scored episodes in" in refused(capsys, tmp_path / "empty.jsonl")
    assert list(tmp_path.iterdir()) == [tmp_path / "empty.jsonl"]


COMMON = {"date": "2030-01-02T00:00:00", "versions": {"numpy": "2"}}


@cache
def plain():
    """The page of the made rows alone."""
    return drawn()


def drawn(*more):
    """The page of made rows of two estimators on two systems and two conditions, and of more."""
    made = [row for name in ("ekf", "ukf") for row in rows_of(name, [0.1] * 60, **COMMON)]
    for condition in ("load_step", "noise5"):
        facts = {"condition": condition, "ranked": condition == "load_step", **COMMON}
        for name in ("ekf", "ukf"):
            made += rows_of(name, [0.1] * 60, env_id="pinnobs/Motor-v0", **facts)
    return draw(page_model(Stored([*made, *more], []), []))


def tables_of(text):
    markup = text.partition("<script")[0]
    return re.findall(r"<table.*?</table>", markup, re.DOTALL)


def test_sections_whose_titles_differ_in_signs_have_links_of_their_own():
    names = ("X-v0.", "X-v0,", "X--v0")
    text = drawn(*(row for name in names for row in rows_of("ekf", [0.1], env_id=name, **COMMON)))
    links = re.findall('<a href="#([^"]*)"', text)
    assert links == re.findall('<section id="([^"]*)"', text)
    assert len(set(links)) == len(links) > 5


def test_those_trained_on_each_record_have_a_section_if_there_are_any():
    own = {"training": {"per_record": True, "seconds": 1.0}, "track": "offline"}
    text = drawn(*rows_of("pinn (guided)", [0.1] * 4, **own, **COMMON))
    section = text[text.index('<section id="on-record">') :].partition("</section>")[0]
    assert "<h2>Trained on each record</h2>" in section
    assert '<a href="#on-record">Trained on each record</a>' in text
    overview, game = tables_of(section)  # of the one game that it played
    for table in (overview, game):
        assert [name in table for name in ("ekf", "ukf", "pinn (guided)")] == [True] * 3
    assert "pinnobs/X-v0, benchmark, nominal" in section
    main = text[text.index('<section id="overview">') :].partition("</section>")[0]
    assert "ekf" in main
    assert "pinn (guided)" not in main
    assert "on-record" not in plain()
    assert "rained on each record" not in plain()


def test_every_table_says_what_each_estimator_knows():
    own = {"training": {"per_record": True}, "track": "offline", "knows": ["true states"]}
    text = drawn(*rows_of("pinn", [0.1] * 4, **own, **COMMON))
    tables = tables_of(text)
    # Overviews, games, those on each record, conditions of all and of one system, methods.
    assert len(tables) == 2 + 2 + 1 + 2 + 1
    for table in tables:
        assert re.search(r">knows<", table)
        assert table.count("model") == 2


def test_a_floor_is_shown_but_is_no_contender():
    facts = {"track": "floor", "effective_sample_size": 900.0, "game_hash": "game", **COMMON}
    floor = rows_of("exact_bayes", [0.05] * 60, **facts)
    text, alone = drawn(*floor), plain()
    for chip in ("exact_bayes", "exact Bayes"):
        assert f"{chip}</button>" not in text
    assert [each.partition("<")[0] for each in text.split("<b>")[1:4]] == [
        each.partition("<")[0]
        for each in alone.split("<b>")[1:4]  # systems, estimators, episodes
    ]
    assert "at least 900 effective draws" in text
    assert "<b>Error over exact Bayes.</b>" in text
    assert '"over_floor1"' in text
    assert "--estimators ekf ukf --episodes" in with_plain_options(text)  # no command names it
    methods = tables_of(text)[-1].replace("<wbr>", "")
    assert "exact_bayes" in methods
    assert "Error over exact Bayes" not in alone


def test_a_page_of_a_floor_alone_is_no_error():
    facts = {"track": "floor", "game_hash": "game", **COMMON}
    text = draw(page_model(Stored(rows_of("exact_bayes", [0.05] * 60, **facts), []), []))
    assert "exact_bayes" in text.replace("<wbr>", "")


def test_a_condition_names_the_systems_that_are_left_out_of_it():
    facts = {"condition": "delay1", "ranked": False, **COMMON}
    made = rows_of("ukf", [0.1] * 60, **facts)
    other = {"env_id": "pinnobs/Y-v0", "free_over_known": 6.0, "nominal_over_free": 1.2}
    text = drawn(*made, *rows_of("ukf", [0.1] * 60, **other, **facts))
    heat = text[text.index('<section id="conditions">') :].partition("</section>")[0]
    over_all = heat.partition("</table>")[0]
    lines = re.findall(r'<tr><th scope="row"[^>]*>([^<]*)</th>', over_all)
    conditions = {"nominal", "noise5", "load_step", "delay1, without Y-v0"}
    assert {*lines} - {"worst rank", "knows"} == conditions


def test_factors_are_over_one_setup():
    """One episode of the paper's setup would leave only ranks of those that played it."""
    paper = rows_of("ekf", [0.1], setup="paper", game_hash="paper", **COMMON)
    text, alone = drawn(*paper), plain()
    conditions = r'<section id="conditions">.*?</section>'
    found, expected = (re.findall(conditions, each, re.DOTALL) for each in (text, alone))
    assert found == expected != []
    assert "only: paper." in text


def changed(scored, path, **changes):
    first = {**json.loads(scored.read_text().splitlines()[0]), **changes}
    path.write_text(json.dumps(first) + "\n")
    return path


def test_another_schema_and_contradictions_are_refused(capsys, scored, tmp_path):
    old = changed(scored, tmp_path / "old.jsonl", schema=1)
    assert "schema 1" in refused(capsys, old)
    other = changed(scored, tmp_path / "other.jsonl", nrmse=0.123)
    told = refused(capsys, scored, other)
    assert f"{scored} and {other} give different scores of the same episode" in told


def test_an_unwritable_folder_is_refused(capsys, scored, tmp_path):
    (tmp_path / "file").write_text("")
    assert "cannot write to folder" in refused(capsys, scored, "-o", tmp_path / "file")


def test_a_missing_extra_is_named(capsys, scored, monkeypatch):
    monkeypatch.setitem(sys.modules, "altair", None)
    for name in [name for name in sys.modules if name.startswith("pinnobs_gym.leaderboard.site")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr("pinnobs_gym.leaderboard.site.page", raising=False)
    monkeypatch.delattr("pinnobs_gym.leaderboard.site.charts", raising=False)
    assert "pip install 'pinnobs-gym[report]'" in refused(capsys, scored)


def test_several_files_make_one_page_and_curves_may_be_missing(capsys, scored, tmp_path):
    lines = scored.read_text().splitlines(keepends=True)
    half, rest = tmp_path / "a.jsonl", tmp_path / "b.jsonl"
    half.write_text("".join(lines[:6]))
    rest.write_text("".join(lines[4:]))  # two are in both
    assert main(["report", str(half), str(rest), "-o", str(tmp_path / "site")]) == 0
    text = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    assert "No curves are stored" in text
    assert f"<b>{len(lines) - 1}</b> scored episodes" in text  # all but the failure, each once


def test_charts_are_valid():
    styled = Styled(styles(["ekf", "ukf"], "ukf"), "ukf")
    for spec in (
        errors(styled, 20.0, 1e-3, 1.0),
        settling(styled, 20.0),
        state(styled, 0, "x1", 20.0, (0.0, 1.0), True),
        error(styled, 0, 20.0, [0.1, 0.2]),
        factors(styled, ["ekf"], 0.5, 20.0),
        ratios(styled, ["ekf"], 0.5, 20.0),
        over_floor(styled, ["ekf"], 0.5, 20.0),
        cost(styled, "us", "µs", (0.1, 10.0), (0.5, 20.0)),
    ):
        alt.LayerChart.from_dict(spec)  # validates


@pytest.fixture
def opened(browser, site):
    """Opens the page without network; its console has to stay silent, and nothing is asked for."""
    contexts, said, asked = [], [], []

    def opened(path=site, **options):
        context = browser.new_context(offline=True, **options)
        contexts.append(context)
        context.set_default_timeout(1000 * PATIENCE)
        page = context.new_page()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(path.as_uri())
        return page

    yield opened
    for context in contexts:
        context.close()
    assert said == []
    assert {url.split(":")[0] for url in asked} <= {"file", "data"}


def draw_all(page):
    """Open what is folded and scroll until every chart is drawn."""
    page.eval_on_selector_all("details", "all => all.forEach(each => { each.open = true })")
    page.evaluate(
        """async () => {
            for (const chart of document.querySelectorAll("[data-chart]")) {
                chart.scrollIntoView();
                await new Promise((done) => requestAnimationFrame(() => setTimeout(done)));
            }
        }"""
    )
    until(
        lambda: page.evaluate(
            "[...document.querySelectorAll('[data-chart]')].every(chart => chart.dataset.drawn)"
        )
    )


def test_all_charts_are_drawn_and_filled(opened):
    page = opened(viewport={"width": 1280, "height": 900})
    draw_all(page)
    charts = page.evaluate(
        """() => [...document.querySelectorAll("[data-chart]")].map((chart) => {
            const marks = ".mark-line path, .mark-symbol path, .mark-rect path";
            const paths = [...chart.querySelectorAll(marks)].map((path) => path.getAttribute("d"));
            const { width, height } = chart.querySelector("svg").getBoundingClientRect();
            const full = paths.some((path) => path && path !== "M0,0");
            return [chart.dataset.chart, full, width, height];
        })"""
    )
    # Two across systems; each game's errors and settling; 2 and 5 states; one with a reference.
    names = {name for name, *_ in charts}
    assert {"factors", "us", "errors0", "settling0", "ratios2", "state0-4"} <= names
    for name, full, width, height in charts:
        assert full, name
        assert width > 300, name
        assert height > 60, name


@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_moves_when_charts_are_drawn(opened, width):
    """Else a click whose button is pressed before and released after would miss."""
    page = opened(viewport={"width": width, "height": 900})
    page.eval_on_selector_all("details", "all => all.forEach(each => { each.open = true })")
    places = """() => [...document.querySelectorAll("[data-chart], button, select")].map(
        (each) => each.getBoundingClientRect().top)"""
    undrawn = page.evaluate("document.querySelectorAll('[data-chart]:not([data-drawn])').length")
    assert undrawn > 5
    before = page.evaluate(places)
    draw_all(page)
    page.evaluate("window.scrollTo(0, 0)")
    assert page.evaluate(places) == before
    spilled = """() => [...document.querySelectorAll("[data-chart]")].filter((chart) =>
        Math.abs(chart.querySelector("svg").getBoundingClientRect().height
            - chart.getBoundingClientRect().height) > 1).map((chart) => chart.dataset.chart)"""
    assert page.evaluate(spilled) == []  # and nothing is cut off


def column(page, table, i, rows="tr:not(.floor)"):
    cells = page.locator(f"{table} tbody {rows} > :nth-child({i})").all()
    return [cell.inner_text().strip() for cell in cells]


def test_columns_sort_both_ways(opened):
    page = opened(viewport={"width": 1280, "height": 900})
    draw_all(page)
    table = "#ReverseDuffing-v0 table"
    before = column(page, table, 3)
    head = page.locator(f"{table} thead th").nth(2)
    assert head.inner_text() == "steady"
    head.locator("button").click()
    values = [float(text.split()[0].replace("∞", "inf")) for text in column(page, table, 3)]
    assert values == sorted(values)
    assert len(set(values)) > 1
    assert head.get_attribute("aria-sort") == "ascending"
    head.locator("button").click()
    assert [
        float(text.split()[0].replace("∞", "inf")) for text in column(page, table, 3)
    ] == sorted(values, reverse=True)
    page.locator(f"{table} thead button").nth(1).click()
    names = column(page, table, 2)
    assert names == ["ekf", "open_loop", "rts_smoother"]
    everyone = column(page, table, 2, rows="tr")
    assert everyone[: len(names)] == names  # the floor stays at the end
    assert len(everyone) > len(names)
    assert sorted(before) == sorted(column(page, table, 3))


HOSTILE = ["<!--<script>", "</script><script>alert(1)</script>", "<img src=http://x.example/y>"]
HOSTILE += ["a\\nb\\", "\\u0041\\x41", "'+alert(1)+'", '"]}', "${alert(1)}", "{{ 7 * 7 }}", "'"]
HOSTILE += ["__proto__", "constructor", "toString", "data", "null", "1", "datum.x", "a.b[0]"]
HOSTILE += ["a\u2028b", "a\x1b[31mb", "a\u202eb", "a\x00b", "a\nb", "a\ud800b", "x" * 999]


@pytest.fixture(scope="module")
def hostile():
    """The page of estimators of these names, of which the first names all else, too."""
    name = "'\"`</script><!--<script>\\u0041\x1b[31m\u2028${1}{{ 1 }}__proto__"
    facts = COMMON | {"versions": {name: name}, "knows": [name]}
    facts |= {"options": {name: name}, "training": {"config": {}, "seconds": 1.0}}
    made = []
    for condition in ("nominal", name):
        for each in (name, *HOSTILE):
            more = {"condition": condition, "nrmse_over_reference": 2.0, **facts}
            more["settings"] = {name: name} if each is name else {}
            made += rows_of(each, [0.1] * 60, env_id=name, setup=name, **more)
    failed = {"env_id": name, "setup": name, "condition": name, "estimator": name, "error": name}
    return page_model(Stored(made, [{**failed, "episode": "seed:0", "episodes": 1}]), [])


def test_no_name_is_in_the_code_of_a_chart(hostile):
    """Only in titles of axes, which are drawn as they are."""
    charts = charts_of(hostile, styles(list(hostile.tracks), hostile.main.places.peer))

    def code(value):
        if isinstance(value, dict):
            return {k: code(v) for k, v in value.items() if k != "title" or isinstance(v, dict)}
        return [code(each) for each in value] if isinstance(value, list) else value

    specs = json.dumps([code(chart["spec"]) for chart in charts.charts.values()])
    assert len(charts.charts) >= 3
    for name in HOSTILE:
        if len(name) > 4 and name not in ("datum.x", "constructor"):
            assert json.dumps(name)[1:-1] not in specs
    assert all(name.isprintable() for name in charts.names)


def test_hostile_names_run_nothing_and_stop_no_chart(hostile, opened, tmp_path):
    path = tmp_path / "index.html"
    path.write_text(draw(hostile), encoding="utf-8")
    page = opened(path, viewport={"width": 1280, "height": 900})
    draw_all(page)
    labels = page.locator("[data-chart=factors] .role-axis-label text").all_text_contents()
    assert "__proto__" in labels
    assert "a�b" in labels
    chips = page.locator(".chip").all_text_contents()
    assert len(chips) == len(HOSTILE) + 1
    assert all(chip.strip().isprintable() for chip in chips)


def test_nothing_is_wider_than_a_phone(opened):
    page = opened(viewport={"width": 390, "height": 844}, is_mobile=True, has_touch=True)
    draw_all(page)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    wide = page.evaluate(
        "[...document.querySelectorAll('main *, header *')].filter(each => !each.closest('.box, "
        "#picker, nav') && each.getBoundingClientRect().right > 391).map(each => each.tagName)"
    )
    assert wide == []
    # A table that is wider scrolls in its own box.
    box = page.locator("#overview .box")
    assert box.evaluate("box => box.scrollWidth > box.clientWidth")
    for each in ("nav", "#picker"):  # so does a line of links or of chips
        right = page.locator(each).evaluate("each => each.getBoundingClientRect().right")
        assert right <= 391


def test_a_phone_shows_numbers_beside_the_names_that_stay(opened):
    """The column of names stands still when a table is scrolled."""
    page = opened(viewport={"width": 390, "height": 844}, is_mobile=True, has_touch=True)
    draw_all(page)
    page.eval_on_selector_all(
        ":is(.scores, .methods) tbody th[scope=row]",
        "all => all.forEach(each => { each.append(' (guided by a long name), 45 s') })",
    )
    widths = page.eval_on_selector_all(
        ":is(.scores, .methods) tbody th[scope=row]",
        "all => all.map(each => each.offsetWidth / each.closest('.box').clientWidth)",
    )
    assert len(widths) > 10
    assert max(widths) < 0.6


@pytest.mark.parametrize("width", [390, 1280])
def test_titles_and_names_of_charts_end_within_them(opened, tmp_path, width):
    made = rows_of("ukf", [0.1] * 60, **COMMON)
    for i, name in enumerate(("first", "a name of a recipe that takes much room")):
        own = {"us_per_step": 10.0 ** (i + 1), **COMMON}
        made += rows_of(name, [0.05 * (1 - i / 2)] * 60, **own)
        floor = {"track": "floor", "effective_sample_size": 900.0, **COMMON}
        made += rows_of("exact_bayes", [0.02] * 60, **floor) if not i else []
    path = tmp_path / "index.html"
    path.write_text(draw(page_model(Stored(made, []), [])), encoding="utf-8")
    page = opened(path, viewport={"width": width, "height": 900})
    draw_all(page)
    outside = """() => [...document.querySelectorAll("[data-chart] svg text")].filter((text) => {
        const [own, svg] = [text, text.ownerSVGElement].map((e) => e.getBoundingClientRect());
        return own.width && (own.right > svg.right + 1 || own.left < svg.left - 1);
    }).map((text) => text.textContent)"""
    assert page.locator("[data-chart=over_floor0]").count() == 1
    assert page.locator("[data-chart=us] text", has_text="first").count() == 2  # on its ground
    assert page.evaluate(outside) == []


def test_no_heading_stands_over_an_empty_column():
    text = drawn()  # without covariances, a reference and a floor
    for table in tables_of(text):
        if "<tfoot" in table or 'class="sortable methods"' in table:
            continue
        names = re.findall(r"<th><button[^>]*>(.*?)</button>", table)
        lines = re.findall(r"<tr[^>]*>((?:(?!</tr>).)*<td.*?)</tr>", table, re.DOTALL)
        cells = [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", line, re.DOTALL) for line in lines]
        assert cells
        for i, name in enumerate(names):
            assert name == "rank" or any(line[i].strip() for line in cells), name


def test_letters_stand_for_the_same_in_all_overviews():
    own = {"training": {"per_record": True, "seconds": 1.0}, "track": "offline"}
    more = rows_of("pinn", [0.1] * 4, **own, **COMMON | {"knows": ["noise", "model"]})
    other = {"env_id": "pinnobs/Y-v0", "knows": ["model", "states"], **COMMON}
    more += rows_of("kkl", [0.1] * 60, **other)  # not where the other one has played
    text = drawn(*more).partition("<script")[0]
    legends = re.findall(r"knows: ([^.]*)\.", text)
    assert len(legends) == 2
    meant = [dict(part.split(" ", 1) for part in legend.split(", ")) for legend in legends]
    for letter in meant[0].keys() & meant[1].keys():
        assert meant[0][letter] == meant[1][letter]
    assert len(meant[0] | meant[1]) == len({*meant[0].values(), *meant[1].values()})


def test_on_a_phone_scores_come_first(opened):
    page = opened(viewport={"width": 390, "height": 844}, is_mobile=True, has_touch=True)
    draw_all(page)
    page.evaluate("window.scrollTo(0, 0)")
    table, chart = page.locator("#overview table"), page.locator("[data-chart=factors]")
    score = table.locator("tbody tr").nth(1).locator("td").nth(1)  # the peer has no interval
    assert "(" in score.inner_text()  # the factor to the peer, with its interval
    box, below = score.bounding_box(), chart.bounding_box()
    assert box is not None
    assert below is not None
    assert box["x"] + box["width"] <= 390
    assert box["y"] + box["height"] <= 844
    assert below["y"] > box["y"]
    wide = opened(viewport={"width": 1280, "height": 900})
    draw_all(wide)
    chart, table = wide.locator("[data-chart=factors]"), wide.locator("#overview table")
    assert chart.bounding_box()["y"] < table.bounding_box()["y"]  # where there is room for both


def test_the_whole_overview_fits_a_window_of_usual_width(opened, tmp_path):
    """Of all systems of the package, with the columns of the floor and of divergence."""
    made = []
    for name, cls in SYSTEMS.classes().items():
        facts = {"env_id": f"pinnobs/{name}-v0", "condition": cls.ranked_condition, **COMMON}
        facts["knows"] = ["model", "prior", "noise", "initial set", "simulated true states"]
        for each in ("kkl_autoencoder", "pinn_obs_replay (guided by a smoother)", "ukf"):
            made += rows_of(each, [0.012345] * 58 + [9.0] * 2, ranked=True, **facts)
        floor = {"track": "floor", "estimator_hash": "floor", "effective_sample_size": 900.0}
        made += rows_of("exact_bayes", [0.0123] * 60, ranked=True, **{**facts, **floor})
    path = tmp_path / "index.html"
    path.write_text(draw(page_model(Stored(made, []), [])), encoding="utf-8")
    page = opened(path, viewport={"width": 1280, "height": 900})
    heads = page.locator("#overview thead th").all_inner_texts()
    assert len(heads) >= 8 + len(SYSTEMS.classes())
    box = page.locator("#overview .box")
    assert box.evaluate("box => box.scrollWidth") <= box.evaluate("box => box.clientWidth")
    assert "knows: a model, b prior" in page.locator("#overview .note").first.inner_text()


def test_the_page_says_what_estimators_are(site):
    text = site.read_text(encoding="utf-8")
    section = text.partition('<section id="estimators">')[2].partition("</section>")[0]
    said = " ".join(re.sub(r"<[^>]*>", " ", section.replace("<wbr>", "")).split())
    for name, what in (
        ("ekf", "The continuous-discrete extended Kalman filter (Jazwinski 1970, section 8.3)."),
        ("open_loop", "The model integrated from x̂₀, without use of the outputs."),
    ):
        assert f" {name} {what}" in said
    assert section.count("<dt>") == 4


def test_what_an_unknown_estimator_is_comes_from_its_rows():
    made = rows_of("mine", [0.1] * 6, made_by={"estimator": "my_module:Mine"}, **COMMON)
    made += rows_of("other", [0.1] * 6, **COMMON)
    names = {each.name: each.what for each in page_model(Stored(made, []), []).abouts}
    assert names == {
        "mine": "not of this installation: my_module:Mine",
        "other": "not of this installation",
    }


def test_the_dark_changes_page_and_charts(opened):
    page = opened(viewport={"width": 1280, "height": 900}, color_scheme="light")
    look = """() => {
        const line = document.querySelector('[data-chart=errors2] .mark-line path[stroke]');
        return [getComputedStyle(document.body).backgroundColor, line.getAttribute('stroke')];
    }"""
    draw_all(page)
    light = page.evaluate(look)
    page.emulate_media(color_scheme="dark")
    until(
        lambda: page.evaluate(
            "[...document.querySelectorAll('[data-chart]')].every(c => c.dataset.drawn === 'dark')"
        )
    )
    dark = page.evaluate(look)
    assert light[0] == "rgb(255, 255, 255)"
    assert dark[0] != light[0]
    assert dark[1] != light[1]


def test_choices_change_what_is_drawn(opened):
    page = opened(viewport={"width": 1280, "height": 900})
    draw_all(page)
    bands = page.locator("[data-chart=errors2] .mark-area path")
    before = bands.count()
    chip = page.locator(".chip", has_text="rts_smoother")
    assert chip.get_attribute("aria-pressed") == "false"
    chip.click()
    assert chip.get_attribute("aria-pressed") == "true"
    until(lambda: bands.count() == before + 1)
    estimate = "document.querySelector('[data-chart=state2-1] .mark-area').innerHTML"
    first = page.evaluate(estimate)
    page.locator("#ReverseDuffing-v0 select[data-param=selected]").select_option(
        label="rts_smoother"
    )
    until(lambda: page.evaluate(f"{estimate} !== {json.dumps(first)}"))
