"""Exported estimators against the same in Python, under sanitizers and with all warnings."""

from dataclasses import dataclass, replace
from typing import ClassVar

import many_plants
import numpy as np
import pytest
from array_api_compat import array_namespace
from exported import assert_replays, build, csv_of, needs_c, replay
from linear import Linear, linear_record, record_of

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.export.c_files import c_files
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ckf import CKF
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.luenberger import Luenberger
from pinnobs_gym.estimators.robust_ekf import RobustEKF
from pinnobs_gym.estimators.strong_tracking_ekf import StrongTrackingEKF
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.system import Setup, System, stack
from pinnobs_gym.systems import SYSTEMS

pytestmark = needs_c


def played(name, samples=200):
    """A system, its setup and the beginning of a record."""
    source = EpisodeSource(name)
    return source.system, source.setup, record_of(source, 1).first_samples(samples)


@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_an_exported_ekf_gives_the_estimates_of_each_system(name, tmp_path):
    system, setup, record = played(name)
    estimator = EKF.for_setup(system, setup)
    assert_replays(build(tmp_path, estimator, record.prior), estimator, record, 1e-12)


@pytest.mark.parametrize(
    ("kind", "name"),
    [(UKF, "InductionMotor"), (CKF, "ReverseDuffing"), (Luenberger, "Satellite")],
)
def test_other_filters(kind, name, tmp_path):
    system, setup, record = played(name)
    estimator = kind.for_setup(system, setup)
    assert_replays(build(tmp_path, estimator, record.prior), estimator, record, 1e-12)


def test_single_precision(tmp_path):
    system, setup, record = played("ReverseDuffing", 1000)
    estimator = EKF.for_setup(system, setup)
    program = build(tmp_path, estimator, record.prior, float32=True)
    assert "double x" not in (tmp_path / "plant.h").read_text()
    assert_replays(program, estimator, record, 1e-5)


@pytest.mark.parametrize(
    "plant",
    [
        many_plants.cart_with_measured_input,
        many_plants.cart_with_joined_input,
        many_plants.henon_with_measured_input,
        many_plants.bounded_reactor,
        many_plants.well,
        many_plants.augmented_cart,
    ],
)
def test_plants_of_many_kinds(plant, tmp_path):
    """Irregular times, missing outputs, held and joined inputs, maps, bounds, angles, tables."""
    system, record = plant(1)
    estimator = EKF(system)
    # Bounds that are met are the work of NumPy here, whose sums have another order.
    tolerance = 1e-12 if system.state_box is None else 1e-9
    assert_replays(build(tmp_path, estimator, record.prior), estimator, record, tolerance)


@dataclass(frozen=True)
class Chain(System):
    """Seven masses in a row, the last one measured: more states than straight code is written
    for."""

    state_names = tuple(f"x{i}" for i in range(7))
    output_names = ("end",)
    scale = (1.0,) * 7
    setups: ClassVar = {"benchmark": Setup((-1,) * 7, (1,) * 7, dt=0.1, noise_std=0.1)}

    def f(self, t, x, u):
        ahead = [x[..., (i + 1) % 7] - x[..., i] for i in range(7)]
        return stack(x, *(d - 0.3 * x[..., i] ** 3 for i, d in enumerate(ahead)))

    def h(self, t, x, u):
        return x[..., 6:]


@pytest.mark.parametrize("kind", [EKF, UKF])
def test_a_plant_with_many_states(kind, tmp_path):
    estimator, record = kind(Chain()), record_of(EpisodeSource(Chain), 1).first_samples(50)
    assert_replays(build(tmp_path, estimator, record.prior), estimator, record, 1e-12)


@pytest.mark.parametrize(
    "estimator",
    [
        EKF(Linear(), gate=0.9, patience=2),
        RobustEKF(Linear()),
        EKF(Linear(), huber=0.5),
        StrongTrackingEKF(Linear(), gamma=1e-2, output_factor=0.5),
    ],
)
def test_gate_and_weights(estimator, tmp_path):
    record = linear_record(1)
    y = record.y.copy()
    y[:, 5:9] += 3.0  # outliers, for which the gate restarts the filter
    record = replace(record, y=y)
    assert_replays(build(tmp_path, estimator, record.prior), estimator, record, 1e-12)


def test_a_refused_sample_leaves_the_filter_as_it_was(tmp_path):
    estimator, record = EKF(Linear()), linear_record(1)
    program = build(tmp_path, estimator, record.prior)
    head, *lines = csv_of(record, Linear()).splitlines()
    for wrong, status in (
        ("0.0,1,1", 1),  # time does not increase
        ("nan,1,1", 1),
        ("1e9,1,1", 2),  # more steps than are taken between two samples
        ("0.15,inf,1", 3),
    ):
        found, said = replay(program, "\n".join([head, *lines[:2], wrong]) + "\n")
        assert len(found) == 2
        assert said == f"line 4: status {status}\n"


@pytest.mark.parametrize(
    ("wrong", "cell"),
    [('0.3,"1",1', 2), ("0.3;1;1", 1), ("2024-01-01,1,1", 1), ("0.3,1", 2), ("0.3,1,1,1", 3)],
)
def test_a_replay_refuses_lines_of_other_cells(wrong, cell, tmp_path):
    estimator, record = EKF(Linear()), linear_record(1)
    program = build(tmp_path, estimator, record.prior)
    head, *lines = csv_of(record, Linear()).splitlines()
    found, said = replay(program, "\n".join([head, *lines[:2], "", "0.25, ,1\r", wrong]) + "\n")
    assert len(found) == 3
    assert said == f"line 6: cell {cell} is no number, or not all 3 cells are there\n"


@dataclass(frozen=True)
class Branching(Linear):
    """Its equations depend on data."""

    def f(self, t, x, u):
        return -x if float(x.sum()) > 0 else x


class OwnFlow(Linear):
    def flow(self, t0, t1, x, u):
        return x


class Stiff(Linear):
    stiff = True


class OwnCorrection(EKF):
    name = "own"

    def correct(self, state, t, y, u):
        return super().correct(state, t, y, u)


@pytest.mark.parametrize(
    ("estimator", "message"),
    [
        (EKF(Branching()), "the equations of Branching cannot be traced"),
        (EKF(OwnFlow()), "OwnFlow has a flow of its own, which is not exported"),
        (EKF(Stiff()), "Stiff has stiff equations, which is not exported"),
        (OwnCorrection(Linear()), "OwnCorrection defines correct, which exported code does not"),
        (ESTIMATORS.resolve("mhe")(Linear()), "estimator 'mhe' is not exported; expected ekf"),
    ],
)
def test_what_cannot_be_exported_is_told_in_one_line(estimator, message):
    with pytest.raises(ValueError, match=message) as caught:
        c_files(estimator, linear_record(1).prior, "plant")
    assert "\n" not in str(caught.value)


def test_sigma_points_of_a_plant_with_bounds_and_very_wide_priors():
    system, record = many_plants.bounded_reactor(1)
    with pytest.raises(ValueError, match="has bounds of states, with which ukf is not exported"):
        c_files(UKF(system), record.prior, "plant")
    prior = linear_record(1).prior
    with pytest.raises(ValueError, match="the prior is so wide beside the output noise"):
        c_files(EKF(Linear()), replace(prior, cov=1e16 * prior.cov), "plant")


@pytest.mark.parametrize("name", ["", "2a", "a-b", "a b", "é", "_a"])
def test_names_are_those_of_c(name):
    with pytest.raises(ValueError, match="expected a name in C"):
        c_files(EKF(Linear()), linear_record(1).prior, name)


@pytest.mark.parametrize("name", ["int", "class", "sin", "main", "filter", "plan", "kalman"])
def test_names_of_the_language_and_of_the_code_are_refused(name):
    """The code has a function kalman_update, as an export of that name would."""
    with pytest.raises(
        ValueError, match=rf"name='{name}': {name}(_update)? is taken by C or the c"
    ):
        c_files(EKF(Linear()), linear_record(1).prior, name)


class Shaken(Linear):
    """The linear plant with an excitation of a known time."""

    def f(self, t, x, u):
        return stack(x, x[..., 1], array_namespace(x).cos(t) - x[..., 0])


def test_equations_with_time_in_single_precision_are_told():
    prior = linear_record(1).prior
    (note,) = c_files(EKF(Shaken()), prior, "plant", float32=True).notes
    assert note.startswith("the equations contain t, of which single precision keeps 7 digits")
    assert not c_files(EKF(Shaken()), prior, "plant").notes
    assert not c_files(EKF(Linear()), prior, "plant", float32=True).notes


class Sum(Linear):
    """The linear plant with an output that no straight code is written for."""

    def h(self, t, x, u):
        return stack(x, x[..., 0] + x[..., 1], x[..., 1])


def test_equal_filters_have_equal_checksums_and_others_do_not():
    prior = linear_record(1).prior
    first, same, other, tuned = (
        c_files(made, prior, "plant").checksum
        for made in (EKF(Linear()), EKF(Linear()), EKF(Sum()), EKF(Linear(), assumed_noise=0.1))
    )
    assert first == same
    assert len({first, other, tuned}) == 3
    assert np.unique([first, same]).size == 1
