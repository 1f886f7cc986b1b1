"""Linear operators: what a data term is to solvers."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor

__all__ = ["NormalOperator"]


@runtime_checkable
class NormalOperator(Protocol):
    """AᵀWA of a scan, exact or a model of it: all that PWLS and MBIR ask of the data beside AᵀW y.

    Of an inset it is :class:`recon.gram.gram.Gram`, of a whole field
    :class:`recon.mbir.field.FieldGram`.
    """

    def apply(self, x: Tensor, /) -> Tensor:
        """AᵀWA x, ``(..., *grid.shape)``."""
        ...

    def periodic_spectrum(self) -> Tensor:
        """Eigenvalues of a circulant approximation on the frequencies of ``rfftn``."""
        ...

    def information(self, mu_per_hu: float, frequency: float = ...) -> float:
        """On a wave of ``frequency`` lp/mm (0.5), 1/(HU² mm³) (2-D: mm²); ``mu_per_hu`` is 1 HU
        in mm⁻¹."""
        ...
