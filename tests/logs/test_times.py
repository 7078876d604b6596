"""Sample times of logs: dates, wrong units, and clocks that jump."""

import re
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from linear import Linear
from other_motions import Counted, Exact

from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.logs.times import instant
from pinnobs_gym.simulation.record import Prior

SETUP = Linear.setups["benchmark"]


@dataclass(frozen=True)
class Stiff(Linear):
    stiff = True
    model_step = None


@dataclass(frozen=True)
class Yearly(Exact):
    setups = {"benchmark": replace(SETUP, dt=3e7, duration=3e9)}


def read(tmp_path, times, *columns, cls=Linear):
    path = tmp_path / "log.csv"
    path.write_text("t,y1,y2\n" + "".join(f"{t},1,1\n" for t in times))
    return read_log(path, cls(), Prior.of(cls(), cls.setups["benchmark"], 1), columns)


def refusal(tmp_path, times, *columns, cls=Linear):
    with pytest.raises(ValueError, match=r"^log ") as caught:
        read(tmp_path, times, *columns, cls=cls)
    assert "\n" not in str(caught.value)
    return str(caught.value).removeprefix(f"log {tmp_path / 'log.csv'}")


def test_dates_are_seconds_since_the_first_sample(tmp_path):
    """Steps of 0.1 s over midnight at the end of February in a leap year, in several spellings."""
    first = datetime(2028, 2, 29, 23, 59, 59, 750_000, tzinfo=UTC)
    instants = [first + timedelta(seconds=0.1) * k for k in range(6)]
    spelt = [
        instants[0].isoformat(),
        instants[1].isoformat().replace("+00:00", "Z"),
        instants[2].isoformat(" "),
        # 00:59 in one part of the world is the same instant as 23:59 in another
        *(
            k.astimezone(tz).isoformat()
            for k in instants[3:5]
            for tz in [datetime.fromisoformat("2028-01-01T00:00:00+05:30").tzinfo]
        ),
        instants[5].strftime("%Y%m%dT%H%M%S.250000000Z"),
    ]
    log = read(tmp_path, spelt)
    np.testing.assert_allclose(log.record.t, 0.1 * np.arange(6), rtol=0, atol=1e-9)
    assert log.start == first
    note = f"log {tmp_path / 'log.csv'}: t = 0 is 2028-02-29T23:59:59.750000+00:00"
    assert log.notes == (note,)


def test_a_change_to_summer_time_is_no_gap(tmp_path):
    spelt = ["2026-03-29T01:59:59.9+01:00", "2026-03-29T03:00:00.0+02:00"]
    np.testing.assert_allclose(read(tmp_path, spelt).record.t, [0, 0.1], atol=1e-9)


def test_nanoseconds_of_dates_count(tmp_path):
    spelt = ["2026-03-01 12:00:00.123456789", "2026-03-01 12:00:00.223456790"]
    log = read(tmp_path, spelt)
    np.testing.assert_allclose(log.record.t, [0, 0.100000001], rtol=0, atol=1e-12)
    assert log.start == datetime(2026, 3, 1, 12, 0, 0, 123457)


def test_a_formula_of_dates(tmp_path):
    spelt = [f"2026-03-01T12:00:{k:02}Z" for k in range(5)]
    log = read(tmp_path, spelt, "t=t/10+3")
    np.testing.assert_allclose(log.record.t, 3 + 0.1 * np.arange(5), rtol=0, atol=1e-12)
    assert log.notes[0].endswith(": t = 3 is 2026-03-01T12:00:00+00:00")


@pytest.mark.parametrize(
    ("times", "message"),
    [
        (
            ["2026-03-01T12:00:00Z", "2026-03-01T12:00:01"],
            "line 3: t='2026-03-01T12:00:01' has no o",
        ),
        (
            ["2026-03-01T12:00:00", "2026-03-01T12:00:01Z"],
            "line 3: t='2026-03-01T12:00:01Z' has an",
        ),
        (["2026-03-01T12:00:00", "12"], "line 3: t='12' is not a date and time by ISO 8601"),
        (["0", "2026-03-01T12:00:00"], "line 3: t='2026-03-01T12:00:00' is not a finite number"),
        (
            ["3/1/2026 12:00", "3/1/2026 12:01"],
            "line 2: t='3/1/2026 12:00' is neither a finite num",
        ),
        (["2026-02-30T12:00:00"], "line 2: t='2026-02-30T12:00:00' is neither"),
        (["2026-03-01T12:00:00", ""], "line 3: t='' is not a date"),
        (["0", ""], "line 3: t='' is not a finite number"),
        (["2026-10-25T02:59:59.9", "2026-10-25T02:00:00.0"], "line 3: t=-3599.9 after 0.0; t must"),
        (["0", "0.1", "0.1"], "line 4: t=0.1 after 0.1; t must increase"),
        (["1.7e9", "0"], "line 3: t=0.0 after 1700000000.0; t must increase"),
    ],
)
def test_times_that_are_none_or_of_two_kinds(tmp_path, times, message):
    assert message in refusal(tmp_path, times)


@pytest.mark.parametrize(
    ("unit", "start", "power", "advice"),
    [
        (1e3, 0, 3, '"t=t*1e-3"'),
        (1e6, 0, 6, '"t=t*1e-6"'),
        (1e9, 0, 9, '"t=t*1e-9"'),
        (1e3, 1.7e12, 3, '"t=t*1e-3"'),  # Unix time in ms
        (1e9, 1.7e18, 9, '"t=t*1e-9"'),
        (2.5e3, 0, 3, '"t=t*1e-3"'),  # samples less often
        (400, 0, 3, '"t=t*1e-3"'),  # and more often
        (2e4, 0, 3, '"t=t*1e-3"'),  # far too long, whatever it is
        (1e-3, 0, -3, '"t=t*1e3"'),
    ],
)
def test_times_in_another_unit_stop_with_advice_that_helps(tmp_path, unit, start, power, advice):
    times = [repr(float(start + 0.1 * unit * k)) for k in range(20)]
    said = refusal(tmp_path, times)
    assert f", {unit:.4g} times the dt=0.1 s of Linear, as if" in said
    assert f"give --columns {advice}, or t=t if it is right" in said
    log = read(tmp_path, times, advice.strip('"'))
    steps = np.diff(log.record.t)
    np.testing.assert_allclose(steps, 0.1 * unit / 10.0**power, rtol=1e-2)


def test_the_user_may_insist_on_a_unit(tmp_path):
    times = [100.0 * k for k in range(5)]
    assert read(tmp_path, times, "t=t").record.t.tolist() == times
    assert read(tmp_path, times, "t={t}*1").record.t.tolist() == times
    path = tmp_path / "log.csv"
    path.write_text(path.read_text().replace("t,", "millis,"))
    prior = Prior.of(Linear(), SETUP, 1)
    with pytest.raises(ValueError, match=re.escape('"t=millis*1e-3", or "t=millis*1" if it is')):
        read_log(path, Linear(), prior, ["t=millis"])


@pytest.mark.parametrize("factor", [0.05, 1.0, 30.0, 300.0, 3.5e-3, 3e-5])
def test_usual_steps_raise_no_doubt_of_the_unit(tmp_path, factor):
    assert len(read(tmp_path, [0.1 * factor * k for k in range(5)]).record.t) == 5


def test_the_advice_for_a_map_gives_whole_numbers(tmp_path):
    times = [1000 * k for k in range(1, 30)]
    assert "give --columns t=t/1e3, or t=t if it is right" in refusal(tmp_path, times, cls=Counted)
    log = read(tmp_path, times, "t=t/1e3", cls=Counted)
    assert log.record.t.tolist() == list(range(1, 30))


@pytest.mark.parametrize("cls", [Linear, Counted, Exact, Stiff])
@pytest.mark.parametrize("gap", [1e8, 1.7e9])
def test_a_clock_that_jumps_is_told_by_its_line(tmp_path, cls, gap):
    dt = cls.setups["benchmark"].dt
    times = [dt * k + (gap if k > 6 else 0) for k in range(10)]
    said = refusal(tmp_path, times, cls=cls)
    assert said.startswith(", line 9: ")  # after the header and seven samples
    assert said.endswith("with all times of one clock and in the unit of the model") or (
        "as if the clock jumped; expected all times of one clock" in said
    )


def test_long_gaps_of_slow_plants_are_none(tmp_path):
    times = [3e7 * k + (1.5e8 if k > 6 else 0) for k in range(10)]
    assert len(read(tmp_path, times, cls=Yearly).record.t) == 10
    assert len(read(tmp_path, [0, 0.1, 1e7, 1e7 + 0.1], cls=Exact).record.t) == 4


def test_a_formula_of_the_times_of_a_map_may_round(tmp_path):
    times = [round(0.1 * k, 1) for k in range(30)]
    assert times[3] / 0.1 != 3
    assert read(tmp_path, times, "t=t/0.1", cls=Counted).record.t.tolist() == list(range(30))


def test_times_of_a_map_are_whole_numbers(tmp_path):
    said = refusal(tmp_path, [0, 1, 2.5], cls=Counted)
    assert ", line 4: t=2.5; Counted is a map, whose times count steps; expected a whole" in said


@pytest.mark.parametrize(
    ("t", "step", "text"),
    [
        (1764262839.9, 0.1, "1764262839.9"),
        (123456.78, 0.01, "123456.78"),
        (2.5, 0.1, "2.5"),
        (1 / 3, 1.0, "0.333333"),
        (0.0, 0.1, "0"),
        (86400.0, 60.0, "86400"),
    ],
)
def test_a_time_is_shown_with_the_digits_that_tell_it_from_the_next(t, step, text):
    assert instant(t, t + step * np.arange(5)) == text
    assert float(instant(t + step, t + step * np.arange(5))) > float(text)
