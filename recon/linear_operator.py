"""Linear operators: what a data term is to solvers, and one autograd function for all that are given with their exact
transpose."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

__all__ = ["NormalOperator", "apply_linear"]

Linear = Callable[[Tensor], Tensor]


@runtime_checkable
class NormalOperator(Protocol):
    """AᵀWA of a scan, exact or a model of it: all that PWLS and MBIR ask of the data beside AᵀW y.

    Of an inset it is :class:`recon.gram.gram.Gram`, of a whole field :class:`recon.mbir.field.FieldGram`.
    """

    def apply(self, x: Tensor, /) -> Tensor:
        """AᵀWA x, ``(..., *grid.shape)``."""
        ...

    def periodic_spectrum(self) -> Tensor:
        """Eigenvalues of a circulant approximation on the frequencies of ``rfftn``."""
        ...

    def information(self, mu_per_hu: float) -> float:
        """On a wave of 0.5 lp/mm, 1/(HU² mm³) (2-D: mm²); ``mu_per_hu`` is 1 HU in mm⁻¹."""
        ...


class _Linear(torch.autograd.Function):
    """``forward(x)``; its gradient is ``transpose``, whose gradient is ``forward`` again (any order)."""

    @staticmethod
    def forward(x: Tensor, forward: Linear, transpose: Linear) -> Tensor:
        if x.device.type == "cpu":
            return forward(x)
        return forward(x.cpu()).to(x.device)  # the kernels are CPU code

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _, ctx.forward_map, ctx.transpose_map = inputs

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        return _Linear.apply(gradients[0], ctx.transpose_map, ctx.forward_map), None, None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        return _Linear.apply(tangents[0], ctx.forward_map, ctx.transpose_map)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], x: Tensor, forward: Linear, transpose: Linear) -> tuple[Tensor, int]:
        return _Linear.apply(x.movedim(in_dims[0], 0), forward, transpose), 0


def apply_linear(x: Tensor, forward: Linear, transpose: Linear) -> Tensor:
    """``forward(x)`` with gradients of any order; both maps take and keep leading batch dimensions."""
    return _Linear.apply(x, forward, transpose)
