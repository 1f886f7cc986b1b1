"""SOAP: Adam in the eigenbasis of Shampoo's factors (Vyas et al. 2024, arXiv:2409.11321, algorithm
3).

Adam gives every single weight a step of its own. The directions along which a loss is steep or flat
are mixtures of weights, and a learning rate that the steep ones bear is too small for the flat
ones. So the gradient of a layer is seen in a basis in which its entries are hardly correlated, that
of its covariances along each of its axes, and Adam works there.

A kernel of a convolution has three axes, outputs, inputs and places: the largest covariance of the
packaged networks is 40 x 40, and a step of theirs takes 13 ms on one core of a CPU.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

__all__ = ["Soap"]

MEAN_DECAY = 0.95
"""Of the mean of gradients."""
SQUARE_DECAY = 0.995
"""Of their mean square in the basis, and of the covariances that the basis is of."""
REFRESHED_EVERY = 10
"""Steps from one refinement of the basis to the next."""
LARGEST_AXIS = 1024
"""Axes with more entries keep their own basis: the cost of another grows with their cube."""
_LEAST = 1e-8
"""Added to the root of the mean square."""


class Soap(Optimizer):
    """Adam in a slowly turning basis.

    Args:
        params: tensors, or groups of them.
        lr: learning rate, about that of Adam.
    """

    def __init__(self, params: Iterable[Any], lr: float = 1e-3) -> None:
        super().__init__(params, {"lr": lr})

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """Change the tensors that have a gradient."""
        for group in self.param_groups:
            for p in group["params"]:
                if p.grad is not None:
                    direction = self._direction(p, _by_axes(p.grad))
                    p.add_(direction.reshape(p.shape), alpha=-group["lr"])

    def _direction(self, p: Tensor, gradient: Tensor) -> Tensor:
        """What a learning rate of 1 would take off ``p``, in the shape of ``gradient``."""
        state = self.state[p]
        if not state:
            state["step"] = torch.zeros(())
            state["mean"], state["square"] = torch.zeros_like(gradient), torch.zeros_like(gradient)
            for axis in _turned(gradient):
                n = gradient.shape[axis]
                state[f"covariance_{axis}"] = gradient.new_zeros(n, n)
        state["step"] += 1
        count = int(state["step"])
        for axis in _turned(gradient):
            rows = torch.movedim(gradient, axis, 0).flatten(1)
            state[f"covariance_{axis}"].lerp_(rows @ rows.T, 1.0 - SQUARE_DECAY)
            if count == 1:
                found = torch.linalg.eigh(state[f"covariance_{axis}"]).eigenvectors
                state[f"basis_{axis}"] = found.flip(1).contiguous()
            elif count % REFRESHED_EVERY == 0:
                _refine(state, axis)
        bases = {axis: state[f"basis_{axis}"] for axis in _turned(gradient)}
        state["mean"].lerp_(gradient, 1.0 - MEAN_DECAY)
        state["square"].lerp_(_along(gradient, bases).square(), 1.0 - SQUARE_DECAY)
        mean = _along(state["mean"], bases) / (1.0 - MEAN_DECAY**count)
        size = (state["square"] / (1.0 - SQUARE_DECAY**count)).sqrt() + _LEAST
        return _along(mean / size, {axis: basis.T for axis, basis in bases.items()})


def _by_axes(gradient: Tensor) -> Tensor:
    """The places of a kernel as one axis, ``(outputs, inputs, places)``."""
    return (gradient.flatten(2) if gradient.dim() > 3 else gradient).contiguous()


def _turned(gradient: Tensor) -> list[int]:
    """Axes with a basis of their own. A vector has none: there it is plain Adam."""
    if gradient.dim() < 2:
        return []
    return [axis for axis, n in enumerate(gradient.shape) if 1 < n <= LARGEST_AXIS]


def _refine(state: dict[str, Tensor], axis: int) -> None:
    """One step of orthogonal iteration; entries of the mean square stay with their directions."""
    covariance, basis = state[f"covariance_{axis}"], state[f"basis_{axis}"]
    sizes = (basis * (covariance @ basis)).sum(0)
    order = sizes.argsort(descending=True, stable=True)
    state["square"] = state["square"].index_select(axis, order)
    # In the order in which a checkpoint keeps it: products with another have other last digits.
    state[f"basis_{axis}"] = torch.linalg.qr(covariance @ basis[:, order]).Q.contiguous()


def _along(values: Tensor, bases: dict[int, Tensor]) -> Tensor:
    """Coordinates of ``values`` in a basis, whose vectors are columns, along each axis."""
    for axis, basis in bases.items():
        values = torch.movedim(torch.tensordot(values, basis, dims=([axis], [0])), -1, axis)
    return values
