"""Base class of operators: ``A @ x``, ``A.H``, ``A.norm()``, and conversion to SciPy, PyLops and deepinv."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator

__all__ = ["Operator"]


class Operator(nn.Module):
    """A linear operator with a matched adjoint ``T``, between ``domain_shape`` and ``range_shape``."""

    @property
    def domain_shape(self) -> tuple[int, ...]:
        """Shape of one input."""
        raise NotImplementedError

    @property
    def range_shape(self) -> tuple[int, ...]:
        """Shape of one output."""
        raise NotImplementedError

    @property
    def T(self) -> Operator:
        """The adjoint operator."""
        raise NotImplementedError

    @property
    def H(self) -> Operator:
        """The adjoint operator; all weights are real, so it is ``A.T``."""
        return self.T

    def __matmul__(self, x: Tensor) -> Tensor:
        return cast(Tensor, self(x))

    def norm(self, tolerance: float = 1e-4, most: int = 200) -> float:
        """Largest singular value, by power iteration on AᵀA in float32; kept after the first call.

        Args:
            tolerance: stop when the value grows by less than this share in one iteration. It is approached from
                below.
            most: largest number of iterations, one pass in either direction each.
        """
        kept = self.__dict__.get("_norm")
        if kept is None or kept[0] > tolerance:
            # A constant start is near the largest eigenvector, and the noise keeps it from being orthogonal to it.
            noise = torch.rand(self.domain_shape, generator=torch.Generator().manual_seed(0))
            x, value = 1 + noise, 0.0
            for _ in range(most):
                x = x / x.norm().clamp_min(torch.finfo(x.dtype).tiny)
                with torch.no_grad():
                    y = self(x)
                    x = self.T(y)
                before, value = value, float(y.norm())
                if value <= before * (1 + tolerance):
                    break
            kept = self.__dict__["_norm"] = (tolerance, value)
        return cast(float, kept[1])

    def as_scipy(self, dtype: Any = np.float32) -> LinearOperator:
        """A :class:`scipy.sparse.linalg.LinearOperator` on flattened arrays, for SciPy's solvers.

        Args:
            dtype: float32 or float64, in which it computes.

        Raises:
            TypeError: another dtype.
        """
        from scipy.sparse.linalg import LinearOperator

        if np.dtype(dtype) not in (np.dtype(np.float32), np.dtype(np.float64)):
            raise TypeError(f"dtype must be float32 or float64, got {dtype!r}")

        def columns(operator: Operator, values: Any) -> Any:
            # Columns of a matrix are a batch.
            batch = np.ascontiguousarray(np.asarray(values, dtype=dtype).reshape(values.shape[0], -1).T)
            with torch.no_grad():
                out = operator(torch.from_numpy(batch).reshape(-1, *operator.domain_shape))
            return out.reshape(len(batch), -1).numpy().T.reshape(-1, *values.shape[1:])

        return LinearOperator(
            (math.prod(self.range_shape), math.prod(self.domain_shape)),
            matvec=lambda x: columns(self, x),
            rmatvec=lambda y: columns(self.T, y),
            matmat=lambda x: columns(self, x),
            rmatmat=lambda y: columns(self.T, y),
            dtype=dtype,
        )

    def as_pylops(self, dtype: Any = np.float32) -> Any:
        """A ``pylops.LinearOperator`` on flattened arrays; see :meth:`as_scipy`.

        Raises:
            ModuleNotFoundError: PyLops is not installed.
        """
        import pylops

        return pylops.aslinearoperator(self.as_scipy(dtype))

    def as_deepinv(self) -> Any:
        """A ``deepinv.physics.LinearPhysics``: differentiable, on batches ``(batch, …, *shape)``.

        Raises:
            ModuleNotFoundError: deepinv is not installed.
        """
        from deepinv.physics import LinearPhysics

        return LinearPhysics(A=lambda x, **_: self(x), A_adjoint=lambda y, **_: self.T(y))
