"""Sensor logs as records."""

import re

import numpy as np
import pytest

from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.systems.induction_motor import InductionMotor
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing


def written(tmp_path, text):
    path = tmp_path / "log.csv"
    path.write_text(text)
    return path


def read(path, cls=ReverseDuffing):
    return read_log(path, cls(), Prior.of(*cls.configured(), 1))


def test_irregular_times_missing_samples_and_other_columns(tmp_path):
    path = written(tmp_path, "note,t,y1\na,0.0,1.5\nb,0.013,\nc,0.5,nan\nd,0.6,-2e-1\n")
    log = read(path)
    system, record = log.system, log.record
    assert record.t.tolist() == [0.0, 0.013, 0.5, 0.6]
    np.testing.assert_array_equal(record.y[0, :, 0], [1.5, np.nan, np.nan, -0.2])
    assert record.u.shape == (1, 4, 0)
    assert not system.measured_input


def test_inputs_of_the_log_replace_the_systems_own(tmp_path):
    path = written(tmp_path, "t,y1,y2,u1,u2\n0,1,2,3,4\n1,5,6,7,8\n")
    log = read(path, InductionMotor)
    system, record = log.system, log.record
    assert system.measured_input
    np.testing.assert_array_equal(record.u[0], [[3, 4], [7, 8]])


def test_without_input_columns_the_systems_own_input_is_taken(tmp_path):
    log = read(written(tmp_path, "t,y1,y2\n0,1,2\n0.1,5,6\n"), InductionMotor)
    system, record = log.system, log.record
    assert not system.measured_input
    np.testing.assert_allclose(record.u[0], [[350, 0], [350 * np.cos(30), 300 * np.sin(30)]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("t,y1\n", "header but no rows"),
        ("t,z\n0,1\n", r"no column y1; ReverseDuffing needs t, y1, and the header has t, z"),
        ("t,y1\n0,1\n2,1\n1,1\n", "line 4: t=1.0 after 2.0; t must increase"),
        ("t,y1\n0,1\n0,1\n", "line 3: t=0.0 after 0.0; t must increase"),
        ("t,y1\n0,one\n", "line 2: y1='one' is not a finite number"),
        ("t,y1\n0,1\n,1\n", "line 3: t='' is not a finite number"),
        ("t,y1\n0,inf\n", "line 2: y1='inf' is not a finite number"),
        ("t,y1\n0,1,2\n", "line 2: 3 cells; expected 2"),
        ('t,y1\n0,1\n1,"2\n2,3\n3,4\n', """line 3: '1,"2' is no line of a CSV file .*quote"""),
        ('t,y1\n\n0,1\n1,2"\n2,3\n', """line 4: y1='2"' is not a finite number"""),
        ('t,y1\n0,"1"2\n', """line 2: '0,"1"2' is no line of a CSV file"""),
        ('t,"y1\n0,1\n', """line 1: 't,"y1' is no line"""),
        ("t,y1\n0,1_000\n", "line 2: y1='1_000' is not a finite number"),
        ("t,y1\n0,１２\n", "line 2: y1='１２' is not a finite number"),
        ("t,y1\n١,2\n", "line 2: t='١' is neither|line 2: t='١' is not"),
        ("t,y1\n0,infinity\n", "line 2: y1='infinity' is not a finite number"),
        ("t,y1\n0,nan(ind)\n", r"line 2: y1='nan\(ind\)' is not a finite number"),
        ("t,y1\n0,0x10\n", "line 2: y1='0x10' is not a finite number"),
        ("t,y1\n0,1e400\n", "line 2: y1='1e400' is not a finite number"),
        ("t,y1\n0,9.9e37\n", "line 2: y1='9.9e37'; expected a number up to 1e\\+30, or an empty"),
        ("t,y1\n0,1\x00\n", r"line 2: y1='1\\x00' is not a finite number"),
        ("t\x00,y1\n0,1\n", r"line 1: 't\\x00,y1'; expected a text in UTF-8"),
    ],
)
def test_bad_logs_are_one_clear_line(tmp_path, text, message):
    with pytest.raises(ValueError, match=message) as caught:
        read(written(tmp_path, text))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("rows", [10, 20000])
def test_a_stray_quote_is_told_by_its_line_in_a_file_of_any_length(tmp_path, rows):
    """The cell that the quote opens would be longer than the largest that the csv module reads."""
    quoted = "".join(f"{k},{chr(34) if k == 5 else ''}{k}.123456\n" for k in range(rows))
    path = written(tmp_path, "t,y1\n" + quoted)
    with pytest.raises(ValueError, match=f"log {re.escape(str(path))}, line 7: ") as caught:
        read(path)
    assert len(str(caught.value)) < len(str(path)) + 150


def test_a_line_of_any_length_is_one_short_line(tmp_path):
    with pytest.raises(ValueError, match=", line 2: ") as caught:
        read(written(tmp_path, f"t,y1\n0,{'1' * 200_000}\n"))
    assert len(str(caught.value)) < 300 + len(str(tmp_path))


def test_quoted_cells_and_blank_lines(tmp_path):
    record = read(written(tmp_path, '"t","y1"\r\n\r\n"0","1.5"\r\n"1",""\r\n')).record
    np.testing.assert_array_equal(record.t, [0.0, 1.0])
    np.testing.assert_array_equal(record.y[0, :, 0], [1.5, np.nan])


@pytest.mark.parametrize(
    "change",
    [
        lambda text: b"\xef\xbb\xbf" + text.encode(),
        lambda text: text.replace("\n", "\r\n").encode(),
        lambda text: text.replace("\n", "\r").encode(),
        lambda text: text.replace("\n", "\r\r\n").encode(),
        lambda text: text.replace(",", " ,\t ").encode(),
        lambda text: text.replace("\n", "\n\n \n").encode(),
        lambda text: text.replace("1.5", "+1.5E0").encode(),
        lambda text: text.replace("nan", "-NaN").encode(),
    ],
)
def test_what_people_have_in_files_is_read(tmp_path, change):
    path = tmp_path / "log.csv"
    path.write_bytes(change("t,y1\n0,1.5\n1,nan\n2,-.5\n"))
    record = read(path).record
    np.testing.assert_array_equal(record.t, [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(record.y[0, :, 0], [1.5, np.nan, -0.5])


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("t,y1\n0,1\n".encode("utf-16"), "which is in UTF-16; expected a text in UTF-8"),
        ("t,y1,T\r\n0,1,20\r\n1,2,20 °\r\n".encode("cp1252"), "line 3: byte 0xb0 is not"),
        ("t,y1,T\r0,1,20 °\r".encode("cp1252"), "line 2: byte 0xb0 is not UTF-8; expected a text"),
    ],
)
def test_other_encodings_are_told_by_their_line(tmp_path, content, says):
    (tmp_path / "log.csv").write_bytes(content)
    with pytest.raises(ValueError, match=f"cannot read log .*{says}"):
        read(tmp_path / "log.csv")


def test_a_formula_that_overflows_is_told(tmp_path):
    path = written(tmp_path, "t,y1\n0,1\n1,2\n")
    says = r"line 2: y1=1e\+200, from 'y1\*1e200'; expected a finite number up to 1e\+30"
    with pytest.raises(ValueError, match=says):
        read_log(path, ReverseDuffing(), Prior.of(*ReverseDuffing.configured(), 1), ["y1=y1*1e200"])


def test_a_log_that_is_not_there(tmp_path):
    with pytest.raises(ValueError, match="cannot read log"):
        read(tmp_path / "none.csv")


def test_only_some_input_columns_are_not_enough(tmp_path):
    with pytest.raises(ValueError, match="no column u2"):
        read(written(tmp_path, "t,y1,y2,u1\n0,1,2,3\n"), InductionMotor)
