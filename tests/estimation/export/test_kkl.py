"""Exported KKL observers, with networks of random weights, against those in Python."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from export_figures.built import FLAGS, SANITIZERS, csv_of, replay
from export_figures.built import build as build_files
from exported import assert_replays, build, needs_c
from linear import Linear

from pinnobs_gym.estimation.export.c_files import c_files
from pinnobs_gym.estimation.learned.kkl_dynamics import realised
from pinnobs_gym.estimation.learned.kkl_region import Region
from pinnobs_gym.estimation.learned.trained_file import identity
from pinnobs_gym.estimators.kkl import Clock, KKLSupervised, TrainedKKL
from pinnobs_gym.simulation.arrays import array_namespace
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import stack

pytestmark = needs_c


class Pushed(Linear):
    """The linear plant with a known input."""

    input_names = ("push",)

    def f(self, t, x, u):
        return super().f(t, x, u) + stack(x, 0.0, u[..., 0])

    def input(self, t):
        return array_namespace(t).sin(t)[..., None]


def irregular_record():
    """Outputs at irregular times, some of which are missing."""
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.choice([0.1, 0.1, 0.03, 0.25], 40))
    y = rng.normal(0, 0.5, (1, 40, 2))
    y[:, 0, 1], y[:, 7], y[:, 11, 0] = np.nan, np.nan, np.nan
    prior = Prior(np.array([[0.3, -0.2]]), np.eye(2)[None])
    return Record(t, y, Pushed().input(t)[None], prior)


def layers(rng, *sizes):
    """Random weights and biases."""
    return tuple(
        (rng.normal(0, b**-0.5, (a, b)), rng.normal(0, 0.1, a)) for b, a in pairwise(sizes)
    )


def observer(system, mode, start, activation, timed):
    """A KKL observer of a system, as if it were trained."""
    rng = np.random.default_rng(0)
    nx, ny, about = system.nx, system.ny, identity(system)
    dynamics = realised((-1.0, -2.5, -1.5 + 1j, -1.5 - 1j), ny, mode)
    clock = Clock((0.5,), (2.0,) * system.nu) if timed else Clock()
    nz = dynamics.size
    trained = TrainedKKL(
        A=dynamics.A,
        B=dynamics.B,
        mode=mode,
        start=start,
        clock=clock,
        activation=activation,
        encoder=layers(rng, nx + clock.size, 7, nz),
        decoder=layers(rng, nz + clock.size, 9, 5, nx),
        facts={"dropped": 0, "drawn": 0},
        trainer="kkl_supervised",
        system=about["system"],
        parameters=about["parameters"],
        noise_std=(0.1,) * ny,
        condition="nominal",
        config={},
        seed=0,
        loss=0.0,
        iterations=1,
        seconds=0.0,
        ending="finished",
    )
    return KKLSupervised(system, trained=trained)


def test_an_exported_observer_tells_what_is_outside_of_its_region(tmp_path):
    """Its estimates there are T*(z), and the export says so in a line."""
    system, record = Pushed(), irregular_record()
    # Missing outputs would be predicted from other estimates.
    record = replace(record, y=np.nan_to_num(record.y))
    plain = observer(system, "continuous", "output", "tanh", False)
    trained = plain.trained
    z0 = record.y[:, 0] @ trained.rest.T
    z = trained.dynamics.filtered(record.t, record.y.swapaxes(0, 1), z0)[:20, 0]
    region = replace(Region.of(z, trained.inverse(z, 0.0, np.zeros(1)), 0), radius=0.01)
    guarded = replace(plain, trained=replace(trained, region=region))
    files = c_files(guarded, record.prior, "plant")
    assert any("outside of the region" in line for line in files.notes)
    assert not c_files(plain, record.prior, "plant").notes
    assert_replays(build(tmp_path, guarded, record.prior), plain, record, 1e-12)
    shown = files.replay.replace("(double)filter.x[i]", "(double)filter.outside")
    assert shown != files.replay
    program = build_files(tmp_path, replace(files, replay=shown), (*FLAGS, *SANITIZERS))
    found, _ = replay(program, csv_of(record, system))
    expected = guarded.run(record).outside[0]
    assert not expected[:20].any()
    assert expected[20:].any()
    np.testing.assert_array_equal(found[:, 1], expected)


@pytest.mark.parametrize(
    ("mode", "start", "activation", "timed"),
    [
        ("continuous", "output", "tanh", False),
        ("continuous", "prior", "silu", True),
        ("discrete", "zero", "relu", True),
    ],
)
def test_an_exported_observer_gives_the_same_estimates(mode, start, activation, timed, tmp_path):
    """At irregular times, some of them without an output."""
    system, record = Pushed(), irregular_record()
    estimator = observer(system, mode, start, activation, timed)
    assert_replays(build(tmp_path, estimator, record.prior), estimator, record, 1e-12)
