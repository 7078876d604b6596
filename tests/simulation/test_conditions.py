"""Conditions against what they say: invariants, linear algebra, and the nominal episodes."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pytest
from linear import A, FeedThrough, Linear, Modulated, jacobians, process_covariance
from scipy.linalg import expm

from pinnobs_gym import evaluate
from pinnobs_gym.cli import main
from pinnobs_gym.cli.system_page import page
from pinnobs_gym.envs.env import EstimationEnv
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.leaderboard.jobs.plan import jobs_of
from pinnobs_gym.leaderboard.suites import Entry, Suite
from pinnobs_gym.scoring import rows
from pinnobs_gym.simulation.conditions import CONDITIONS, canonical_name, fitting, parse_condition
from pinnobs_gym.simulation.conditions.plant import uncertain_parameters
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.induction_motor import InductionMotor
from pinnobs_gym.systems.satellite import Satellite


def played(name, condition, batch=20, **changes):
    source = EpisodeSource(name, changes.pop("setup", "benchmark"), condition, **changes)
    streams = source.streams(range(batch))
    return source, source.play(source.draw(streams))


@pytest.mark.parametrize("name", SYSTEMS.classes())
@pytest.mark.parametrize("condition", CONDITIONS)
def test_every_condition_can_be_played_on_every_system_that_it_fits(name, condition):
    if condition in fitting(*SYSTEMS.resolve(name).configured()):
        source, episodes = played(name, condition, batch=3)
        assert np.isfinite(episodes.x).all()
        assert not np.isnan(episodes.y).all(axis=(0, 2)).any()
        assert source.system == SYSTEMS.resolve(name)()  # what estimators are given
    else:
        with pytest.raises(ValueError, match=f"'{condition}' needs a plant with .*; {name} has"):
            EpisodeSource(name, condition=condition)


@pytest.mark.parametrize("condition", ["noise0", "noise0+mismatch10", "noise0+process_noise1e-2"])
@pytest.mark.parametrize("cls", [FeedThrough, Modulated])
def test_outputs_are_h_at_the_samples_own_time_and_input(cls, condition):
    """y_k = C(t_k, u_k)x_k + Du_k + (sin 3t_k, 0)/2, written out, at the states of the plant."""
    source, episodes = played(cls, condition, batch=3)
    t, u = source.times, np.cos(5 * source.times)[:, None] + 0.3
    np.testing.assert_allclose(source.inputs, u, rtol=1e-14)
    C = jacobians(source.system, t, u)
    expected = np.einsum("kij,kbj->kbi", C, episodes.x)
    expected += (u * (0.7, -1.1) + 0.5 * np.stack([np.sin(3 * t), 0 * t], axis=-1))[:, None]
    np.testing.assert_allclose(episodes.y, expected, atol=1e-13)
    np.testing.assert_allclose(episodes.observations[..., :2], expected, atol=1e-6)


def signs(count):
    """All combinations (2**count, count) of -1 and 1."""
    return np.stack(np.meshgrid(*[[-1.0, 1.0]] * count), axis=-1).reshape(-1, count)


@pytest.mark.parametrize("part", [0.1, 0.3])
def test_mismatch_of_a_plant_without_parameters_is_of_its_rates(part):
    """ẋ₁ = a·x₂³, ẋ₂ = −b·x₁ conserves b·x₁²/2 + a·x₂⁴/4."""
    _, episodes = played("ReverseDuffing", f"mismatch{round(100 * part)}", batch=40)
    x1, x2 = np.moveaxis(episodes.x, -1, 0)
    chosen = []
    for a, b in 1 + part * signs(2):
        energy = b * x1**2 / 2 + a * x2**4 / 4
        chosen.append(np.ptp(energy, axis=0) / energy[0] < 1e-8)
    # a and b equal cannot be told by the invariant alone which way they are off
    same = chosen[0] & chosen[3]
    assert (same | chosen[1] | chosen[2]).all()
    assert min(same.sum(), chosen[1].sum(), chosen[2].sum()) > 2  # signs vary between episodes


def test_mismatch_of_parameters():
    """Every parameter of the satellite is off, with a sign of its own."""
    _, episodes = played("Satellite", "mismatch10", batch=40)
    a = np.array([0.5, -0.875, 2 / 3])
    found = np.zeros((40, 8), dtype=bool)
    for i, factor in enumerate(1 + 0.1 * signs(3)):
        a1, a2, a3 = a * factor
        invariants = Satellite(a1=a1, a2=a2, a3=a3).invariants(episodes.x)
        found[:, i] = (np.ptp(invariants, axis=0) < 1e-7).all(axis=-1)
    # all three off the same way conserve the same as none
    assert found.any(axis=1).all()
    assert not found.all(axis=1).any()
    assert (found.sum(axis=0) > 0).all()


def test_mismatch_leaves_out_what_is_no_number():
    @dataclass(frozen=True)
    class Labelled(Satellite):
        label: str = "bench 3"
        table: tuple[str, ...] = ("a", "b")

    source, episodes = played(Labelled, "mismatch10", batch=2)
    assert uncertain_parameters(source.system) == ("a1", "a2", "a3")
    assert np.isfinite(episodes.x).all()


def test_mismatch_leaves_out_what_the_system_is_sure_of():
    source, episodes = played("InductionMotor", "mismatch30", batch=2)
    plant = source.condition.plant(source.system, [np.random.default_rng(0)] * 2)
    for name, value in plant.parameters.items():
        nominal = getattr(InductionMotor(), name)
        off = np.abs(np.broadcast_to(value, 2) / nominal - 1)
        np.testing.assert_allclose(off, 0.3 if name in InductionMotor.uncertain else 0, atol=1e-12)
    assert np.array_equal(
        episodes.observations[..., 2:4].std(axis=1).max(), 0
    )  # the input is known


def test_process_noise_is_white_and_of_the_size_it_says():
    _, episodes = played(Linear, "process_noise1e-2", batch=200)
    disturbance = episodes.x[1:] - episodes.x[:-1] @ expm(0.1 * A).T
    # 1e-2 of the scale after a sample of 0.1 s; whitened by a root of its covariance over the step.
    Q = process_covariance(1e-2 / np.sqrt(0.1))
    white = disturbance @ np.linalg.inv(np.linalg.cholesky(Q)).T
    cov = np.cov(white.reshape(-1, 2).T)
    np.testing.assert_allclose(cov, np.eye(2), atol=5 * np.sqrt(2 / 4000))
    lagged = (white[1:] * white[:-1]).mean()
    across = (white[:, 1:] * white[:, :-1]).mean()
    assert max(abs(lagged), abs(across)) < 5 / np.sqrt(7600)


@pytest.mark.parametrize(("name", "seconds"), [("ReverseDuffing", 1.0), ("InductionMotor", 0.2)])
def test_the_gap(name, seconds):
    source, episodes = played(name, "gap", batch=60)
    _, nominal = played(name, "nominal", batch=60)
    missing = np.isnan(episodes.y).all(axis=-1)
    count = round(seconds / source.setup.dt)
    assert (abs(missing.sum(axis=0) - count) <= 1).all()
    edges = np.abs(np.diff(missing.astype(int), axis=0)).sum(axis=0)
    assert (edges <= 2).all()  # in one piece
    first = missing.argmax(axis=0) / (len(missing) - count)
    assert first.mean() == pytest.approx(0.5, abs=0.19)  # 5 standard errors
    assert first.min() < 0.1
    assert first.max() > 0.9
    np.testing.assert_array_equal(episodes.y[~missing], nominal.y[~missing])


@pytest.mark.parametrize("samples", [1, 5])
def test_delay(samples):
    _, late = played("InductionMotor", f"delay{samples}", batch=2)
    _, nominal = played("InductionMotor", "nominal", batch=2)
    np.testing.assert_array_equal(late.y[samples:], nominal.y[:-samples])
    assert np.isnan(late.y[:samples]).all()
    np.testing.assert_array_equal(late.x, nominal.x)
    np.testing.assert_array_equal(late.observations[..., 2:], nominal.observations[..., 2:])


def test_a_guess_further_away():
    for name in SYSTEMS.classes():
        source = EpisodeSource(name, condition="xhat0_far")
        near = EpisodeSource(name).setup
        centre = source.setup.start(source.system.nx).mean
        further = abs(np.array(source.setup.xhat0) - centre) - abs(np.array(near.xhat0) - centre)
        np.testing.assert_allclose(further, 2 * np.sqrt(np.diag(near.P0)))
        assert source.setup.P0 == near.P0
    env = EstimationEnv("ReverseDuffing", condition="xhat0_far")
    expected = 2 * np.sqrt([1.682, 1.002])
    np.testing.assert_allclose(env.reset(seed=0)[1]["xhat0"], expected)


POOR = {
    "ReverseDuffing": ([1, 1], [1.5, 1.2]),
    "HarmonicOscillator": ([1, 1, 2], [1.5, 1.5, 2]),
    "Academic": ([1, 2], [1.5, 2]),
    "ModifiedAcademic": ([3, 1], [3, 1.5]),
    "Satellite": ([1, 1, 2], [1.5, 1.5, 1]),
    "InductionMotor": ([0, 0, 0, 0, 0], [3, 3, 0.3, 0.3, 120]),
}
"""x̂₀ and the standard deviations of P₀ under the condition poor_prior."""


@pytest.mark.parametrize("name", POOR)
def test_a_poor_prior_is_told_and_changes_nothing_else(name):
    source, episodes = played(name, "poor_prior", batch=2)
    prior = source.record(episodes).prior
    np.testing.assert_array_equal(prior.mean, [POOR[name][0]] * 2)
    np.testing.assert_allclose(prior.cov, [np.diag(np.square(POOR[name][1]))] * 2, rtol=1e-14)
    nominal_source, nominal = played(name, "nominal", batch=2)
    np.testing.assert_array_equal(episodes.x, nominal.x)
    np.testing.assert_array_equal(episodes.y, nominal.y)
    assert abs(nominal_source.record(nominal).prior.cov - prior.cov).max() > 0.01


def test_a_poor_prior_exists_where_a_setup_names_one():
    assert "poor_prior" not in fitting(*Satellite.configured("paper"))
    with pytest.raises(ValueError, match="'poor_prior' needs a setup with a poor_prior; that of L"):
        EpisodeSource(Linear, condition="poor_prior")


def test_a_poor_prior_can_be_further_away_too():
    xhat0 = EpisodeSource("Academic", condition="xhat0_far+poor_prior").setup.xhat0
    np.testing.assert_allclose(xhat0, [1 + 2 * 1.5, 2 + 2 * 2])


def test_the_same_seed_has_other_noise_in_another_system():
    """Of 5,000 numbers, of which a correlation's standard error is 0.014."""
    noise = {}
    for name in ("ReverseDuffing", "ModifiedAcademic", "Satellite", "HarmonicOscillator"):
        source = EpisodeSource(name)
        noise[name] = source.draw(source.streams(range(10))).noise[:, :500, 0]
    for one, other in combinations(noise.values(), 2):
        assert (one != other).mean() > 0.999
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.06


def test_the_same_seed_starts_elsewhere_in_another_system():
    """Of 400 initial states, of which a correlation's standard error is 0.05."""
    starts = []
    for name in ("ReverseDuffing", "Academic"):
        source = EpisodeSource(name)
        starts.append(source.draw(source.streams(range(400))).x0)
    for i in range(2):
        assert abs(np.corrcoef(starts[0][:, i], starts[1][:, i])[0, 1]) < 0.2


def test_the_salt_does_not_depend_on_the_process():
    """The first draws of seed 0."""
    source = EpisodeSource("ReverseDuffing")
    draws = source.draw(source.streams([0]))
    found = [*draws.x0[0], *draws.noise[0, :2, 0]]
    np.testing.assert_allclose(
        found,
        [0.8849304713676487, -0.015582239567141887, 0.13919637087515765, -0.41714366939667236],
        rtol=1e-12,
    )


@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_initial_states_outside_the_set(name):
    source, episodes = played(name, "x0_outside", batch=50)
    assert not source.contains(episodes.x[0]).any()
    assert source.contains(episodes.x[0] / 1.5).all()


def test_the_fixed_initial_state_of_a_setup_is_left_too():
    _, episodes = played("ReverseDuffing", "x0_outside", batch=2, setup="paper")
    np.testing.assert_array_equal(episodes.x[0], [[3.0, -1.5]] * 2)


@pytest.mark.parametrize("factor", [0.5, 2.0, 5.0])
def test_other_sample_times(factor):
    source, episodes = played("Academic", f"dt{factor:g}", batch=3)
    _, nominal = played("Academic", "nominal", batch=3)
    assert source.setup.dt == 0.02 * factor
    assert source.times[-1] == pytest.approx(10.0)
    every = int(max(factor, 1)), int(max(1 / factor, 1))
    np.testing.assert_allclose(nominal.x[:: every[0]], episodes.x[:: every[1]], atol=1e-8)


def test_the_order_of_names_does_not_matter():
    _, one = played("Satellite", "outliers+mismatch10", batch=2)
    _, other = played("Satellite", "mismatch10+outliers", batch=2)
    np.testing.assert_array_equal(one.x, other.x)
    np.testing.assert_array_equal(one.y, other.y)


@pytest.mark.parametrize(
    ("name", "canonical"),
    [
        ("nominal", "nominal"),
        ("load_step", "load_step"),
        ("outliers+mismatch10", "mismatch10+outliers"),
        ("mismatch10+outliers", "mismatch10+outliers"),
        ("gap+dt2+noise5", "noise5+dt2+gap"),
        ("noise5+nominal", "noise5"),
    ],
)
def test_a_condition_has_one_name(name, canonical):
    assert canonical_name(name) == canonical
    assert parse_condition(name) == parse_condition(canonical)


def test_both_spellings_are_one_condition_to_rows_jobs_and_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spellings = ("outliers+dt5", "dt5+outliers")
    found = [
        evaluate("ekf", "pinnobs/Academic-v0", episodes=1, condition=name, results="rows.jsonl")
        for name in spellings
    ]
    assert found[0] == found[1]  # its date too: the second is the stored row
    (row,) = rows.read(tmp_path / "rows.jsonl")
    assert row["condition"] == "dt5+outliers"
    suite = Suite(systems=("Academic",), estimators=(Entry("ekf"),), conditions=tuple(spellings))
    jobs = jobs_of(suite, tmp_path)
    assert [job.game.name.condition for job in jobs] == ["dt5+outliers"]
    for name in spellings:
        chosen = ["--system", "Academic", "--condition", name, "--episodes", "2"]
        assert main(["tune", "ekf", *chosen, "--trials", "2"]) == 0
    trials = {path.name for path in (tmp_path / "runs" / "tune").glob("*.journal")}
    assert trials == {"Academic-v0-benchmark-dt5+outliers-ekf.journal"}


@pytest.mark.parametrize(
    ("condition", "reference"),
    [
        ("nominal", True),
        ("noise5+dropout30", True),
        ("process_noise1e-3", True),
        ("dt2+gap", True),
        ("noise0", False),
        ("mismatch10", False),
        ("noise5+outliers", False),
        ("delay1", False),
        ("xhat0_far", False),
        ("poor_prior", False),
        ("x0_outside", False),
        ("load_step", False),
    ],
)
def test_where_the_reference_is_that_of_the_episodes(condition, reference):
    assert parse_condition(condition).reference is reference


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        ("rain", "unknown condition 'rain'; known are nominal, .*mismatch10.*process_noise1e-3"),
        ("noise5+mismatch10+noise15", "'noise5' and 'noise15' change the same; name one"),
        ("delay5", "condition 'delay5' leaves no output in 4 sample"),
        ("dt5", "duration=0.08 s is shorter than one sample, dt=0.1 s"),
        ("load_step", "needs a plant with a load torque; Academic has none"),
    ],
)
def test_what_cannot_be_played_is_one_clear_line(condition, message):
    with pytest.raises(ValueError, match=message) as caught:
        EpisodeSource("Academic", condition=condition, duration=0.08)
    assert "\n" not in str(caught.value)


def test_the_page_of_a_system_has_the_conditions_that_fit_it():
    assert "| load_step |" in page(InductionMotor, "x")
    text = page(Satellite, "x")
    assert "| load_step |" not in text
    assert "| mismatch10 | parameters of the plant off by ±10 %, the model's nominal |" in text
    names = fitting(*Satellite.configured())
    assert set(CONDITIONS) - set(names) == {"load_step"}


def test_a_system_that_is_uncertain_of_what_it_has_not_is_refused():
    class Wrong(Satellite):
        uncertain = ("a4",)

    with pytest.raises(TypeError, match="Wrong: uncertain names no parameter 'a4'"):
        Wrong.validate()


@pytest.mark.parametrize(
    ("name", "condition", "count"),
    [
        ("ReverseDuffing", "mismatch10", 2),
        ("Satellite", "mismatch30", 3),
        ("InductionMotor", "mismatch10+load_step", 5),
        ("Academic", "delay4", 1),
        ("Satellite", "noise5+mismatch10+delay1+gap", 4),
        ("Satellite", "nominal", 0),
        ("Satellite", "dt2+xhat0_far+x0_outside+process_noise1e-2+outliers+dropout10+gap", 0),
        ("Satellite", "noise0.1+poor_prior", 0),
    ],
)
def test_what_estimators_are_not_told(name, condition, count):
    source = EpisodeSource(name, condition=condition)
    unknowns = source.condition.unknowns(source.system, source.setup)
    assert sum(len(each.std) for each in unknowns) == count


@pytest.mark.parametrize("name", ["ReverseDuffing", "Satellite", "InductionMotor"])
def test_plants_are_off_by_their_unknowns(name):
    """Under mismatch30: without deviations they are the model, with ±std those that are played."""
    source = EpisodeSource(name, condition="mismatch30")
    system, (x0,) = source.system, source.draw(source.streams([0])).x0
    (unknown,) = source.condition.unknowns(system, source.setup)
    count = len(unknown.std)
    assert unknown.std == (0.3,) * count
    plant = unknown.plant(system, np.zeros((1, count)))
    np.testing.assert_array_equal(rate(plant, x0[None]), rate(system, x0[None]))
    all_signs = 0.3 * signs(count)
    possible = rate(unknown.plant(system, all_signs), np.repeat(x0[None], len(all_signs), axis=0))
    rngs = [np.random.default_rng(seed) for seed in range(8)]
    for played in rate(source.condition.plant(system, rngs), np.repeat(x0[None], 8, axis=0)):
        assert (possible == played).all(axis=-1).any()


def rate(plant, x, seconds=0.3):
    t = np.full(len(x), seconds)
    return plant.f(t, x, np.asarray(plant.input(t)))


def test_a_delay_is_of_the_samples_that_are_played():
    source = EpisodeSource("Academic", condition="dt5+delay2")
    (unknown,) = source.condition.unknowns(source.system, source.setup)
    np.testing.assert_allclose(unknown.std, 2 * 5 * 0.02)


def test_the_torque_after_the_step_is_off_by_what_is_drawn():
    """Root mean square of 20,000 draws relative to the model's 10 N·m; ω' = ... − T/J."""
    source = EpisodeSource("InductionMotor", condition="mismatch10+load_step")
    off, torque = source.condition.unknowns(source.system, source.setup)
    drawn = np.random.default_rng(0).uniform(0, 40, 20000) - 10
    np.testing.assert_allclose(torque.std, np.sqrt(np.mean(drawn**2)), rtol=0.02)
    # T_L, off by 10 %, acts before the step alone, and the other torque after it.
    deviations = np.zeros((2, 4))
    deviations[:, off.names.index("T_L")] = 0.1
    plant = torque.plant(off.plant(source.system, deviations), np.array([[6.0], [6.0]]))
    x, J = np.ones((2, 5)), source.system.J
    for seconds, other in ((0.5, 1.0), (0.7, 6.0)):
        changed = rate(plant, x, seconds) - rate(source.system, x, seconds)
        np.testing.assert_allclose(changed, [[0, 0, 0, 0, -other / J]] * 2, atol=1e-9)
