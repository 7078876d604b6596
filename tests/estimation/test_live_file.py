"""Files of live filters: they go on as if there had been no break, and what is no file of the same
filter is refused."""

import json
import re
import subprocess
import sys
import zipfile
from dataclasses import dataclass, replace

import numpy as np
import pytest
from linear import Linear
from live_runs import ONLINE, assert_as_expected, begun, expected, on_plant, online, samples
from many_plants import PLANTS
from quick_trainings import made
from waiting import PATIENCE

from pinnobs_gym import Estimator, Live, State
from pinnobs_gym.estimation.live_file import VERSION
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.robust_ekf import RobustEKF
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.noise import SampledLevel
from pinnobs_gym.simulation.system import stack
from pinnobs_gym.systems.harmonic_oscillator import HarmonicOscillator
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

BREAKS = (0, 1, 2, 7, 19)
"""Numbers of samples after which filters are saved and loaded."""


def with_breaks(estimator, record, path, **settings):
    """The estimates with a save and a load after each of the `BREAKS`."""
    live, estimates = begun(estimator, record, **settings), []
    for k, each in enumerate(samples(record)):
        if k in BREAKS:
            live.save(path)
            live = Live.load(path, estimator)
        estimates.append(live.update(*each))
    return estimates


@pytest.mark.parametrize("name", ONLINE)
def test_it_goes_on_as_without_a_break(name, tmp_path):
    estimator, record = online(name)
    assert_as_expected(with_breaks(estimator, record, tmp_path / "x"), expected(estimator, record))


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.__name__)
@pytest.mark.parametrize("name", ["ekf", "ukf", "mhe", "particle"])
def test_it_goes_on_as_without_a_break_on_other_plants(name, plant, tmp_path):
    if (found := on_plant(name, plant)) is None:
        pytest.skip("the estimator does not take this plant")
    estimator, record = found
    assert_as_expected(with_breaks(estimator, record, tmp_path / "x"), expected(estimator, record))


@pytest.mark.parametrize("name", ["ekf", "mhe", "particle"])
def test_late_samples_are_taken_after_a_break(name, tmp_path):
    estimator, record = online(name)
    played = samples(record)
    live = begun(estimator, record, late="replay", ring=8)
    for k in (0, 1, 2, 3, 5, 6, 7, 9, 10):
        live.update(*played[k])
    live.save(tmp_path / "x")
    other = Live.load(tmp_path / "x", estimator)
    for k in (8, 4, *range(11, 15)):
        estimate = other.update(*played[k])
    assert_as_expected([estimate], expected(estimator, record.first_samples(15)), 14)
    with pytest.raises(ValueError, match="older than the latest 8 samples"):
        other.update(*played[4])


@pytest.mark.parametrize("gap", [0.5, 0.01, np.float64(1e9)])
def test_its_own_settings_are_kept(gap, tmp_path):
    """Also a gap that is shorter than the setup's time between samples."""
    live = Live(EKF(ReverseDuffing()), longest_gap=gap, late="replay", ring=np.int64(3))
    live.update(0.0, 0.1)
    live.save(tmp_path / "x")
    other = Live.load(tmp_path / "x", EKF(ReverseDuffing()))
    assert other.t == 0.0
    with pytest.raises(ValueError, match=re.escape(f"at most longest_gap={gap:g} s")):
        other.update(1.2 * gap, 0.1)


def test_a_clock_of_large_numbers_is_saved(tmp_path):
    live = Live(EKF(ReverseDuffing()))
    live.update(1.7e18, 0.1)
    live.save(tmp_path / "x")
    assert Live.load(tmp_path / "x", EKF(ReverseDuffing())).t == 1.7e18


IN_ANOTHER_PROCESS = """
import sys
from pinnobs_gym import Live
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing
for name in sys.argv[2:]:
    live = Live.load(f"{sys.argv[1]}/{name}", ESTIMATORS.resolve(name)(ReverseDuffing()))
    for k in range(10, 15):
        print(live.update(0.02 * k, 0.1 * k).xhat.tobytes().hex())
"""


def test_it_goes_on_in_another_process(tmp_path):
    """Random numbers of ensembles and particles included."""
    names, lines = ("ekf", "enkf", "particle", "mhe"), []
    for name in names:
        live = Live(online(name)[0])
        for k in range(15):
            if k == 10:
                live.save(tmp_path / name)
            estimate = live.update(0.02 * k, 0.1 * k)
            lines += [estimate.xhat.tobytes().hex()] * (k >= 10)
    command = [sys.executable, "-c", IN_ANOTHER_PROCESS, str(tmp_path), *names]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=True)
    assert done.stdout.split() == lines


@dataclass(frozen=True)
class Duffing(ReverseDuffing):
    """Another plant of the same sizes."""


@dataclass(frozen=True)
class Stiffer(Linear):
    """The same name may stand for other equations, see below."""

    factor: float = 2.0

    def f(self, t, x, u):
        return super().f(t, x, u) * self.factor


def edited():
    """A class of the same name and parameters as `Stiffer`, as if its source had been edited."""

    @dataclass(frozen=True)
    class Stiffer(Linear):
        factor: float = 2.0

        def f(self, t, x, u):
            return super().f(t, x, u) * self.factor * (1 + 1e-6)

    return Stiffer()


STD = SampledLevel(np.arange(3.0), np.full((1, 3, 1), 0.1))
OTHERS = [
    (UKF(ReverseDuffing()), "estimator='EKF'; the estimator given has 'UKF'"),
    (RobustEKF(ReverseDuffing()), "estimator='EKF'; the estimator given has 'RobustEKF'"),
    (
        EKF(ReverseDuffing(), assumed_noise=0.1),
        "settings.assumed_noise=0.003; the estimator given has 0.1",
    ),
    (EKF(ReverseDuffing(), gate=0.99), "settings.gate=None; the estimator given has 0.99"),
    (EKF(ReverseDuffing(), 0.1), "noise.output R=[[[0.0004]]]; the estimator given has [[["),
    (EKF(ReverseDuffing(), 0.02, 0.5), "noise.process L="),
    (EKF(ReverseDuffing(), STD), "noise.output R="),
    (EKF(Duffing()), "model='ReverseDuffing'; the estimator given has 'Duffing'"),
    (EKF(HarmonicOscillator()), "model='ReverseDuffing'; the estimator given has 'HarmonicOsc"),
]


@pytest.mark.parametrize(("other", "line"), OTHERS, ids=range(len(OTHERS)))
def test_a_file_of_another_estimator_or_model_is_refused(other, line, tmp_path):
    Live(EKF(ReverseDuffing())).save(tmp_path / "x")
    with pytest.raises(ValueError, match=r"was saved with ") as caught:
        Live.load(tmp_path / "x", other)
    assert str(caught.value).startswith(f"{tmp_path / 'x'} was saved with {line}")
    assert "\n" not in str(caught.value)


def test_a_file_of_other_parameters_inputs_or_equations_is_refused(tmp_path):
    path = tmp_path / "x"
    Live(EKF(Stiffer())).save(path)
    Live.load(path, EKF(Stiffer()))
    with pytest.raises(
        ValueError, match=r"with parameters.factor=2.0; the estimator given has 3.0$"
    ):
        Live.load(path, EKF(Stiffer(3.0)))
    with pytest.raises(ValueError, match=r"with other values of equations.f; the model of the est"):
        Live.load(path, EKF(edited()))
    estimator = on_plant("ekf", PLANTS[1])[0]
    Live(estimator).save(path)
    other = replace(estimator, system=replace(estimator.system, measured_input=False))
    with pytest.raises(ValueError, match=r"traits.measured_input=True; the estimator given has Fa"):
        Live.load(path, other)


def test_a_file_of_other_weights_is_refused(tmp_path):
    estimator = made("kkl_supervised")
    Live(estimator).save(tmp_path / "x")
    decoder = tuple((W * 1.001, b) for W, b in estimator.trained.decoder)
    other = replace(estimator, trained=replace(estimator.trained, decoder=decoder))
    with pytest.raises(ValueError, match=r"was saved with settings.trained.decoder="):
        Live.load(tmp_path / "x", other)


def test_rounding_of_equations_is_no_other_model(tmp_path, monkeypatch):
    """As another version of NumPy may round."""
    Live(EKF(Linear())).save(tmp_path / "x")
    own = Linear.f
    monkeypatch.setattr(Linear, "f", lambda self, t, x, u: own(self, t, x, u) * (1 + 1e-15))
    Live.load(tmp_path / "x", EKF(Linear()))


@dataclass(frozen=True)
class Uneven(Linear):
    """The first state in a unit that is a billionth of the usual one."""

    def f(self, t, x, u):
        return stack(x, 1e9 * x[..., 1], -2e-9 * x[..., 0] - 0.3 * x[..., 1])


def test_another_equation_of_small_values_is_another_model(tmp_path, monkeypatch):
    Live(EKF(Uneven())).save(tmp_path / "x")
    own = Uneven.f
    factor = np.array([1.0, 1.01])
    monkeypatch.setattr(Uneven, "f", lambda self, t, x, u: own(self, t, x, u) * factor)
    with pytest.raises(ValueError, match=r"was saved with other values of equations.f"):
        Live.load(tmp_path / "x", EKF(Uneven()))


def _edited(path, change):
    """The file with a change of its header."""
    with np.load(path) as file:
        arrays = dict(file)
    header = json.loads(arrays["header"].tobytes())
    change(header)
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    with path.open("wb") as file:
        np.savez(file, **arrays)


def _base(header):
    """The fields of the state in a header."""
    (base,) = (value for key, value in header["content"]["dict"] if key == "base")
    return base


CHANGES = {
    "another version": lambda h: h.update(version=VERSION + 1),
    "another format": lambda h: h.update(format="something else"),
    "no identity": lambda h: h.pop("identity"),
    "no content": lambda h: h.pop("content"),
    "no state": lambda h: h["content"].update(dict=[]),
    "content that is none": lambda h: h.update(content=[1, 2]),
    "an array that is not there": lambda h: _base(h)["fields"]["P"].update(array=99),
    "another array": lambda h: _base(h)["fields"].update(P=_base(h)["fields"]["xhat"]),
    "a missing field": lambda h: _base(h)["fields"].pop("P"),
    "a class of another module": lambda h: _base(h).update({"class": "Popen"}),
    "a class by its path": lambda h: _base(h).update({"class": "subprocess.Popen"}),
    "another class": lambda h: _base(h)["fields"].update(memory=dict(_base(h), fields={})),
    "no number": lambda h: _base(h)["fields"].update(t="soon"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_changed_file_is_refused_in_one_line(change, tmp_path):
    path, estimator = tmp_path / "x", EKF(ReverseDuffing(), gate=0.99)
    live = Live(estimator)
    for k in range(3):
        live.update(0.1 * k, 0.1)
    live.save(path)
    _edited(path, CHANGES[change])
    with pytest.raises(ValueError, match=r"is damaged|is of version 3 of the format") as caught:
        Live.load(path, estimator)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_what_is_no_file_is_refused_in_one_line(tmp_path):
    path, estimator = tmp_path / "x", EKF(ReverseDuffing())
    with pytest.raises(ValueError, match=r"^cannot read .*x: No such file or directory$"):
        Live.load(path, estimator)
    with pytest.raises(ValueError, match=r"^cannot read .*: Is a directory$"):
        Live.load(tmp_path, estimator)
    Live(estimator).save(path)
    whole = path.read_bytes()
    pickled = b"cos\nsystem\n(S'touch ran'\ntR."
    for content in (b"", b"t,y1\n0,1\n", pickled, whole[:-1], whole[:300]):
        path.write_bytes(content)
        with pytest.raises(
            ValueError, match=r"^.*x is damaged or no file of a live filter"
        ) as caught:
            Live.load(path, estimator)
        assert "\n" not in str(caught.value)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("other.txt", "text")
    with pytest.raises(ValueError, match=r"^.*x is damaged or no file of a live filter"):
        Live.load(path, estimator)


def test_a_file_with_a_wrong_byte_is_refused_or_nothing_is_lost(tmp_path):
    """A zip file has bytes that nobody reads."""
    path, estimator = tmp_path / "x", EKF(ReverseDuffing())
    live = Live(estimator)
    live.update(0.0, 0.1)
    live.save(path)
    whole, after, refused = path.read_bytes(), live.update(0.1, 0.3), []
    for place in range(0, len(whole), 11):
        broken = bytearray(whole)
        broken[place] ^= 0x55
        path.write_bytes(bytes(broken))
        try:
            estimate = Live.load(path, estimator).update(0.1, 0.3)
        except ValueError as error:
            refused.append(str(error))
        else:
            np.testing.assert_array_equal(estimate.xhat, after.xhat)
            np.testing.assert_array_equal(estimate.std, after.std)
    assert len(refused) > 0.5 * len(whole) / 11
    assert all(str(path) in line and "\n" not in line for line in refused)


def test_objects_in_arrays_are_not_read(tmp_path):
    path, estimator = tmp_path / "x", EKF(ReverseDuffing())
    Live(estimator).save(path)
    with np.load(path) as file:
        arrays = dict(file)
    arrays["array0"] = np.array([{"a": 1}], dtype=object)
    with path.open("wb") as file:
        np.savez(file, **arrays)
    with pytest.raises(
        ValueError, match=r"is damaged or no file of a live filter \(an array of object; expected"
    ):
        Live.load(path, estimator)


@dataclass(frozen=True)
class Clock(Estimator):
    """It remembers what no file can hold."""

    def reset(self, prior):
        return State(prior.mean, memory={"of": object()})

    def update(self, state, t, y, u):
        return replace(state, t=t, u=u)


def test_a_file_that_cannot_be_written_stays_as_it_was(tmp_path):
    path = tmp_path / "x"
    path.write_text("before")
    with pytest.raises(
        ValueError, match=r"^Clock remembers a object, which cannot be saved; expect"
    ):
        Live(Clock(ReverseDuffing())).save(path)
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(ValueError, match=r"^cannot write .*x/y: "):
        Live(EKF(ReverseDuffing())).save(path / "y")


@dataclass(frozen=True)
class Kept:
    """What `Many` remembers."""

    values: tuple
    scalar: np.float64
    names: dict


@dataclass(frozen=True)
class Many(Estimator):
    """It remembers of everything something."""

    def reset(self, prior):
        order = np.asfortranarray(np.arange(6.0).reshape(2, 3))
        memory = Kept((order, order, [True, None, 2]), np.float64(0.1), {"a": np.array("x") == "x"})
        return State(prior.mean, memory=memory)

    def update(self, state, t, y, u):
        return replace(state, t=t, u=u)


def test_what_an_estimator_of_ones_own_remembers_is_kept(tmp_path):
    live = Live(Many(ReverseDuffing()))
    live.update(0.5, 0.1)
    live.save(tmp_path / "x")
    memory = Live.load(tmp_path / "x", Many(ReverseDuffing()))._ring.latest.memory
    first, second, rest = memory.values
    assert first is second
    assert first.flags.f_contiguous
    np.testing.assert_array_equal(first, np.arange(6.0).reshape(2, 3))
    assert rest == [True, None, 2]
    assert type(memory.scalar) is np.float64
    assert memory.scalar == 0.1
    assert memory.names == {"a": True}
