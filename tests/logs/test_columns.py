"""Which columns of a log are read as what."""

import re
from dataclasses import dataclass

import numpy as np
import pytest

from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import Setup, System, independent, stack


@dataclass(frozen=True)
class Cell(System):
    """A cell; its voltage and its temperature are measured, and its current is known."""

    state_names = ("SoC", "T")
    output_names = ("voltage", "temperature")
    input_names = ("current",)
    scale = (0.3, 5.0)
    setups = {
        "benchmark": Setup(dt=1.0, noise_std=0.01, xhat0=(0.7, 20.0), P0=independent(0.2, 5.0))
    }

    def f(self, t, x, u):
        return stack(x, -u[..., 0] / 1e4, 0.0)

    def h(self, t, x, u):
        return stack(x, 3 + x[..., 0] - 0.02 * u[..., 0], x[..., 1])


@dataclass(frozen=True)
class Confusing(Cell):
    """A cell whose output and input have one name."""

    output_names = ("current", "temperature")


def read(tmp_path, text, *columns, cls=Cell):
    path = tmp_path / "log.csv"
    path.write_text(text)
    return read_log(path, cls(), Prior.of(*cls.configured(), 1), columns)


PLAIN = "t,y1,y2,u1\n0,3.5,20,1\n1,3.25,,2\n2,3,21,4\n"
TRUTH = np.array([[0, 3.5, 20, 1], [1, 3.25, np.nan, 2], [2, 3, 21, 4]])


def check(log):
    table = np.concatenate([log.record.t[:, None], log.record.y[0], log.record.u[0]], axis=1)
    np.testing.assert_allclose(table, TRUTH, rtol=1e-15)
    assert log.system.measured_input


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        (PLAIN, []),
        (PLAIN.replace("y1,y2,u1", "voltage,temperature,current"), []),
        (PLAIN.replace("t,y1", "t, voltage "), []),
        (
            "T,Time (s),mV,mA\n293.15,10,3500,1000\n,11,3250,2000\n294.15,12,3000,4000\n",
            ["t={Time (s)}-10", "y1=mV/1e3", "temperature=T-273.15", "current=mA*1e-3"],
        ),
        (PLAIN.replace(",", ";"), []),
        (PLAIN.replace(",", "\t"), []),
        (PLAIN.replace(",", ";").replace(".", ","), []),
        # A formula comes before a column of the same name, and may use that.
        (
            PLAIN.replace("3.5", "7").replace("3.25", "6.5").replace("2,3,21", "2,6,21"),
            ["voltage=y1/2"],
        ),
    ],
)
def test_the_same_log_in_several_ways(tmp_path, text, columns):
    check(read(tmp_path, text, *columns))


def test_a_constant_input_and_levels_of_noise(tmp_path):
    text = "t,voltage,y2,temperature_std,sd\n0,3,20,0.5,4\n1,3,20,,\n"
    log = read(tmp_path, text, "u1=1.5", "y1_std=sd/2")
    assert log.record.u[0, :, 0].tolist() == [1.5, 1.5]
    np.testing.assert_array_equal(log.record.noise_std[0], [[2.0, 0.5], [np.nan, np.nan]])
    assert log.notes == ()


def test_what_is_not_used_is_one_note(tmp_path):
    text = "t,note,y1,y2,u1,voltage,\n0,a,3,20,1,9,\n"
    log = read(tmp_path, text, "y1=y1")
    path = tmp_path / "log.csv"
    assert log.notes == (f"log {path}: columns that are not used: note, voltage",)
    header = ",".join(f"c{i}" for i in range(200))
    many = read(tmp_path, f"t,y1,y2,u1,{header}\n0,3,20,1{',' * 200}\n")
    assert many.notes[0].endswith("c18, c19 and 180 more")


def test_decimal_commas_are_noted(tmp_path):
    log = read(tmp_path, "t;y1;y2;u1\n0;3,5;20;1\n")
    path = tmp_path / "log.csv"
    assert log.notes == (f"log {path}: commas in numbers are read as decimal points",)


@pytest.mark.parametrize(
    ("text", "columns", "message"),
    [
        (
            "Time (s),Voltage,temp,u1\n0,1,2,3\n",
            [],
            "log PATH has no column t, y1 (voltage), y2 (temperature); Cell needs t, y1 (voltage), "
            "y2 (temperature), u1 (current), and the header has Time (s), Voltage, temp, u1; name "
            'other columns, as in --columns "t={Time (s)}" y1=Voltage y2=...',
        ),
        ("t,y1,y2\n0,1,2\n", [], "has no column u1 (current); Cell needs"),
        ("t,y1,voltage,y2,u1\n0,1,1,2,3\n", [], "has columns y1 and voltage, both of which are y1"),
        (PLAIN, ["y1=volt"], "columns 'y1=volt': log PATH has no column 'volt'; the header has t,"),
        (
            PLAIN.replace("y1", "voltage"),
            ["y1=Volt"],
            "did you mean voltage?",
        ),
        (
            PLAIN,
            ["volts=y1"],
            "columns 'volts=y1': expected target=formula, for Cell with a target",
        ),
        (PLAIN, ["volts=y1"], "did you mean voltage?"),
        (PLAIN, ["y1"], "columns 'y1': expected target=formula"),
        (PLAIN, ["y1=y1", "voltage=y1"], "columns 'voltage=y1': y1 is given twice"),
        (PLAIN, ["y1=y1*"], "columns 'y1=y1*': the end is unexpected"),
        (PLAIN, ["y1=" + "(" * 10_000], "(((...': 10000 characters; expected at most 500"),
        (PLAIN, ["y1=9**9**9"], "line 2: y1=inf, from '9**9**9'; expected a finite number"),
        (PLAIN, ["y1=log(-y1)"], "line 2: y1=nan, from 'log(-y1)'; expected a finite number"),
        (PLAIN, ["y2_std=y2-20"], "line 2: y2_std=0, from 'y2-20'; expected a number above 0"),
        (PLAIN, ["t=1/t"], "line 2: t=1/t is inf; expected a finite number"),
        ("t,a,b,u1\n0,1,x,1\n", ["y1=a", "y2=b"], "line 2: b='x' is not a finite number"),
        ("t;y1;y2;u1\n0;3,5;20;1\n1;3.5;20;1\n", [], "line 2: y1='3,5' is not a finite number"),
        (
            "t,y1,y2,u1\n0,3,5,20,5,1,0,1\n",
            [],
            "8 cells; expected 4, as in the header; numbers with decimal",
        ),
        ('t,y1,y2,u1\n"0,5",1,1,1\n', [], "line 2: t='0,5' is not a finite number"),
    ],
)
def test_mistakes_are_one_line(tmp_path, text, columns, message):
    with pytest.raises(ValueError, match=r"^(log|columns) ") as caught:
        read(tmp_path, text, *columns)
    said = str(caught.value).replace(str(tmp_path / "log.csv"), "PATH")
    assert message in said
    assert "\n" not in said
    assert len(said) < 400


def test_a_name_of_two_quantities_stands_for_none(tmp_path):
    text = "t,current,temperature,u1\n0,3,20,1\n"
    with pytest.raises(ValueError, match=re.escape("has no column y1; Confusing needs t, y1, y2")):
        read(tmp_path, text, cls=Confusing)
    log = read(tmp_path, text, "y1=current", cls=Confusing)
    assert (log.record.y[0, 0, 0], log.record.u[0, 0, 0]) == (3.0, 1.0)


def test_a_file_that_is_no_text_is_one_line(tmp_path):
    (tmp_path / "log.csv").write_bytes("t,T (°C)\n".encode("latin-1"))
    with pytest.raises(ValueError, match=r"cannot read log .*expected a text in UTF-8"):
        read_log(tmp_path / "log.csv", Cell(), Prior.of(*Cell.configured(), 1))
