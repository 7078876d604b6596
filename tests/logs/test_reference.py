"""Reference states of logs: where they are put, and what is refused."""

import re
from dataclasses import dataclass

import numpy as np
import pytest
from driven_spring import Drive, DrivenSpring, write_csv

from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.logs.reference import read_reference
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import Setup, System, independent, stack


@dataclass(frozen=True)
class LinearSpring(DrivenSpring):
    """The same spring with a force on straight lines."""

    input_hold = "linear"


@dataclass(frozen=True)
class Counter(System):
    """A map."""

    discrete = True
    state_names = ("n",)
    output_names = ("n",)
    scale = (1.0,)
    setups = {"benchmark": Setup(dt=1.0, noise_std=0.1, xhat0=(0.0,), P0=independent(1.0))}

    def f(self, t, x, u):
        return stack(x, 0.9 * x[..., 0])

    def h(self, t, x, u):
        return stack(x, x[..., 0])


def log_of(path, system=None):
    system = system or DrivenSpring()
    return read_log(path, system, Prior.of(system, type(system).setups["benchmark"], 1))


@pytest.fixture
def log(tmp_path):
    path = write_csv(
        tmp_path / "log.csv", ("t", "q", "force", "q_std"), [1, 2, 4], [5, 6, 7], [10, 20, 40],
        [0.1, np.nan, 0.3],
    )  # fmt: skip
    return log_of(path)


def test_times_between_samples_become_rows_without_outputs(tmp_path, log):
    reference = write_csv(
        tmp_path / "ref.csv",
        ("v", "t", "note", "q"),
        [1, 2, 3, 4, 5, 6],
        [0.5, 2, 3, 3.5, 4, 9],
        [0, 0, 0, 0, 0, 0],
        [np.nan, 20, np.nan, 40, np.nan, 60],
    )
    found = read_reference(reference, log)
    nan = np.nan
    assert found.record.t.tolist() == [1, 2, 3, 3.5, 4]
    assert found.own.tolist() == [True, True, False, False, True]
    np.testing.assert_array_equal(found.record.y[0, :, 0], [5, 6, nan, nan, 7])
    np.testing.assert_array_equal(found.record.u[0, :, 0], [10, 20, 20, 20, 40])  # held
    np.testing.assert_array_equal(found.record.noise_std[0, :, 0], [0.1, nan, nan, nan, 0.3])
    known = [[nan, nan], [20, 2], [nan, 3], [40, 4], [nan, 5]]
    np.testing.assert_array_equal(found.truth[0], known)
    assert any("not used: note" in line for line in found.notes)
    assert any("2 of 6 rows are at times outside" in line for line in found.notes)


def test_inputs_on_straight_lines_are_joined_at_the_times_of_the_reference(tmp_path, log):
    own = log_of(log.path, LinearSpring())
    reference = write_csv(tmp_path / "ref.csv", ("t", "q"), [1.25, 2.5, 3.0], [0, 0, 0])
    found = read_reference(reference, own)
    np.testing.assert_allclose(found.record.u[0, :, 0], [10, 12.5, 20, 25, 30, 40])


def test_times_with_few_digits_are_those_of_their_samples(tmp_path):
    drive = Drive(samples=20)
    drive.t = 5.0 + np.arange(20) / 30
    log = log_of(drive.write_log(tmp_path / "log.csv"))
    reference = write_csv(tmp_path / "ref.csv", ("t", "q"), drive.t.round(8), drive.x[:, 0])
    found = read_reference(reference, log)
    assert found.own.all()
    np.testing.assert_array_equal(found.truth[0, :, 0], drive.x[:, 0])


def test_dates_of_a_reference_count_from_the_logs_first_sample(tmp_path):
    def at(seconds):
        return f"2026-03-01T12:00:{seconds:05.2f}Z"

    log, reference = tmp_path / "log.csv", tmp_path / "ref.csv"
    log.write_text("t,q,force\n" + "".join(f"{at(s)},1,2\n" for s in (10, 10.1, 10.2, 10.3)))
    reference.write_text("t,q\n2026-03-01T13:00:10.15+01:00,7\n")
    found = read_reference(reference, log_of(log))
    np.testing.assert_allclose(found.record.t, [0, 0.1, 0.15, 0.2, 0.3], atol=1e-9)
    assert found.truth[0, 2, 0] == 7
    reference.write_text("t,q\n0.15,7\n")
    with pytest.raises(ValueError, match="numbers in column t; expected dates and times"):
        read_reference(reference, log_of(log))
    reference.write_text("t,q\n2026-03-01T13:00:10.15,7\n")
    with pytest.raises(ValueError, match="the times of one alone have an offset"):
        read_reference(reference, log_of(log))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "is empty"),
        ("t,q\n", "no rows"),
        ("t,q\n1,\n2,\n", "has no number in its columns q"),
        ("q,v\n1,2\n", "has no column t"),
        ("t,course\n1,2\n", "has the columns t, course; expected t and some of q, v, the states"),
        ("t,Q\n1,2\n", "column 'Q' (did you mean 'q'?)"),
        ("t,q,q\n1,2,3\n", "has column q twice"),
        ("t,q\n1,2\n1,3\n", "line 3: t=1.0 after 1.0; t must increase"),
        ("t,q\n,2\n", "line 2"),
        ("t,q\n1,wet\n", "line 2: q='wet' is not a finite number"),
        ("t,q\n1,2,3\n", "line 2: 3 cells; expected 2"),
        ("t,q\n5,2\n6,3\n", "has times from 5 to 6; log"),
        ("t,q\n1.9999999,2\n2.0000001,3\n", "has two rows at the same sample"),
    ],
)
def test_wrong_references_are_told_in_one_line(tmp_path, log, text, expected):
    path = tmp_path / "ref.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(expected)) as told:
        read_reference(path, log)
    assert str(path) in str(told.value)
    assert "\n" not in str(told.value)


def test_the_outputs_of_a_log_are_no_reference_of_it(tmp_path, log):
    with pytest.raises(ValueError, match="is the log itself, whose q are outputs"):
        read_reference(log.path, log)
    both = write_csv(
        tmp_path / "both.csv", ("t", "y1", "u1", "v"), [1, 2, 3], [4, 5, 6], [7, 8, 9], [1, 2, 3]
    )
    assert read_reference(both, log_of(both)).truth[0, :, 1].tolist() == [1, 2, 3]


def test_a_map_has_whole_times(tmp_path):
    (tmp_path / "log.csv").write_text("t,n\n0,1\n5,2\n")
    log = log_of(tmp_path / "log.csv", Counter())
    (tmp_path / "ref.csv").write_text("t,n\n3,1\n")
    assert read_reference(tmp_path / "ref.csv", log).record.t.tolist() == [0, 3, 5]
    (tmp_path / "ref.csv").write_text("t,n\n3.5,1\n")
    with pytest.raises(ValueError, match=r"line 2: t=3.5; Counter is a map"):
        read_reference(tmp_path / "ref.csv", log)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "reference {} is empty; expected"),
        ("t,v\n", "reference {} has a header but no rows"),
        ("t,v\n1,2\n2,fast\n", "reference {}, line 3: v='fast' is not a finite number"),
        ("t,v\n1,2,3\n", "reference {}, line 2: 3 cells; expected 2, as in the header"),
        ("t,v,v\n1,2,3\n", "reference {} has column v twice"),
        ("t,v\n2,2\n1,3\n", "reference {}, line 3: t=1.0 after 2.0; t must increase"),
    ],
)
def test_messages_say_that_the_file_is_the_reference(tmp_path, log, text, message):
    path = tmp_path / "ref.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(message.format(path))):
        read_reference(path, log)
