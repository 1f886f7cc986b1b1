"""The q-GGMRF of several images at once: the potential acts on the length of their common gradient.

    R(x) = λ V Σ_{pairs} ω_d ρ(|x_j − x_k| / (hu d)),      |·| Euclidean over the channels.

One edge in one channel relaxes the penalty of all channels there: basis images share the edges of the tissues
(vectorial regularisation, Sapiro and Ringach 1996; for spectral CT Rigie and La Rivière 2015). The Euclidean length
treats all directions in the space of channels alike, so the channels must be of equal, uncorrelated noise: see
:class:`recon.pwls.joint.Whitening`. Formula of ρ and its units: :mod:`recon.pwls.qggmrf`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.pwls.qggmrf import QGGMRF, BoundPrior, _pair

__all__ = ["JointPrior"]


@dataclass(frozen=True)
class JointPrior(BoundPrior):
    """A vectorial q-GGMRF energy of images ``(..., channels, *grid.shape)``.

    Args:
        lam, threshold, p, q, neighbors: see :class:`recon.pwls.qggmrf.BoundPrior`.
        spacing: 1 for the axis of channels, which has no neighbours, then the voxel size per axis in mm.
        hu: the value of the channels that counts as 1 HU.
    """

    _KERNELS: ClassVar[str] = "recon.pwls.joint_kernels"

    def __post_init__(self) -> None:
        if len(self.spacing) not in (3, 4) or self.spacing[0] != 1.0:
            raise ValueError(f"spacing must be 1 (channels) and 2 or 3 lengths in mm, got {self.spacing}")
        self._spatial  # validates the rest  # noqa: B018

    @classmethod
    def bind(cls, prior: QGGMRF, information: float, spacing: Any, hu: float) -> JointPrior:
        """A prior in noise-normalised units, for channels that all have the same ``information`` (see `QGGMRF.bind`).

        Args:
            prior: strength, threshold and form.
            information: of each channel at 0.5 lp/mm, in 1/(HU² mm³).
            spacing: voxel size per axis in mm.
            hu: the value of the channels that counts as 1 HU.
        """
        b = prior.bind(information, spacing, hu)
        return cls(b.lam, b.threshold, b.p, b.q, b.neighbors, (1.0, *b.spacing), b.hu)

    @property
    def _spatial(self) -> BoundPrior:
        return BoundPrior(self.lam, self.threshold, self.p, self.q, self.neighbors, self.spacing[1:], self.hu)

    @property
    def offsets(self) -> tuple[tuple[tuple[int, ...], float, float], ...]:
        """Half of the neighbours: (index offset with 0 for the channels, distance in mm, ω)."""
        return tuple(((0, *step), d, omega) for step, d, omega in self._spatial.offsets)

    def gradients(self, x: Tensor) -> list[Tensor]:
        """Length of the gradient of every pair in HU/mm, ``(..., 1, *pairs)``, one tensor per entry of `offsets`."""
        self._check(x)
        out = []
        for step, d, _ in self.offsets:
            a, b = _pair(x, step)
            out.append(torch.linalg.vector_norm(a - b, dim=-len(step), keepdim=True) / (self.hu * d))
        return out

    def _volumes(self, x: Tensor) -> NDArray[Any]:
        """``(batch, channels, nz, ny, nx)`` contiguous."""
        channels, *shape = x.shape[-len(self.spacing) :]
        return x.detach().reshape(-1, channels, *(1,) * (3 - len(shape)), *shape).contiguous().numpy()

    def _tables(self, dtype: Any, both: bool) -> tuple[Any, ...]:
        return self._spatial._tables(dtype, both)
