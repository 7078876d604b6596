"""A policy of an env as an estimator: an agent of Stable-Baselines3 (SB3), or any function."""

from __future__ import annotations

import hashlib
import pickle
import warnings
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any
from uuid import uuid4

import gymnasium as gym
import numpy as np

from pinnobs_gym.envs.actions import FORMS, AgentMemory, Form, form_of
from pinnobs_gym.estimation.estimator import Estimator, State
from pinnobs_gym.estimation.takes import EVERYTHING
from pinnobs_gym.registry import error_line
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import Setup, System
from pinnobs_gym.simulation.values import shortly

WARNING = (
    "can hold code, which runs as the file is loaded: load only what you or people you trust saved"
)
"""What is said of a file of SB3 before it is loaded."""


@dataclass(frozen=True)
class Policy(Estimator):
    """A policy of an env, which acts on what the env of the same game would show it.

    Its estimates are those with which the env would be stepped. An SB3 model acts without
    exploration. What a policy has seen in training is not checked: rows say what envs offer.
    """

    policy: Any = field(kw_only=True, repr=False)
    """An object with SB3's ``predict(observation, state, episode_start, deterministic)``, or a
    function of observations (batch, features) that returns actions (batch, ...)."""
    setup: Setup = field(kw_only=True, repr=False)
    """The setup of the env."""
    normalize: Callable[[np.ndarray], np.ndarray] | None = field(
        default=None, kw_only=True, repr=False
    )
    """What is applied to observations before the policy, as by SB3's ``VecNormalize``."""
    title: str = field(default="policy", kw_only=True, repr=False)
    """Name in tables."""
    action_mode: str = "estimate"
    """Meaning of its actions; see `pinnobs_gym.envs.actions`."""
    stack_outputs: int = 1
    """Number of the last outputs in an observation."""
    mask: bool = field(default=False, kw_only=True, repr=False)
    """Whether observations say which outputs are present, as under conditions that lose some."""

    takes = EVERYTHING - {"sampled_noise"}
    knows = ("model", "prior", "noise", "initial set", "true states in training")
    exempt_from = {
        "model_alone": "a policy's action may move the estimate at any time",
        "blank_rows": "a policy acts once per row",
        "units": "a policy sees numbers in the units of its training",
    }

    @property
    def label(self) -> str:
        return self.title

    @property
    def training(self) -> dict[str, Any]:
        return {"policy": self._identity}

    @cached_property
    def _identity(self) -> str:
        """A hash of the weights of an SB3 model; of anything else, another one each time."""
        network = getattr(self.policy, "policy", self.policy)
        if not hasattr(network, "state_dict"):
            return uuid4().hex
        digest = hashlib.sha256(type(network).__qualname__.encode())
        for name, weights in sorted(network.state_dict().items()):
            digest.update(name.encode() + weights.detach().cpu().numpy().tobytes())
        statistics = getattr(self.normalize, "__self__", None)
        if self.normalize is not None:
            known = getattr(statistics, "obs_rms", None)
            if known is None:
                return uuid4().hex
            digest.update(known.mean.tobytes() + known.var.tobytes())
        return digest.hexdigest()

    @cached_property
    def _form(self) -> Form:
        return form_of(self.action_mode, self.system, self.setup, self.stack_outputs, self.mask)

    def reset(self, prior: Prior) -> State:
        return State(np.asarray(prior.mean, dtype=float))

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        now, hidden = np.full(len(y), t), None
        memory: AgentMemory
        if state.t is None:
            memory = self._form.begin(state.xhat, now, u)
        else:
            memory, hidden = state.memory
        features, memory = self._form.observe(memory, now, y, u)
        actions, hidden = self._act(features.astype(np.float32), hidden, state.t is None)
        memory = self._form.act(memory, actions)
        return State(memory.xhat, t, u, memory=(memory, hidden))

    def _act(self, features: np.ndarray, hidden: Any, first: bool) -> tuple[np.ndarray, Any]:
        """Return the actions (batch, ...), and the policy's next hidden state."""
        seen = features if self.normalize is None else self.normalize(features)
        if hasattr(self.policy, "predict"):
            starts = np.full(len(seen), first)
            actions, hidden = self.policy.predict(seen, hidden, starts, deterministic=True)
        else:
            actions = self.policy(seen)
        actions = np.asarray(actions, dtype=float)
        expected = (len(features), *self._form.action_space.shape)
        if actions.shape != expected:
            raise ValueError(
                f"{self.title} returned actions of shape {actions.shape} for {len(features)} "
                f"observations; expected {expected}"
            )
        return actions, hidden


def is_policy(value: object) -> bool:
    """Return whether a value can be a policy: an object that predicts, or a function."""
    return not isinstance(value, str | type) and (hasattr(value, "predict") or callable(value))


def policy_of(
    policy: Any,
    system: System,
    setup: Setup,
    *,
    loses_outputs: bool = False,
    action_mode: str | None = None,
    stack_outputs: int | None = None,
    normalize: Callable[[np.ndarray], np.ndarray] | None = None,
    title: str | None = None,
) -> Policy:
    """Return a policy as an estimator.

    An SB3 model that still has the env of its training plays with that env's action mode, stack and
    ``VecNormalize`` statistics. Of one without, the action mode is that which fits the sizes of its
    spaces; a function has the action mode ``estimate`` unless another is given.

    Args:
        policy: an SB3 model, a policy of one, or a function; see `Policy`.
        system: the model.
        setup: the setup of the env.
        loses_outputs: whether the env's condition loses outputs, so that observations have a mask.
        action_mode: the env's argument.
        stack_outputs: the env's argument.
        normalize: what is applied to observations before the policy.
        title: name in tables; by default that of the policy's class or function.

    Raises:
        ValueError: in one line, if the spaces of the policy fit no action mode or several, or if
            the env of its training has wrappers that change observations or actions.
    """
    trained = _trained_on(policy)
    mode = action_mode or trained.get("action_mode")
    stack = stack_outputs or trained.get("stack_outputs") or 1
    name: str = title or getattr(policy, "__name__", type(policy).__name__)
    name, kind = name.replace("<lambda>", "policy"), type(system).__name__
    spaces = [getattr(policy, each, None) for each in ("observation_space", "action_space")]
    masks = (False, True) if loses_outputs else (False,)
    if None in spaces:
        mode, masks = mode or "estimate", masks[-1:]
    forms: list[Form] = []
    for each in FORMS if mode is None else (mode,):
        for mask in masks:
            try:
                forms.append(form_of(each, system, setup, stack, mask))
            except ValueError:
                if mode is not None:
                    raise
    if None not in spaces:
        fitting = [form for form in forms if _fits(form, *spaces)]
        if not fitting:
            raise ValueError(
                f"{name} has observations {_size(spaces[0])} and actions {spaces[1]}; of {kind}, "
                f"{_listed(forms)}"
            )
        forms = fitting
    modes = list(dict.fromkeys(form.name for form in forms))
    if len(modes) > 1:
        raise ValueError(
            f"the spaces of {name} are those of several action modes of {kind}; expected "
            f"action_mode {' or '.join(map(repr, modes))}, that of its training (on the command "
            f"line --set action_mode={modes[0]})"
        )
    return Policy(
        system,
        setup.noise_std,
        setup.process_noise,
        policy=policy,
        setup=setup,
        normalize=normalize or trained.get("normalize"),
        title=name,
        action_mode=forms[-1].name,
        stack_outputs=stack,
        mask=forms[-1].mask,
    )


def load_policy(path: Path, normalization: Path | None = None) -> tuple[Any, Any]:
    """Load the policy of a model that SB3 saved, and how its observations are normalised (None if
    they are not). Say `WARNING` first: both files can hold code, which this runs.

    Args:
        path: the file of the model, written by its ``save``.
        normalization: the file of its ``VecNormalize``, written by that one's ``save``.

    Raises:
        ValueError: in one line, if a file is missing, damaged, or something else.
    """
    from stable_baselines3.common.save_util import load_from_zip_file
    from stable_baselines3.common.vec_env import VecNormalize

    for each in (path, normalization):
        if each is not None and not each.is_file():
            raise ValueError(f"{each} is not there; expected a file that Stable-Baselines3 saved")
    try:
        with warnings.catch_warnings(), zipfile.ZipFile(path):
            warnings.simplefilter("ignore")  # of parts of the training that are not needed here
            data, weights, _ = load_from_zip_file(path, device="cpu")
        made = _made(data or {})
        made.load_state_dict(weights["policy"])
        made.set_training_mode(False)
    except Exception as error:  # whatever the file makes of it
        raise ValueError(f"{path} holds no model of SB3: {error_line(error)}") from error
    if normalization is None:
        return made, None
    try:
        statistics = pickle.loads(normalization.read_bytes())
    except Exception as error:
        raise ValueError(f"{normalization} cannot be read: {error_line(error)}") from error
    if not isinstance(statistics, VecNormalize):
        raise ValueError(
            f"{normalization} holds {type(statistics).__name__}; expected SB3's VecNormalize"
        )
    return made, statistics.normalize_obs


def _made(data: Mapping[str, Any]) -> Any:
    """Return the policy of a saved model, without its weights, as its algorithm makes it."""
    from stable_baselines3.common.policies import ActorCriticPolicy

    cls, options = data["policy_class"], dict(data.get("policy_kwargs") or {})
    if issubclass(cls, ActorCriticPolicy):
        options.setdefault("use_sde", data.get("use_sde", False))
    return cls(data["observation_space"], data["action_space"], lambda _: 0.0, **options)


def _trained_on(policy: Any) -> dict[str, Any]:
    """Return what the env of an SB3 model tells of its training; empty without such an env.

    Raises:
        ValueError: in one line, if a wrapper changes observations or actions in another way than
            ``VecNormalize``.
    """
    env: Any = policy.get_env() if hasattr(policy, "get_env") else None
    if env is None:
        return {}
    from stable_baselines3.common import vec_env as sb3

    found: dict[str, Any] = {}
    while isinstance(env, sb3.VecEnvWrapper):
        if isinstance(env, sb3.VecNormalize):
            found["normalize"] = env.normalize_obs if env.norm_obs else None
        elif not isinstance(env, sb3.VecMonitor | sb3.VecCheckNan):
            raise ValueError(_wrapped(env))
        env = env.venv
    wrapper = env.envs[0] if isinstance(env, sb3.DummyVecEnv) else None
    while isinstance(wrapper, gym.Wrapper):
        if isinstance(wrapper, gym.ActionWrapper | gym.ObservationWrapper):
            raise ValueError(_wrapped(wrapper))
        wrapper = wrapper.env
    try:
        form = env.get_attr("agent", 0)[0].form
    except AttributeError:  # of an env that is not of this package
        return found
    if not isinstance(form, Form):
        return found
    return found | {"action_mode": form.name, "stack_outputs": form.stack}


def _wrapped(wrapper: object) -> str:
    name = type(wrapper).__name__
    return (
        f"the model was trained with the wrapper {name}, which changes what it sees or does; "
        "expected a function of the env's own observations that does the same"
    )


def _fits(form: Form, observations: Any, actions: Any) -> bool:
    """Return whether the spaces of a policy are those of a form."""
    return (
        getattr(observations, "shape", None) == form.observation_space.shape
        and isinstance(actions, gym.spaces.Box)
        and actions.shape == form.action_space.shape
        and np.allclose(actions.high, form.action_space.high, rtol=1e-6)
    )


def _size(space: Any) -> str:
    shape = getattr(space, "shape", None)
    return shortly(space) if shape is None else str(shape)


def _listed(forms: list[Form]) -> str:
    """Return the sizes of forms in words."""
    sizes = [
        f"action_mode={form.name!r} has {form.observation_space.shape} and {form.action_space}"
        for form in forms
    ]
    return "; ".join(sizes)
