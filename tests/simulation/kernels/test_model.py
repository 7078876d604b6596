"""Steps of the model in compiled code."""

import copy
import pickle
import threading
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import torch
from compiled_plants import JUMP, Held, Kepler, Predator, Pushed, by_numpy, compiled
from fake_compilers import needs_compiler

from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.simulation.kernels import asked, model_kernel
from pinnobs_gym.simulation.model import (
    model_step,
    model_step_jacobian,
    model_step_moments,
    noisy_model_step,
)
from pinnobs_gym.simulation.noise import AssumedNoise, Noise
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import initial_states
from pinnobs_gym.systems import SYSTEMS

pytestmark = needs_compiler
SIX = (
    *("ReverseDuffing", "HarmonicOscillator", "Academic", "ModifiedAcademic", "Satellite"),
    "InductionMotor",
)


@pytest.fixture
def used(monkeypatch):
    """The number of calls that compiled code has done."""
    count, call = [0], model_kernel.ModelKernel._call

    def counted(self, *values):
        result = call(self, *values)
        count[0] += result[0] is not None
        return result

    monkeypatch.setattr(model_kernel.ModelKernel, "_call", counted)
    return count


def drawn(batch, seed=1):
    """Standard normal numbers, the same at each call with the same seed."""
    rng = np.random.default_rng(seed)
    return lambda m: rng.normal(size=(3, batch, m))


def everything(system, batch, whole):
    """All functions of the model over a time, at states (batch, nx) and three points of each."""
    rng = np.random.default_rng(0)
    x = initial_states(system, system.setups["benchmark"], batch)
    u0, u1 = rng.normal(size=(2, batch, system.nu))
    points = np.stack([x, 1.1 * x, x + 0.05])
    noise = AssumedNoise.of(system, system.noise(None, None), 0.05)
    own = np.arange(batch) * (1.0 if system.discrete else 0.1)
    results = []
    for t0, t1 in ((0.0, whole), (own, own + whole), (own, own + np.ceil(whole * (own + 1) / 4))):
        ends = t0, t1, x, u0, u1
        results += [model_step(system, *ends), *model_step_jacobian(system, *ends)]
        results += model_step_moments(system, noise, *ends)
        results += model_step_moments(system, noise, t0, t1, points, u0, u1)
        results.append(model_step(system, t0, t1, points, u0, u1))
    results.append(model_step(system, 0.0, whole, x[0], u0[0], u1[0]))
    for size in (1, batch):
        ends = 0.0, whole, points, u0, u1
        results.append(noisy_model_step(system, noise, *ends, drawn(size)))
    return results


def agree(system, call):
    """Compare the results of a call in compiled code with those of NumPy."""
    for a, b in zip(by_numpy(call), compiled("model", system, call), strict=True):
        assert a.shape == b.shape
        assert abs(a - b).max() <= 1e-12 * max(1.0, abs(a).max())


@pytest.mark.parametrize("name", SIX)
def test_the_six_plants(name, used):
    system, setup = SYSTEMS.resolve(name).configured()
    agree(system, lambda: everything(system, 10, 2 * setup.dt))
    assert used[0] == 18


@pytest.mark.parametrize("cls", [Pushed, Held, Predator])
@pytest.mark.parametrize("measured", [False, True])
def test_breakpoints_inputs_and_maps(cls, measured, used):
    system = cls(measured_input=measured)
    agree(system, lambda: everything(system, 11, 2.0 if system.discrete else 1.0))
    assert used[0] == 18


def test_times_about_a_breakpoint():
    system = Pushed(measured_input=True)
    rng = np.random.default_rng(0)
    x, u0, u1 = rng.normal(size=(6, 2)), *rng.normal(size=(2, 6, 1))
    before, after = np.nextafter(JUMP, 0), np.nextafter(JUMP, 1)

    def steps():
        ends = [(0.5, JUMP), (JUMP, 1.0), (before, after), (0.0, 0.5), (JUMP, JUMP)]
        own = np.array([0.1, 0.5, before, JUMP, after, 1.0])
        ends += [(own, own + 0.2), (own - 0.1, own), (own, own)]
        return [model_step(system, *e, x, u0, u1) for e in ends]

    agree(system, steps)


def test_parameters_of_rows(used):
    system = Pushed(damping=np.linspace(0.1, 0.9, 10), load=np.linspace(-1.0, 2.0, 10))
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 10, 2))

    def steps():
        whole = model_step(system, 0.0, 1.0, x)
        one = Pushed(damping=float(system.damping[7]), load=float(system.load[7]))
        assert abs(model_step(one, 0.0, 1.0, x[7:8]) - whole[7]).max() < 1e-13
        return [whole, *model_step_jacobian(system, 0.3, 1.0, y)]

    agree(system, steps)
    assert used[0] == 3


@pytest.mark.parametrize("name", ["Satellite", "InductionMotor"])
def test_a_row_is_the_same_in_any_batch(name):
    system, setup = SYSTEMS.resolve(name).configured()
    x = initial_states(system, setup, 19)
    noise = AssumedNoise.of(system, system.noise(None, None), 0.05)

    def rows():
        whole = [model_step(system, 0.0, setup.dt, x)]
        whole += model_step_moments(system, noise, 0.0, setup.dt, x)
        for part in (slice(2, 3), slice(3, 5), slice(4, 7), slice(1, 9), slice(0, 18)):
            own = [model_step(system, 0.0, setup.dt, x[part])]
            own += model_step_moments(system, noise, 0.0, setup.dt, x[part])
            for a, b in zip(whole, own, strict=True):
                assert ((a[part] if a.shape[-1] != 19 else a[..., part]) == b).all()
        points = np.stack([x, x + 0.01, x])
        assert (model_step(system, 0.0, setup.dt, points)[2] == whole[0]).all()

    compiled("model", system, rows)


def test_any_layout_of_the_arrays():
    system = Pushed(measured_input=True)
    rng = np.random.default_rng(0)
    x, u0, u1 = rng.normal(size=(4, 9, 2)), *rng.normal(size=(2, 9, 1))

    def layouts():
        base = model_step(system, 0.0, 0.5, x, u0, u1)
        for axes in ((0, 1, 2), (2, 0, 1), (1, 2, 0), (2, 1, 0)):
            other = np.ascontiguousarray(x.transpose(axes)).transpose(np.argsort(axes))
            assert (model_step(system, 0.0, 0.5, other, u0, u1) == base).all()
        spaced = np.zeros((9, 4, 5))[:, :, ::2][..., :2].swapaxes(0, 1)
        spaced[:] = x
        held = np.broadcast_to(u0[:, None], (9, 3, 1))[:, 1]
        assert (model_step(system, 0.0, 0.5, spaced, held, u1[::-1][::-1]) == base).all()
        locked = x.copy()
        locked.flags.writeable = False
        assert (model_step(system, 0.0, 0.5, locked, u0, u1) == base).all()
        one = model_step(system, 0.0, 0.5, x, u0[0], u1[0])
        assert (one == model_step(system, 0.0, 0.5, x, u0[:1], u1[:1])).all()

    compiled("model", system, layouts)


def test_what_is_left_to_numpy(used):
    system = Pushed()
    x = np.array([[0.1, 0.2], [0.3, -0.4]])

    @dataclass(frozen=True, eq=False)
    class Growing(Noise):
        def L(self, t):
            return (1 + np.asarray(t).reshape(-1)) * np.eye(2)[..., None]

    growing = Growing(np.eye(2), np.eye(1))

    def calls():
        after = model_step(system, 0.0, 0.1, torch.tensor(x))
        assert isinstance(after, torch.Tensor)
        single = model_step(system, 0.0, 0.1, x.astype(np.float32))
        backward = model_step(system, 0.1, 0.0, x)
        return [
            np.asarray(after),
            single,
            backward,
            model_step_moments(system, growing, 0.0, 0.1, x)[2],
        ]

    agree(system, calls)
    assert used[0] == 0


def test_errors_stay():
    with pytest.raises(ValueError, match="u is missing"):
        compiled(
            "model",
            Pushed(),
            lambda: model_step(Pushed(measured_input=True), 0, 1, np.zeros((1, 2))),
        )
    with pytest.raises(ValueError, match=r"t=0\.5 of Predator.* whole number"):
        compiled("model", Predator(), lambda: model_step(Predator(), 0.0, 0.5, np.zeros((1, 2))))


def test_the_order_is_four_and_invariants_hold():
    system, x = Kepler(), np.array([[1.0, 0.0, 0.0, 1.0]])

    def errors():
        found = []
        for steps in (100, 200, 400):
            state, t = x, np.linspace(0.0, 2 * np.pi, steps + 1)
            one = _with_step(2 * np.pi / steps)
            for t0, t1 in pairwise(t):
                state = model_step(one, t0, t1, state)
            found.append(abs(state - x).max())
            drift = abs(system.invariants(state) - system.invariants(x)).max()
            assert drift < 100 * (2 * np.pi / steps) ** 5
        return found

    found = compiled("model", _with_step(1.0), errors)
    slopes = np.log2(np.divide(found[:-1], found[1:]))
    assert slopes == pytest.approx(4, abs=0.3)


@dataclass(frozen=True)
class StepKepler(Kepler):
    """An orbit; its step is that of the caller."""

    model_step = 10.0


def _with_step(step):
    StepKepler.model_step = step
    return StepKepler()


def test_jacobian_and_covariance_by_differences_and_closed_form():
    system = Pushed(measured_input=True)
    x, u = np.array([[0.4, 0.1]]), np.array([[0.3]])
    noise = Noise(np.array([[0.0], [0.2]]), np.eye(1))

    def parts():
        step = partial(model_step, system, 0.0, 1.0, u0=u, u1=u)
        F = model_step_moments(system, noise, 0.0, 1.0, x, u, u)[1][..., 0]
        columns = [(step(x=x + d) - step(x=x - d))[0] / 2e-6 for d in 1e-6 * np.eye(2)]
        assert abs(F - np.transpose(columns)).max() < 1e-8
        # The spread of many points over a short time, with the noise of the same law
        Q = model_step_moments(system, noise, 0.0, 0.1, x, u, u)[2][..., 0]
        rng = np.random.default_rng(0)
        points = np.tile(x, (40_000, 1, 1))
        end = noisy_model_step(
            system, noise, 0.0, 0.1, points, u, u, lambda m: rng.normal(size=(40_000, 1, m))
        )
        assert np.cov(end[:, 0].T) == pytest.approx(Q, rel=0.03)

    compiled("model", system, parts)


def test_estimators_ask_and_scripts_do_not(used, monkeypatch):
    monkeypatch.setattr(asked, "_asked", set())
    system = Pushed()
    x = np.zeros((1, 2))
    model_step(system, 0.0, 0.1, x)
    assert not used[0]
    setup = system.setups["benchmark"]
    t = setup.times[:4]
    record = Record(t, np.zeros((1, 4, 1)), system.input(t)[None], Prior.of(system, setup, 1))
    estimator = ESTIMATORS.resolve("open_loop").for_setup(system, setup)
    vars(estimator)["compiled"] = None  # whose own code would contain the model's steps
    estimator.run(record)
    assert used[0] == 3
    model_step(replace(system), 0.0, 0.1, x)
    assert used[0] == 4
    monkeypatch.setenv("PINNOBS_KERNELS", "0")
    model_step(system, 0.0, 0.1, x)
    assert used[0] == 4


def test_plants_are_copied_and_pickled_without_their_kernel(used):
    system, x = Pushed(), np.array([[0.1, 0.2]])

    def steps():
        first = model_step(system, 0.0, 0.1, x)
        for other in (copy.deepcopy(system), copy.copy(system), pickle.loads(pickle.dumps(system))):
            assert (model_step(other, 0.0, 0.1, x) == first).all()

    compiled("model", system, steps)
    assert used[0] == 4


class Often(Pushed):
    """Its breakpoints are more than a small stack holds."""

    def breakpoints(self):
        return tuple(np.linspace(0.0, 1.0, 200_000))


def test_any_number_of_breakpoints():
    x, results = np.random.default_rng(0).normal(size=(5, 2)), []

    def step():
        return [model_step(Often(), 0.0, 3e-5, x)]

    def in_thread():
        before = threading.stack_size(1 << 20)
        thread = threading.Thread(target=lambda: results.extend(step()))
        thread.start()
        thread.join()
        threading.stack_size(before)
        return results

    (found,), (expected,) = compiled("model", Often(), in_thread), by_numpy(step)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_an_array_of_one_number_holds_for_all_rows(used):
    one, x = Pushed(damping=np.array([0.4])), np.random.default_rng(0).normal(size=(9, 2))
    agree(one, lambda: [model_step(one, 0.0, 1.0, x), *model_step_jacobian(one, 0.0, 1.0, x)])
    assert used[0] == 2


def test_inputs_and_states_of_other_shapes_and_layouts():
    rng = np.random.default_rng(0)
    joined = type("Joined", (Pushed,), {"input_hold": "linear"})(measured_input=True)
    points, u = rng.normal(size=(4, 5, 2)), rng.normal(size=(4, 5, 1))
    ends = [(u[0], u[1, 0]), (u, u[0]), (u[:, :1], u), (u[0], u[:1])]
    agree(joined, lambda: [model_step(joined, 0.0, 0.5, points, *each) for each in ends])
    packed = np.zeros((5, 2), dtype=[("number", "i4"), ("x", "f8")])
    packed["x"] = points[0]
    packed = packed["x"]  # twelve bytes from one number to the next
    given = np.zeros((5, 1), dtype=[("number", "i4"), ("u", "f8")])
    given["u"] = u[0]
    agree(joined, lambda: [model_step(joined, 0.0, 0.5, packed, u[0], u[1])])
    agree(joined, lambda: [model_step(joined, 0.0, 0.5, points[0], given["u"], given["u"])])
