"""What TensorBoard shows of a leaderboard and of evaluations, read back by TensorBoard itself."""

import io
from collections import defaultdict

import numpy as np
import pytest
from made_rows import rows_of
from PIL import Image
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.hparams import backend_context
from tensorboard.plugins.hparams.metadata import (
    SESSION_START_INFO_TAG,
    parse_session_start_info_plugin_data,
)

from pinnobs_gym.cli import main
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.row_format import FLOOR
from pinnobs_gym.scoring.tensorboard import log_folder, log_summaries

DRAWN = {"ReverseDuffing": (800, 420), "HarmonicOscillator": (800, 580)}
"""Width and height of the pictures, a panel per state."""


class Shown:
    """What TensorBoard reads from a folder."""

    def __init__(self, folder):
        events = EventMultiplexer()
        events.AddRunsFromDirectory(str(folder))
        events.Reload()
        self.runs = {run: EventAccumulator(str(folder / run)) for run in events.Runs()}
        for run in self.runs.values():
            run.Reload()
        provider = MultiplexerDataProvider(events, str(folder))
        self._hparams = backend_context.Context(TBContext(data_provider=provider))
        self._metadata = self._hparams.hparams_metadata(RequestContext(), "")

    def columns(self):
        """The columns of the HPARAMS table: settings, metrics."""
        table = self._table()
        return {one.name for one in table.hparam_infos}, {m.name.tag for m in table.metric_infos}

    def ordered(self):
        """The columns of settings in their order."""
        return [one.name for one in self._table().hparam_infos]

    def line(self, run):
        """The name of a run's line in that table."""
        content = self._metadata[run][SESSION_START_INFO_TAG]
        return parse_session_start_info_plugin_data(content).group_name

    def _table(self):
        context = RequestContext()
        return self._hparams.experiment_from_metadata(context, "", True, self._metadata, [])

    def settings(self, run):
        """The line of a run in the HPARAMS table."""
        found = parse_session_start_info_plugin_data(self._metadata[run][SESSION_START_INFO_TAG])
        kinds = {name: value.WhichOneof("kind") for name, value in found.hparams.items()}
        return {name: getattr(found.hparams[name], kind) for name, kind in kinds.items()}

    def scalars(self, run, tag):
        """Values by step."""
        return {event.step: event.value for event in self.runs[run].Scalars(tag)}


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A folder, its rows by run, and what TensorBoard shows of it."""
    folder = tmp_path_factory.mktemp("leaderboard")
    chosen = ["--systems", *DRAWN, "--estimators", "ekf", "luenberger", "--condition", "dt5"]
    assert (
        main(["leaderboard", *chosen, "--episodes", "3", "--jobs", "1", "--out", f"{folder}"]) == 0
    )
    runs = defaultdict(list)
    for row in rows.read(folder / "rows.jsonl"):
        runs[str(log_folder(folder, row).relative_to(folder / "tensorboard"))].append(row)
    return runs, Shown(folder / "tensorboard")


def test_the_runs_are_the_estimators_on_the_systems(played):
    runs, shown = played
    assert len(runs) == 4
    assert set(shown.runs) == set(runs)
    for run, group in runs.items():
        names = (group[0]["estimator"], group[0]["env_id"].removeprefix("pinnobs/"), "dt5")
        assert run == "/".join([*names, group[0]["estimator_hash"][:6]])


def test_the_name_of_a_run_leaves_out_what_is_usual(tmp_path):
    row = {"env_id": "pinnobs/A-v0", "setup": "benchmark", "condition": "nominal"}
    row |= {"estimator": "ekf", "estimator_hash": "0123456789ab"}
    found = {}
    for setup, condition in (("benchmark", "nominal"), ("paper", "nominal"), ("paper", "dt5")):
        path = log_folder(tmp_path, row | {"setup": setup, "condition": condition})
        found[setup, condition] = path.relative_to(tmp_path / "tensorboard").as_posix()
    assert list(found.values()) == [
        "ekf/A-v0/012345",
        "ekf/A-v0/setup-paper/012345",
        "ekf/A-v0/setup-paper/dt5/012345",
    ]


def test_the_error_over_time_is_a_curve(played):
    """The same errors whose squares over the whole episode are a score of it."""
    runs, shown = played
    for run in runs:
        curve = shown.scalars(run, "over samples/median_nrmse")
        assert len(curve) > 50
        assert list(curve) == sorted(curve)
        assert min(curve) == 0
        assert all(np.isfinite(list(curve.values())))
    own = next(run for run in runs if run.startswith("ekf/ReverseDuffing"))
    curve = shown.scalars(own, "over samples/median_nrmse")
    steps = np.array(list(curve))
    late = np.median([curve[k] for k in steps[steps > 0.5 * steps[-1]]])
    row = runs[own][0]
    assert late == pytest.approx(row["nrmse_tail"], rel=1.5)
    assert late < 0.1 * curve[0]


def test_the_table_is_led_by_estimator_and_system(played):
    runs, shown = played
    assert shown.ordered()[:2] == ["1 estimator", "2 system"]
    assert {shown.line(run) for run in runs} == set(runs)


def test_scalars_are_the_scores_of_the_rows(played):
    runs, shown = played
    for run, group in runs.items():
        for name in ("nrmse", "nrmse_transient", "nrmse_steady", "rmse", "settling", "peak"):
            expected = {rows.seed_of(r): r[name] for r in group if np.isfinite(r[name])}
            if expected:
                assert shown.scalars(run, f"episode/{name}") == pytest.approx(expected, rel=1e-6)
    assert shown.scalars(run, "episode/nrmse").keys() == {0, 1, 2}


def test_a_picture_of_the_first_episode_has_a_panel_per_state(played):
    runs, shown = played
    for run, group in runs.items():
        (image,) = shown.runs[run].Images("states")
        assert image.step == 0
        with Image.open(io.BytesIO(image.encoded_image_string)) as picture:
            name = group[0]["env_id"].removeprefix("pinnobs/").removesuffix("-v0")
            assert picture.size == DRAWN[name]
            assert len(picture.convert("RGB").getcolors(10**6)) > 50


def test_the_table_has_every_estimators_settings_and_medians(played):
    runs, shown = played
    settings, metrics = shown.columns()
    for run, group in runs.items():
        first = group[0]
        told = shown.settings(run)
        for name in ("setup", "condition", "track"):
            assert told[name] == first[name]
        assert told["1 estimator"] == first["estimator"]
        assert f"pinnobs/{told['2 system']}" == first["env_id"]
        for name, value in first["options"].items():
            assert told[name] == (value if isinstance(value, bool | int | float) else str(value))
        assert set(told) <= settings  # also what the first run of all has not
        diverged = np.array([r["diverged"] for r in group])
        assert shown.scalars(run, "diverged") == {0: pytest.approx(diverged.mean())}
        for name in ("nrmse", "rmse", "settling"):
            median = sorted(np.where(diverged, np.inf, [r[name] for r in group]))[1]
            if np.isfinite(median):
                assert shown.scalars(run, f"median/{name}") == {0: pytest.approx(median, rel=1e-6)}
            else:
                assert f"median/{name}" not in shown.runs[run].Tags()["scalars"]
        for name in ("nrmse_transient", "nrmse_steady_modulo"):
            square = np.mean([r[name] ** 2 for r in group])
            if np.isfinite(square):
                assert shown.scalars(run, f"rms/{name}") == {0: pytest.approx(np.sqrt(square))}
    assert {"median/nrmse", "rms/nrmse_transient", "diverged"} <= metrics


def test_a_floor_has_the_worst_precision_of_its_episodes(tmp_path):
    first = {"effective_sample_size": 4.0}
    floor = rows_of("exact_bayes", [3.0, 4.0], track=FLOOR, **first)
    floor[1]["effective_sample_size"] = 7.0
    log_summaries(tmp_path, floor)
    shown = Shown(tmp_path / "tensorboard")
    (run,) = shown.runs
    assert shown.settings(run)["track"] == "floor"
    assert shown.scalars(run, "effective_sample_size") == {0: 4.0}
    assert shown.scalars(run, "rms/nrmse_steady_modulo") == {0: pytest.approx(12.5**0.5)}
    assert "monte_carlo" not in shown.runs[run].Tags()["scalars"]


def test_other_settings_of_one_estimator_are_other_lines(tmp_path):
    where = ["--system", "ReverseDuffing", "--condition", "dt5", "--out", str(tmp_path)]
    for noise, seed in ((0.01, 4), (0.1, 6)):
        chosen = ["--set", f"assumed_noise={noise}", "--seed", f"{seed}"]
        assert main(["evaluate", *where, *chosen, "--episodes", "1"]) == 0
    # One more episode than there was: its picture is that of the one that is run now.
    assert main(["evaluate", *where, *chosen, "--episodes", "2"]) == 0
    shown = Shown(tmp_path / "tensorboard")
    first, second = sorted(shown.runs, key=lambda run: shown.settings(run)["assumed_noise"])
    assert shown.settings(first)["assumed_noise"] == 0.01
    assert shown.settings(second)["assumed_noise"] == 0.1
    stored = rows.read(tmp_path / "rows.jsonl")
    assert [rows.seed_of(row) for row in stored] == [4, 6, 7]
    assert shown.scalars(first, "episode/nrmse") == {4: pytest.approx(stored[0]["nrmse"])}
    both = {rows.seed_of(row): pytest.approx(row["nrmse"]) for row in stored[1:]}
    assert shown.scalars(second, "episode/nrmse") == both
    # A single episode is not drawn.
    assert {image.step for image in shown.runs[second].Images("states")} == {7}
