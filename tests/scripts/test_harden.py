"""The groups of `scripts/harden.py`, and how trials are judged."""

import json
import signal
from random import Random

import harden
import pytest
from hardening import faults, trial
from hardening.trial import Hung, Outcome, call, ended

HOLDING = harden.INPUTS
"""The groups of which no trial may end otherwise than it should."""


@pytest.fixture(scope="module")
def material():
    with harden.apart() as material:
        _ = material.trained  # is read before `nothing_published`
        yield material


@pytest.mark.parametrize("group", HOLDING)
def test_bad_inputs_are_refused_in_one_line(group, material):
    counts = harden.tried(group, material, seed=1, seconds=60, most=25)
    assert counts["shown"] == []
    assert counts["tried"] > 0
    assert counts["tried"] == counts["refused in one line"] + counts["accepted"]


def test_after_a_fault_the_same_command_does_the_rest(material):
    trials = faults.trials(material, Random(2))
    for fault in ("Ctrl-C", "ENOSPC"):
        chosen = next(each for each in trials if each.what.startswith(fault))
        assert chosen.run() == Outcome("accepted"), chosen.what


def test_the_same_seed_makes_the_same_trials(material):
    first, again, other = (
        harden.tried("unknowns", material, seed, seconds=60, most=9) for seed in (3, 3, 4)
    )
    for counts in (first, again, other):
        del counts["seconds"]
    assert first == again
    assert first["tried"] == other["tried"] == 9


def refuse(message, error=ValueError):
    def run():
        raise error(message)

    return run


@pytest.mark.parametrize(
    ("run", "kind"),
    [
        (lambda: None, "accepted"),
        (lambda: "other content", "wrong"),
        (refuse("file.csv: no number"), "refused"),
        (refuse("no number"), "unnamed"),
        (refuse("file.csv", KeyError), "traceback"),
        (refuse("file.csv", SystemExit), "traceback"),
        (refuse("stop", KeyboardInterrupt), "traceback"),
        (refuse("stop", BaseException), "traceback"),
    ],
)
def test_a_trial_is_judged_by_its_end(run, kind):
    assert call("it", run, ["file.csv"]).run().kind == kind


def test_what_has_to_be_refused_or_accepted_is_judged_so():
    assert call("it", lambda: None, ["x"], "refused").run().kind == "wrong"
    assert call("it", refuse("x"), ["x"], "accepted").run().kind == "wrong"


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="no such signal")
def test_what_does_not_end_is_ended(monkeypatch):
    monkeypatch.setattr(trial, "PATIENCE", 0.05)

    def endless():
        while True:
            pass

    with pytest.raises(Hung):
        ended(endless)
    assert call("it", endless, ["x"]).run().kind == "hung"  # whatever a command catches


def test_an_unknown_group_is_refused_and_a_summary_is_printed(capsys):
    assert harden.main(("nothing",)) == 2
    assert "unknown group 'nothing'; known are arguments, rows" in capsys.readouterr().err
    assert harden.main(("unknowns",), seconds=60, most=3) == 0
    group, summary = map(json.loads, capsys.readouterr().out.splitlines())
    assert group["group"] == "unknowns"
    assert summary["summary"]["tried"] == group["tried"] == 3
