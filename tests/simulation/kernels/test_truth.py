"""The truth in compiled code."""

import copy
import pickle
from dataclasses import dataclass, replace

import numpy as np
import pytest
from compiled_plants import Held, Kepler, Pushed, by_numpy, compiled
from fake_compilers import needs_compiler
from scipy.integrate import solve_ivp

from pinnobs_gym.envs.vector_env import EstimationVectorEnv
from pinnobs_gym.simulation.kernels import asked, truth_kernel
from pinnobs_gym.simulation.mesh import mesh_of
from pinnobs_gym.simulation.system import Setup, System, initial_states, stack
from pinnobs_gym.simulation.truth import disturbed_truth, noise_shape, truth
from pinnobs_gym.systems import SYSTEMS

pytestmark = needs_compiler
SIX = (
    *("ReverseDuffing", "HarmonicOscillator", "Academic", "ModifiedAcademic", "Satellite"),
    "InductionMotor",
)


@pytest.fixture
def calls(monkeypatch):
    """The number of rows of each call of compiled code."""
    batches, solve = [], truth_kernel.TruthKernel.fixed_step

    def counted(self, system, x0, mesh, out):
        batches.append(len(x0))
        return solve(self, system, x0, mesh, out)

    monkeypatch.setattr(truth_kernel.TruthKernel, "fixed_step", counted)
    return batches


def plant_and_setup(name):
    system, setup = SYSTEMS.resolve(name).configured()
    # A tenth of an episode of the motor, whose steps are many
    return system, setup if name != "InductionMotor" else replace(setup, duration=0.1)


def same(a, b, scale, allowed=1e-12):
    """Whether trajectories agree relative to the states' scale and size."""
    size = np.maximum(abs(a).max(axis=(0, 1)), scale)
    return (abs(a - b).max(axis=(0, 1)) / size).max() < allowed


@pytest.mark.parametrize("name", SIX)
def test_the_six_plants_move_as_in_numpy(name, calls):
    system, setup = plant_and_setup(name)
    x0 = initial_states(system, setup, 11)

    def solve():
        return truth(system, x0, setup.times, setup.truth_step)

    reference = by_numpy(solve)
    assert not calls
    found = compiled("truth", system, solve)
    assert calls[0] == 11
    assert same(reference, found, system.scale)


@pytest.mark.parametrize("name", ["ReverseDuffing", "Academic"])
def test_a_row_is_the_same_in_any_batch(name):
    system, setup = plant_and_setup(name)
    x0 = initial_states(system, setup, 19)

    def alone(rows):
        return truth(system, x0[rows], setup.times, setup.truth_step)

    def all_of_them():
        whole = alone(slice(None))
        for rows in (slice(3, 4), slice(5, 7), slice(1, 4), slice(2, 10), slice(7, 16)):
            assert (alone(rows) == whole[:, rows]).all()

    compiled("truth", system, all_of_them)


def test_breakpoints_and_parameters_of_rows():
    rows = Pushed(damping=np.linspace(0.1, 0.9, 11), load=np.linspace(-1.0, 2.0, 11))
    t, x0 = np.linspace(0.0, 2.0, 41), np.random.default_rng(0).normal(size=(11, 2))

    def each():
        whole = truth(rows, x0, t)
        for i in (0, 4, 10):
            one = Pushed(damping=float(rows.damping[i]), load=float(rows.load[i]))
            assert same(whole[:, i : i + 1], truth(one, x0[i : i + 1], t), (1.0, 1.0))
        return whole

    found = compiled("truth", rows, each)
    assert same(by_numpy(each), found, (1.0, 1.0))


@pytest.mark.parametrize("cls", [Pushed, Held])
def test_inputs_at_the_samples(cls):
    system, rng = cls(), np.random.default_rng(0)
    t, x0, u = np.linspace(0.0, 2.0, 21), rng.normal(size=(5, 2)), rng.normal(size=(21, 5, 1))

    def solve():
        return truth(system, x0, t, inputs=u)

    reference = by_numpy(solve)
    found = compiled("truth", system, solve)
    assert same(reference, found, system.scale)

    def rate(now, x):
        k = min(int(now / 0.1), 19)
        part = (now - t[k]) / 0.1 if cls is Pushed else 0.0
        at = (1 - part) * u[k, 2] + part * u[k + 1, 2]
        return system.f(np.asarray(now), x[None], at[None])[0]

    x = x0[2]
    for k in range(20):  # another solver, with f smooth in each interval
        for ends in ((t[k], 0.73), (0.73, t[k + 1])) if t[k] < 0.73 < t[k + 1] else (t[k : k + 2],):
            inside = (max(ends[0], t[k]), np.nextafter(ends[1], 0))
            x = solve_ivp(rate, inside, x, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    assert abs(found[-1, 2] - x).max() < 1e-9


@pytest.mark.parametrize("given", [False, True])
def test_process_noise(given):
    system = Pushed()
    noise = system.noise(None, ((0.0, 0.1), (0.3, 0.2)))
    t = np.linspace(0.0, 2.0, 21)
    rng = np.random.default_rng(0)
    shape = (20, *noise_shape(system, noise, 0.1, 0.03))
    draws, x0 = rng.normal(size=(*shape[:3], 9, 2)), rng.normal(size=(9, 2))
    u = rng.normal(size=(21, 9, 1)) if given else None

    def solve(rows=slice(None)):
        own = None if u is None else u[:, rows]
        return disturbed_truth(system, noise, x0[rows], t, draws[..., rows, :], 0.02, inputs=own)

    def both():
        whole = solve()
        assert (solve(slice(4, 5)) == whole[:, 4:5]).all()
        return whole

    reference = by_numpy(both)
    assert same(reference, compiled("truth", system, both), system.scale)
    assert abs(reference - truth(system, x0, t, inputs=u)).max() > 0.1


@pytest.mark.parametrize("method", ["truth", "numpy"])
def test_invariants_of_an_orbit(method):
    system, setup = Kepler.configured()
    x0 = initial_states(system, setup, 9)

    def solve():
        return truth(system, x0, setup.times)

    x = compiled("truth", system, solve) if method == "truth" else by_numpy(solve)
    drift = abs(system.invariants(x) - system.invariants(x[:1]))
    assert drift.max() < 1e-9


def test_the_order_is_eight():
    """Through compiled steps themselves: half the step has 1/256 of the error."""
    system = Kepler()
    x0 = np.array([[1.0, 0.0, 0.0, 1.0]])

    def ends():
        kernel = truth_kernel.TruthKernel(asked.ask(system, "truth"))
        out = np.empty((1, 1, 4))
        errors = []
        for steps in (10, 20, 40):
            mesh = mesh_of(0.0, 2 * np.pi, steps, np.array([2 * np.pi]).tobytes())
            end, _ = kernel.fixed_step(system, x0, mesh, out)
            errors.append(abs(end - x0).max())  # the orbit closes after a turn
            assert abs(out[0] - end).max() < 1e-14
        return errors

    errors = compiled("truth", system, ends)
    slopes = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (slopes > 7).all()
    assert slopes.mean() == pytest.approx(8, abs=0.9)


@dataclass(frozen=True)
class Bend(System):
    """Its slope jumps wherever a state passes zero, for which no fixed step is short enough."""

    state_names = ("a", "b")
    output_names = ("y",)
    scale = (1.0, 1.0)
    setups = {"benchmark": Setup((0.5, 0.5), (1, 1), duration=3, dt=0.1, noise_std=0.01)}

    def f(self, t, x, u):
        side = 1.0 * (x[..., 0] > 0)
        return stack(x, x[..., 1], -x[..., 0] * (1 + 3 * side))

    def h(self, t, x, u):
        return x[..., :1]


def test_the_tolerance_and_the_adaptive_solver_stay(calls):
    system, t = Bend(), np.linspace(0.0, 1.0, 11)
    x0 = np.array([[1.0, 0.0], [-1.0, 0.5]])
    found = compiled("truth", system, lambda: truth(system, x0, t))
    # The row that crosses zero has all halvings, the other one none.
    assert calls == [2] + [1] * 6
    # A quarter of a wave of frequency 2 to zero, and then one of frequency 1
    late = np.where(t < np.pi / 4, np.cos(2 * t), -2 * np.sin(t - np.pi / 4))
    assert abs(found[:, 0, 0] - late).max() < 1e-8
    assert abs(found[:, 1, 0] - 0.5 * np.sin(t) + np.cos(t)).max() < 1e-10


def test_the_error_of_a_row_that_is_not_finite_is_nan():
    system = Kepler()
    x0 = np.array([[1.0, 0.0, 0.0, 1.0]] * 3)
    x0[1] = np.nan

    def error():
        kernel = truth_kernel.TruthKernel(asked.ask(system, "truth"))
        return kernel.fixed_step(system, x0, mesh_of(0.0, 1.0, 20, b""), np.empty((0, 3, 4)))[1]

    found = compiled("truth", system, error)
    assert np.isnan(found).tolist() == [False, True, False]
    assert found[0] == found[2] < 1e-10


def test_only_plants_that_were_asked_for(calls, monkeypatch):
    monkeypatch.setattr(asked, "_asked", set())
    system, setup = plant_and_setup("ReverseDuffing")
    x0 = initial_states(system, setup, 2)
    truth(system, x0, setup.times)
    assert not calls
    EstimationVectorEnv(2, "ReverseDuffing").reset(seed=0)  # environments ask
    assert calls
    calls.clear()
    truth(replace(system), x0, setup.times)
    assert calls
    calls.clear()
    monkeypatch.setenv("PINNOBS_KERNELS", "0")
    truth(system, x0, setup.times)
    assert not calls


def test_plants_are_copied_and_pickled_without_their_library():
    system, setup = plant_and_setup("ReverseDuffing")
    x0 = initial_states(system, setup, 2)

    def solve():
        first = truth(system, x0, setup.times)
        for other in (copy.deepcopy(system), pickle.loads(pickle.dumps(system))):
            assert (truth(other, x0, setup.times) == first).all()

    compiled("truth", system, solve)


def test_an_array_of_one_number_holds_for_all_rows():
    one, x0 = Pushed(damping=np.array([0.4])), np.random.default_rng(0).normal(size=(5, 2))

    def solve(system):
        return lambda: truth(system, x0, np.linspace(0.0, 2.0, 21))

    found = compiled("truth", one, solve(one))
    np.testing.assert_array_equal(found, compiled("truth", one, solve(Pushed(damping=0.4))))
    assert same(by_numpy(solve(one)), found, one.scale)


def test_noise_of_another_number_of_rows_is_refused():
    system, t = Pushed(damping=np.linspace(0.1, 0.5, 5)), np.linspace(0.0, 1.0, 6)
    noise, rng = system.noise(None, 0.1), np.random.default_rng(0)
    shape = (5, *noise_shape(system, noise, 0.2, 0.05)[:2])

    def solve(rows, drawn):
        x0, draws = np.zeros((rows, 2)), rng.normal(size=(*shape, drawn, 2))
        return lambda: disturbed_truth(system, noise, x0, t, draws, 0.05)

    for rows, drawn in ((3, 3), (5, 3)):
        for way in (by_numpy, lambda call: compiled("truth", system, call)):
            with pytest.raises(ValueError, match="broadcast"):
                way(solve(rows, drawn))
