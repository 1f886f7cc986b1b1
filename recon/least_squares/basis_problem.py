"""Joint model-based reconstruction of two basis images of a small inset from a spectral scan.

    Φ(x) = ½ Σ_rays (a − A x)ᵀ F (a − A x) + R(x),          a, x: two channels; F: 2 × 2 Fisher
    information of each ray

The line integrals of two basis materials, decomposed ray by ray, are strongly anticorrelated:
reconstructing each by itself throws away what one says about the other. F is the information matrix
of the decomposition (:class:`torchpcct.spectral.Decomposition`), R the q-GGMRF of both channels
(:mod:`recon.least_squares.qggmrf`).

The channels are mixed first so that the mean of F over the rays is a multiple of the identity
(:class:`Whitening`). In these coordinates noise is isotropic, which is what R needs, and AᵀFA is
nearly the same scalar operator in each channel: one FFT model (:class:`recon.gram.gram.Gram`) with
the weights ½ tr F serves as the preconditioner of all. What it leaves out (F's change from ray to
ray) the exact projections of :func:`recon.least_squares.pwls.pwls` repair.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Unpack

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from recon.analytic.inset import static_fbp
from recon.gram.gram import Gram
from recon.least_squares.exterior import length_unit
from recon.least_squares.pwls import PwlsOptions, mean_weights, pwls
from recon.least_squares.qggmrf import DEFAULT_PRIOR, QGGMRF
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import VolumeGrid
from torchpcct.projector import Projector
from torchpcct.scan import Scan
from torchpcct.spectral import SpectralModel, cramer_rao, decompose_exterior, inverse, vmi_weights
from torchpcct.validate import number

if TYPE_CHECKING:
    from torchpcct.typing import JsonObject

__all__ = ["BasisProblem", "Whitening"]


Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Whitening:
    """Mixes two channels into two of equal, uncorrelated noise.

    Attributes:
        forward: ``(2, 2)``: whitened = forward @ channels. Its first row is the gain that was asked
            for.
        backward: ``(2, 2)``, the inverse.
    """

    forward: Floats
    backward: Floats

    @classmethod
    def of(cls, information: ArrayLike, gain: ArrayLike) -> Whitening:
        """From the mean information of the channels.

        Args:
            information: ``(3,)`` F₁₁, F₁₂, F₂₂, positive definite.
            gain: ``(2,)`` combination of the channels that becomes the first whitened channel and
                sets the unit of both: e.g. HU per basis coefficient at one energy
                (:func:`torchpcct.spectral.vmi_weights`).

        Raises:
            ValueError: information that is not positive definite, a gain of 0, wrong shapes.
        """
        f, g = np.asarray(information, np.float64), np.asarray(gain, np.float64)
        if (
            f.shape != (3,)
            or g.shape != (2,)
            or not (np.isfinite(f).all() and np.isfinite(g).all())
        ):
            raise ValueError(
                f"information must hold 3, gain 2 finite numbers, got {information!r} and {gain!r}"
            )
        if not (f[0] > 0 and f[2] > 0 and f[0] * f[2] > f[1] ** 2):
            raise ValueError(
                f"information must be positive definite, packed as F11, F12, F22, got {f}"
            )
        if not g.any():
            raise ValueError("gain must not be 0")
        covariance = np.linalg.inv([[f[0], f[1]], [f[1], f[2]]])
        toward = covariance @ g
        other = np.array([-toward[1], toward[0]])  # uncorrelated with the first
        other *= np.sqrt((g @ toward) / (other @ covariance @ other))
        forward = np.stack([g, other])
        return cls(forward, np.linalg.inv(forward))

    def apply(self, channels: Tensor) -> Tensor:
        """Whitened channels, ``(..., 2, *shape)`` with 3 trailing axes."""
        return _mix(self.forward, channels)

    def undo(self, whitened: Tensor) -> Tensor:
        """The channels, ``(..., 2, *shape)`` with 3 trailing axes."""
        return _mix(self.backward, whitened)

    def information(self, packed: Tensor) -> Tensor:
        """Information ``(3, ...)`` of the channels → of the whitened channels."""
        (a, b), (c, d) = self.backward
        f11, f12, f22 = packed
        return torch.stack(
            [
                a * a * f11 + 2 * a * c * f12 + c * c * f22,
                a * b * f11 + (a * d + b * c) * f12 + c * d * f22,
                b * b * f11 + 2 * b * d * f12 + d * d * f22,
            ]
        )


def _mix(matrix: Floats, x: Tensor) -> Tensor:
    if x.ndim < 4 or x.shape[-4] != 2:
        raise ValueError(f"expected two channels (..., 2, n, n, n), got the shape {tuple(x.shape)}")
    first, second = x.unbind(-4)
    (a, b), (c, d) = matrix.tolist()
    return torch.stack([a * first + b * second, c * first + d * second], dim=-4)


REFERENCE_KEV = 52.0
"""The prior's gradients are in HU of the virtual monochromatic image at this energy, the best one
for a necrotic core in Li et al.; whatever else the two basis images hold counts in units of equal
noise."""


class BasisProblem:
    """What all realisations of one spectral scan on one grid share: weights, projector, FFT model,
    background.

    Args:
        scan: windowed spectral scan; its noise does not matter.
        model: of its scanner and exposure.
        grid: ``(z, y, x)`` grid that holds everything the exterior does not.

    The Fisher information of every ray is that of the expected counts behind the EXTERIOR:
    information from the noisy counts would bias the result, and a small inset changes it by a few
    per cent only.

    Raises:
        ValueError: a scan without energy bins or without window, a model of another scanner or
            exposure, a grid outside the field of view or the scan's window.
    """

    def __init__(self, scan: Scan, model: SpectralModel, grid: VolumeGrid) -> None:
        background = decompose_exterior(scan, model)
        scale = torch.from_numpy(model.row_factor)[:, None]
        information = inverse(cramer_rao(background.double(), model, scale=scale))
        self.grid, self.geometry = grid, scan.geometry
        self.window = footprint(scan.geometry, grid, margin=1)
        self.background = background
        self.level = static_fbp(background, scan.geometry, grid).double().mean((-1, -2, -3))
        on_rays = self.window.take(information)
        gain = vmi_weights(model.basis, [REFERENCE_KEV])[0][0]
        self.whitening = Whitening.of(on_rays.mean((-1, -2, -3)).numpy(), gain)
        self.information = self.whitening.information(on_rays).to(torch.float32).contiguous()
        self.projector = Projector(scan.geometry, grid, self.window)
        self.gram = Gram(self.projector, mean_weights(self.information), nodes=5)

    @property
    def anisotropy(self) -> float:
        """Root mean square of F / (½ tr F) − 1 over the rays: what the FFT model leaves out, 0
        for equal noise."""
        f11, f12, f22 = (v.double() for v in self.information)
        mean = 0.5 * (f11 + f22)
        return float(((((f11 - f22) / 2).square() + f12.square()) / mean.square()).mean().sqrt())

    def data(self, lines: Tensor, window: DetectorWindow) -> Tensor:
        """Whitened line integrals on the grid's footprint, background taken off, ``(..., 2, views,
        rows, columns)``.

        Args:
            lines: ``(..., 2, views, rows, columns)`` in mm on ``window``.
            window: of the data; it must hold the grid's footprint.
        """
        inside = window.crop(lines, self.window)
        return self.whitening.apply(inside - self.window.take(self.background.to(lines.dtype)))

    def solve(
        self,
        lines: Tensor,
        window: DetectorWindow,
        prior: QGGMRF | None = None,
        *,
        dose: float = 1.0,
        **options: Unpack[PwlsOptions],
    ) -> tuple[Tensor, JsonObject]:
        """Basis images.

        Args:
            lines, window: decomposed line integrals, see :meth:`data`.
            prior: None: :data:`recon.least_squares.qggmrf.DEFAULT_PRIOR` in the length unit of the
                scan, as for :class:`recon.least_squares.inset_problem.InsetProblem`.
            dose: of the data relative to the model's exposure; it scales the information.
            options: of :func:`recon.least_squares.pwls.pwls`.

        Returns:
            ``(..., 2, z, y, x)`` basis coefficients (dimensionless), and the solver's report.

        Raises:
            ValueError: shapes that do not fit, ``dose`` ≤ 0.
        """
        number("dose", dose, positive=True, unit="of the model's exposure")
        prior = prior or DEFAULT_PRIOR.stretched(length_unit(self.geometry), self.grid.ndim)
        result = pwls(
            self.projector,
            self.data(lines, window),
            self.information * dose,
            prior,
            mu_per_hu=1.0,
            gram=self.gram.scaled(dose),
            **options,
        )
        images = self.whitening.undo(result.volume) + self.level.to(lines.dtype).reshape(2, 1, 1, 1)
        return images, {**result.report, "method": "joint-pwls"}
