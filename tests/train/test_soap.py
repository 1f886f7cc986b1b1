"""The optimiser SOAP against a dense reckoning of its definition, and where it must do what Adam
does or what Newton's method would."""

import pytest
import torch
from torch import nn

from train import soap
from train.soap import Soap

RATE = 1e-2


def _steps(make, gradients, start):
    """The tensor after a step with each gradient."""
    p = nn.Parameter(start.clone())
    optimiser = make([p])
    for g in gradients:
        p.grad = g.clone()
        optimiser.step()
    return p.detach()


def _adam(params):
    return torch.optim.Adam(
        params, lr=RATE, betas=(soap.MEAN_DECAY, soap.SQUARE_DECAY), eps=soap._LEAST
    )


def _random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_a_vector_is_treated_as_adam_does():
    gradients = [_random(7, seed=k) for k in range(25)]
    start = _random(7, seed=99)
    torch.testing.assert_close(
        _steps(lambda p: Soap(p, RATE), gradients, start), _steps(_adam, gradients, start)
    )


def test_axes_that_are_too_long_are_treated_as_adam_does(monkeypatch):
    monkeypatch.setattr(soap, "LARGEST_AXIS", 3)
    gradients = [_random(5, 4, seed=k) for k in range(25)]
    start = _random(5, 4, seed=99)
    torch.testing.assert_close(
        _steps(lambda p: Soap(p, RATE), gradients, start), _steps(_adam, gradients, start)
    )


def test_a_kernel_by_the_definition():
    """Adam on the gradient's coordinates, Kronecker products written out."""
    gradients = [_random(4, 3, 2, 2, 2, seed=k) for k in range(soap.REFRESHED_EVERY - 1)]
    start = _random(4, 3, 2, 2, 2, seed=99)
    found = _steps(lambda p: Soap(p, RATE), gradients, start)
    first = gradients[0].flatten(2)
    vectors = []
    for axis in range(3):
        rows = torch.movedim(first, axis, 0).flatten(1)
        vectors.append(torch.linalg.eigh((1 - soap.SQUARE_DECAY) * (rows @ rows.T))[1].flip(1))
    whole = torch.kron(torch.kron(vectors[0], vectors[1]), vectors[2])
    seen = [(whole.T @ g.flatten()) for g in gradients]
    expected = whole @ _steps(_adam, seen, torch.zeros(len(whole), dtype=torch.float64))
    torch.testing.assert_close(found.flatten(), start.flatten() + expected)


def test_basis_follows_the_covariance():
    """After many steps with gradients of one covariance its eigenvectors are the basis."""
    left, right = (torch.linalg.qr(_random(5, 5, seed=s)).Q for s in (1, 2))
    sizes = torch.tensor([16.0, 8.0, 4.0, 2.0, 1.0], dtype=torch.float64)
    p = nn.Parameter(torch.zeros(5, 5, dtype=torch.float64))
    optimiser = Soap([p], RATE)
    for k in range(400):
        p.grad = left @ (sizes[:, None] * _random(5, 5, seed=10 + k)) @ right.T
        optimiser.step()
    basis = optimiser.state[p]["basis_0"]
    torch.testing.assert_close(basis.T @ basis, torch.eye(5, dtype=torch.float64))
    assert float((left.T @ basis).abs().diagonal().min()) > 0.98


def test_ill_conditioned_problem_that_adam_does_not_solve():
    """Least squares whose steep and flat directions are mixtures of the weights."""
    left, right = (torch.linalg.qr(_random(8, 8, seed=s)).Q for s in (1, 2))
    scale = torch.logspace(0, -2, 8, dtype=torch.float64)
    a, b = left * scale @ left.T, right * scale @ right.T
    target = left @ _random(8, 8, seed=3) @ right.T
    losses = {}
    for name, make in (("soap", lambda p: Soap(p, RATE)), ("adam", _adam)):
        p = nn.Parameter(torch.zeros(8, 8, dtype=torch.float64))
        optimiser = make([p])
        for k in range(600):
            optimiser.param_groups[0]["lr"] = RATE * (1 - k / 600)
            optimiser.zero_grad()
            (a @ (p - target) @ b).square().sum().backward()
            optimiser.step()
        losses[name] = float((p.detach() - target).square().mean().sqrt())
    assert losses["soap"] < 0.5 * losses["adam"]


def test_tensors_without_a_gradient_stay():
    p = nn.Parameter(torch.ones(3, 3))
    Soap([p], RATE).step()
    assert torch.equal(p.detach(), torch.ones(3, 3))


@pytest.mark.parametrize("shape", [(3, 1, 1, 1, 1), (1, 4), (6, 5, 3, 3, 3)])
def test_gradients_of_zero_move_nothing(shape):
    zero = torch.zeros(shape, dtype=torch.float64)
    found = _steps(lambda p: Soap(p, RATE), [zero] * 25, zero + 1)
    assert torch.equal(found, zero + 1)


def test_a_copy_of_the_state_goes_on_with_the_same_bits():
    """As a checkpoint keeps it, of a kernel in the layout that processors convolve fastest in."""
    gradients = [
        _random(6, 5, 3, 3, 3, seed=k).float().to(memory_format=torch.channels_last_3d)
        for k in range(2 * soap.REFRESHED_EVERY)
    ]

    def kernel(values):
        return nn.Parameter(values.clone(memory_format=torch.channels_last_3d))

    p = kernel(torch.ones(6, 5, 3, 3, 3))
    optimiser = Soap([p], RATE)
    for k, g in enumerate(gradients):
        p.grad = g
        optimiser.step()
        if k == soap.REFRESHED_EVERY + 2:
            q = kernel(p.detach())
            other = Soap([q], RATE)
            known = {name: value.contiguous().clone() for name, value in optimiser.state[p].items()}
            other.load_state_dict({**other.state_dict(), "state": {0: known}})
    for g in gradients[soap.REFRESHED_EVERY + 3 :]:
        q.grad = g
        other.step()
    assert torch.equal(p, q)
