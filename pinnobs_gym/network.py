"""The network of PINN-Obs: from a time to an estimate and an observer gain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeAlias, get_args

import torch
from torch import Tensor, nn

Activation: TypeAlias = Literal["tanh", "sine", "sigmoid", "relu"]
Precision: TypeAlias = Literal["float32", "float64"]

_DTYPES = {"float32": torch.float32, "float64": torch.float64}


def _tanh(z: Tensor) -> tuple[Tensor, Tensor]:
    value = torch.tanh(z)
    return value, 1 - value * value


def _sine(z: Tensor) -> tuple[Tensor, Tensor]:
    return torch.sin(z), torch.cos(z)


def _sigmoid(z: Tensor) -> tuple[Tensor, Tensor]:
    value = torch.sigmoid(z)
    return value, value * (1 - value)


def _relu(z: Tensor) -> tuple[Tensor, Tensor]:
    return torch.relu(z), (z > 0).to(z.dtype)


_ACTIVATIONS: dict[str, Callable[[Tensor], tuple[Tensor, Tensor]]] = {
    "tanh": _tanh,
    "sine": _sine,
    "sigmoid": _sigmoid,
    "relu": _relu,
}
"""Each activation and its derivative."""


@dataclass(frozen=True)
class Architecture:
    """The sizes of a `Network`."""

    nx: int
    """Number of states."""
    ny: int
    """Number of outputs."""
    depth: int = 9
    """Number of hidden layers."""
    width: int = 20
    """Neurons in each."""
    activation: Activation = "tanh"
    """Of the hidden layers; the last layer is linear."""
    dtype: Precision = "float32"
    """Precision of the weights and of everything computed with them."""

    def __post_init__(self) -> None:
        for name in ("nx", "ny", "depth", "width"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 1:
                raise ValueError(f"{name}={value!r}; expected a whole number of at least 1")
        for name, choices in (("activation", Activation), ("dtype", Precision)):
            value, known = getattr(self, name), get_args(choices)
            if value not in known:
                raise ValueError(f"{name}={value!r}; expected one of {', '.join(known)}")

    @property
    def torch_dtype(self) -> torch.dtype:
        """``dtype`` as torch names it."""
        return _DTYPES[self.dtype]


class Network(nn.Module):
    """A multilayer perceptron t ↦ (x̂(t), L(t)) (Farkane et al., PINN-Obs, "Proposed Adaptive
    PINN-Based Model").

    Its input is the time in s as it is, not scaled, as in the paper. The weights are drawn as
    Glorot & Bengio (2010) propose for tanh ("Xavier", normal), the biases begin at zero.

    Args:
        architecture: the sizes.
        generator: where the weights are drawn from; one of seed 0 if None, never torch's own.
    """

    def __init__(
        self, architecture: Architecture, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        generator = generator or torch.Generator().manual_seed(0)
        self.architecture = architecture
        last = architecture.nx * (1 + architecture.ny)
        sizes = [1] + [architecture.width] * architecture.depth + [last]
        dtype = architecture.torch_dtype
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for fan_in, fan_out in pairwise(sizes):
            weight = torch.empty(fan_out, fan_in, dtype=dtype)
            self.weights.append(nn.init.xavier_normal_(weight, generator=generator))
            self.biases.append(torch.zeros(fan_out, dtype=dtype))
        self._activation = _ACTIVATIONS[architecture.activation]

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Estimates x̂ (..., nx) in state units and gains L (..., nx, ny) at times t (...) in s."""
        *hidden, (weight, bias) = zip(self.weights, self.biases, strict=True)
        a = t[..., None]
        for W, b in hidden:
            a, _ = self._activation(nn.functional.linear(a, W, b))
        return self._split(nn.functional.linear(a, weight, bias))

    def with_rate(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What `forward` returns, and dx̂/dt (..., nx) in state units per s.

        The derivative is carried along through the layers (forward-mode differentiation by hand):
        one reverse pass then gives the gradient of a loss of all three, which is faster than
        differentiating twice in reverse.
        """
        *hidden, (weight, bias) = zip(self.weights, self.biases, strict=True)
        a = t[..., None]
        rate = torch.ones_like(a)
        for W, b in hidden:
            a, slope = self._activation(nn.functional.linear(a, W, b))
            rate = slope * nn.functional.linear(rate, W)
        xhat, L = self._split(nn.functional.linear(a, weight, bias))
        return xhat, L, nn.functional.linear(rate, weight[: self.architecture.nx])

    def _split(self, out: Tensor) -> tuple[Tensor, Tensor]:
        nx, ny = self.architecture.nx, self.architecture.ny
        return out[..., :nx], out[..., nx:].unflatten(-1, (nx, ny))
