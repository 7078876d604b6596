"""Adam on tensors moves parameters as torch's does, to the last bit."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from trainers.adam import Adam

RATES = [0.1, 0.03, 0.2, 0.01, 0.05]


def parameters(dtype):
    generator = torch.Generator().manual_seed(0)
    shapes = [(3, 2), (3,), (1, 3)]
    drawn = [torch.randn(shape, generator=generator, dtype=torch.float64) for shape in shapes]
    return [each.to(dtype).requires_grad_() for each in drawn]


def loss(W, b, V):
    return (V @ torch.tanh(W @ torch.ones(2, dtype=W.dtype) + b)).square().sum() + W.pow(4).sum()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_its_steps_are_torchs(dtype):
    own, theirs = parameters(dtype), parameters(dtype)
    mine, peer = Adam(own), torch.optim.Adam(theirs, foreach=False)
    for rate in RATES:
        mine.clear()
        loss(*own).backward()
        mine.step(rate)
        peer.param_groups[0]["lr"] = rate
        peer.zero_grad()
        loss(*theirs).backward()
        peer.step()
    for a, b in zip(own, theirs, strict=True):
        assert torch.equal(a, b)


def test_a_resumed_minimisation_goes_on_as_before():
    whole = parameters(torch.float64)
    first = Adam(whole)

    def go_on(adam, moved, rates):
        for rate in rates:
            adam.clear()
            loss(*moved).backward()
            adam.step(rate)

    go_on(first, whole, RATES[:2])
    state = first.state()
    again = [p.detach().clone().requires_grad_() for p in whole]
    go_on(first, whole, RATES[2:])
    second = Adam(again)
    second.load_state(state)
    go_on(second, again, RATES[2:])
    for a, b in zip(whole, again, strict=True):
        np.testing.assert_array_equal(a.detach().numpy(), b.detach().numpy())


def test_a_parameter_on_which_the_loss_does_not_depend_stays():
    used, unused = torch.ones(2, requires_grad=True), torch.ones(2, requires_grad=True)
    adam = Adam([used, unused])
    used.sum().backward()
    adam.step(0.5)
    np.testing.assert_allclose(used.detach(), [0.5, 0.5], rtol=1e-6)  # the first step has this size
    assert unused.tolist() == [1, 1]


def test_no_compiler_is_loaded_for_it():
    program = (
        "import sys, torch; from trainers.adam import Adam; p = torch.ones(1, requires_grad=True);"
        "p.sum().backward(); Adam([p]).step(0.1); assert 'torch._dynamo' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
