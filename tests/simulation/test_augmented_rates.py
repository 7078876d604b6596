"""Unknown relative deviations of rates as states: against derivatives by differences, the plants of
the mismatch conditions, and estimates in NumPy."""

from dataclasses import dataclass, replace

import many_plants
import numpy as np
import pytest
import sympy
import torch
from agreement import assert_near
from array_api_compat import array_namespace
from fake_compilers import needs_compiler
from linear import Linear, record_of

from pinnobs_gym import Unknown, augmented, stack
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.checks import check_system
from pinnobs_gym.simulation.conditions.plant import OtherRates
from pinnobs_gym.simulation.derivatives import central_differences
from pinnobs_gym.simulation.symbolic import trace
from pinnobs_gym.simulation.system import initial_states, matrix
from pinnobs_gym.simulation.truth import truth
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing
from pinnobs_gym.systems.satellite import Satellite

TENTH = Unknown(0.0, 0.1)


@dataclass(frozen=True)
class Henon(many_plants.Henon):
    """The map with its Jacobian by hand."""

    def f_jacobian(self, t, x, u):
        return matrix(x, [[-2 * self.a * x[..., 0], 1.0], [0.3, 0.0]])


RATES = {
    "flow": augmented(
        Satellite(),
        {"a1": Unknown(0.5, 0.05)},
        disturbance={"x2": Unknown(0.0, 0.05)},
        rates={"x3": TENTH, "x2": TENTH},
    ),
    "map": augmented(
        Henon(),
        {"a": Unknown(1.2, 0.02)},
        {"y": Unknown(0.0, 0.1)},
        {"x1": Unknown(0.0, 0.01)},
        {"x1": Unknown(0.0, 0.02)},
    ),
    "all of a map": augmented(Henon(), rates={"x1": Unknown(0.0, 0.02), "x2": Unknown(0.05, 0.02)}),
    "duffing": augmented(ReverseDuffing(), rates={"x1": TENTH, "x2": TENTH}),
}
"""Plants with Jacobians by hand."""
RATES["twice"] = augmented(RATES["duffing"], None, {"y1": TENTH}, {"x1": TENTH})


@pytest.mark.parametrize("name", RATES)
def test_a_system_with_unknown_rates_passes_the_checks(name):
    check_system(type(RATES[name]))


@pytest.mark.parametrize(
    ("name", "kind"), [*((name, np.asarray) for name in RATES), ("map", torch.tensor)]
)
def test_jacobians_are_those_by_differences(name, kind):
    system = RATES[name]
    x = np.random.default_rng(0).standard_normal((4, 5, system.nx))
    t, u = np.zeros((4, 1)), np.ones((4, 1, system.nu))
    found = np.asarray(system.f_jacobian(*map(kind, (t, x, u))))
    expected = central_differences(lambda x: system.f(t, x, u), x, np.ones(system.nx))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)


def test_a_rate_is_multiplied_and_then_disturbed():
    """Written out: order of the states, of the factor and of the disturbance."""
    system = RATES["flow"]
    assert type(system).__name__ == "Satellite_a1_disturbance_x2_rate_x3_rate_x2"
    assert system.state_names[3:] == ("a1", "disturbance_x2", "rate_x3", "rate_x2")
    assert system.scale[3:] == (0.05, 0.05, 0.1, 0.1)
    assert not {"rate_x2", "rate_x3"} & set(system.units)
    x, u = np.array([1.0, 2.0, 3.0, 0.4, 0.7, -0.2, 0.1]), np.zeros(0)
    f1, f2, f3 = Satellite(a1=0.4).f(0.0, x[:3], u)
    expected = [f1, 1.1 * f2 + 0.7, 0.8 * f3, 0, 0, 0, 0]
    np.testing.assert_allclose(system.f(0.0, x, u), expected, rtol=1e-14)
    x, u = np.array([0.3, 0.1, 1.1, 5.0, 0.7, -0.2]), np.array([2.0])
    first, second = 1 - 1.1 * 0.3**2 + 0.1 + 0.2, 0.09  # x' = 1 - ax1² + x2 + u/10, x2' = 0.3x1
    expected = [0.3 + 0.8 * (first - 0.3) + 0.7, second, *x[2:]]
    np.testing.assert_allclose(RATES["map"].f(0.0, x, u), expected, rtol=1e-14)
    # What holds of the plant's own rates does not hold of these.
    some = np.ones((2, 7))
    assert system.invariants(some) is None
    assert system.indistinguishable(some) == ()
    assert Satellite().invariants(some[:, :3]) is not None
    assert Satellite().indistinguishable(some[:, :3])


@pytest.mark.parametrize("plant", [ReverseDuffing(), Henon()], ids=["flow", "map"])
def test_trajectories_are_those_of_other_rates(plant):
    system = augmented(plant, rates=dict.fromkeys(plant.state_names, TENTH))
    x0 = initial_states(plant, plant.setups["benchmark"], 6)
    deviations = np.random.default_rng(0).uniform(-0.02, 0.02, x0.shape)  # the map stays bounded
    times = plant.setups["benchmark"].times[:20]
    found = truth(system, np.concatenate([x0, deviations], axis=1), times)
    expected = truth(OtherRates(plant, 1 + deviations), x0, times)
    np.testing.assert_allclose(found[..., :2], expected, rtol=0, atol=1e-8)
    constants = np.broadcast_to(deviations, found[..., 2:].shape)
    np.testing.assert_allclose(found[..., 2:], constants, rtol=1e-12)
    assert abs(expected - truth(plant, x0, times)).max() > 0.01  # the deviations count


@needs_compiler
@pytest.mark.parametrize("name", ["all of a map", "duffing"])
def test_compiled_estimates_are_those_in_numpy(name):
    system = RATES[name]
    record = record_of(EpisodeSource(type(system)), 4)
    few = {"t": record.t[:60], "y": record.y[:, :60], "u": record.u[:, :60]}
    estimator = EKF(system)
    assert estimator.compiled is not None
    in_numpy = replace(estimator)
    vars(in_numpy)["compiled"] = None
    record = replace(record, **few)
    assert_near(estimator.run(record), in_numpy.run(record), rtol=1e-8)


def test_it_can_be_traced():
    equations = trace(RATES["duffing"])
    x1, x2, r1, r2 = equations.x
    assert sympy.simplify(equations.f[0] - (1 + r1) * x2**3) == 0
    assert sympy.simplify(equations.f[1] + (1 + r2) * x1) == 0
    assert list(equations.f[2:]) == [0, 0]


def test_slow_and_fast_rates_of_a_measured_plant_are_found():
    """Of a linear plant of which both states are measured, both deviations show."""
    system = augmented(Linear(), rates={"x1": TENTH, "x2": TENTH})
    source = EpisodeSource(type(system), noise_std=0.01)
    batch = source.play(source.draw(source.streams(range(40))))
    found = EKF(source.system, 0.01).run(source.record(batch))
    error = abs(found.xhat[:, -1, 2:] - batch.x[-1, :, 2:])
    std = np.sqrt(np.diagonal(found.P[:, -1], axis1=1, axis2=2)[:, 2:])
    assert (error <= 3 * std).mean() >= 0.95
    assert (np.median(std, axis=0) < 0.5 * 0.1).all()


@dataclass(frozen=True)
class Turning(Linear):
    """The same with a flow of its own."""

    def flow(self, t0, t1, x, u):
        xp = array_namespace(x)
        return stack(x, x[..., 0] + 0 * xp.asarray(t1 - t0), x[..., 1])


@pytest.mark.parametrize(
    ("plant", "given", "says"),
    [
        (Linear(), {"rates": {"y1": TENTH}}, "rates: unknown state 'y1' of Linear; it has x1, x2"),
        (Linear(), {"rates": {"x1": 0.1}}, r"rates\['x1'\]=0.1; expected Unknown\(mean, std\)"),
        (
            Turning(),
            {"rates": {"x2": TENTH}},
            "rates of x2: Turning moves by a flow of its own; expected a plant that moves by f",
        ),
        (
            RATES["duffing"],
            {"rates": {"x1": TENTH}},
            "ReverseDuffing_rate_x1_rate_x2 has 'rate_x1' already; the new state needs that name",
        ),
    ],
)
def test_what_cannot_be_augmented_is_refused_in_one_line(plant, given, says):
    with pytest.raises(ValueError, match=says) as raised:
        augmented(plant, **given)
    assert "\n" not in str(raised.value)
