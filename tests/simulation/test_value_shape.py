"""Functions of a user's system whose values change their shape after the first call."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from linear import Linear, linear_record

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.simulation.probe import ModelError
from pinnobs_gym.systems import SYSTEMS

with SYSTEMS.isolated():
    RECORD = linear_record()


def passed(x):
    """Whether a state is one that `probe` never sees."""
    return isinstance(x, np.ndarray) and np.max(abs(x), initial=0.0) > 1e3


@dataclass(frozen=True)
class LateF(Linear):
    """Its f returns one row for all."""

    def f(self, t, x, u):
        value = super().f(t, x, u)
        return value[..., :1, :] if passed(x) else value


@dataclass(frozen=True)
class LateH(Linear):
    """Its h returns one output for both."""

    def h(self, t, x, u):
        value = super().h(t, x, u)
        return value[..., :1] if passed(x) else value


@pytest.fixture(autouse=True)
def in_numpy(monkeypatch):
    """Compiled code has the equations of the first call."""
    monkeypatch.setenv("PINNOBS_KERNELS", "0")
    with SYSTEMS.isolated():
        yield


@pytest.mark.parametrize(
    ("cls", "line"),
    [
        (LateF, "LateF.f returned shape (1, 2); expected shape (2, 2), at every time and state"),
        (LateH, "LateH.h returned shape (21, 2, 1); expected shape (21, 2, 2), at every time and"),
    ],
)
def test_an_episode_is_refused(cls, line):
    source = EpisodeSource(cls)
    draws = source.draw(source.streams(range(2)))
    with pytest.raises(ModelError) as caught:
        source.play(draws, np.array([[2e3, 0.0], [0.0, 0.0]]))
    assert str(caught.value).startswith(line)


@pytest.mark.parametrize(
    ("cls", "name"),
    [(LateF, name) for name in ("ekf", "ukf", "enkf", "luenberger", "particle")]
    + [(LateH, name) for name in ("ekf", "ukf", "enkf", "luenberger", "particle", "sliding_mode")],
)
def test_an_estimator_refuses_such_a_model(cls, name):
    estimator = ESTIMATORS.resolve(name).for_setup(cls(), cls.setups["benchmark"])
    prior = replace(RECORD.prior, mean=RECORD.prior.mean + 2e3)
    with pytest.raises(ModelError, match=rf"^{cls.__name__}\.{cls.__name__[-1].lower()} returned"):
        estimator.run(replace(RECORD, prior=prior, y=RECORD.y + np.array([2e3, 4e3])))
