"""The plants of the guides, exported as C, give the estimates of their logs."""

import re
import sys

import pytest
from exported import assert_replays, build, needs_c
from snippets import ROOT, cells, run_python

from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.simulation.record import Prior

GUIDES = (
    "battery",
    "attitude",
    "vehicle",
    "radar",
    "reactor",
    "discrete_map",
    "unknown_parameters",
)


def model_and_log(name, folder):
    """Write the model and the log of a guide. Returns the system, its setup and the log."""
    parts = []
    for _, text in cells(ROOT / "docs" / "guides" / f"{name}.md"):
        first, _, rest = text.partition("\n")
        if first.startswith("%%writefile "):
            (folder / first.split()[1]).write_text(rest, encoding="utf-8")
        elif "!pinnobs" in text:
            command = re.search(r"^!pinnobs .*$", text, re.M)[0]
            break
        else:
            parts.append(text)
    run_python("\n".join(parts), folder)
    module, kind = re.search(r"--system (\w+):(\w+)", command).groups()
    file = re.search(r"--log (\S+)", command)[1]
    columns = re.findall(r'"([^"]*)"', command)
    sys.modules.pop(module, None)
    system, setup = getattr(__import__(module), kind).configured()
    return setup, read_log(folder / file, system, Prior.of(system, setup, 1), columns)


@pytest.mark.slow
@needs_c
@pytest.mark.parametrize("name", GUIDES)
def test_the_plant_of_a_guide_is_exported(name, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    setup, log = model_and_log(name, tmp_path)
    estimator = EKF.for_setup(log.system, setup)
    # Where NumPy keeps estimates within bounds, sums have another order.
    tolerance = 1e-12 if log.system.state_box is None else 1e-9
    program = build(tmp_path, estimator, log.record.prior)
    assert_replays(program, estimator, log.record, tolerance)
    angles = log.system.output_period or log.system.state_period  # may be wider than their circle
    if log.system.state_box is None and not angles:
        estimator = UKF.for_setup(log.system, setup)
        program = build(tmp_path, estimator, log.record.prior)
        assert_replays(program, estimator, log.record, tolerance)
