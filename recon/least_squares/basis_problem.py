"""Joint model-based reconstruction of two basis images of a small inset from a spectral scan."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from recon.analytic.inset import static_fbp
from recon.gram.gram import Gram
from recon.least_squares.joint import joint_pwls, mean_weights
from recon.least_squares.qggmrf import DEFAULT_PRIOR, QGGMRF
from recon.least_squares.whitening import Whitening
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import VolumeGrid
from torchpcct.projector import Projector
from torchpcct.scan import Scan
from torchpcct.spectral import SpectralModel, cramer_rao, decompose_surround, inverse, vmi_weights
from torchpcct.validate import number

__all__ = ["REFERENCE_KEV", "BasisProblem"]

REFERENCE_KEV = 52.0
"""The prior's gradients are in HU of the virtual monochromatic image at this energy, the best one for a necrotic core
in Li et al.; whatever else the two basis images hold counts in units of equal noise."""


class BasisProblem:
    """What all realisations of one spectral scan on one grid share: weights, projector, FFT model, background.

    Args:
        scan: windowed spectral scan; its noise does not matter.
        model: of its scanner and exposure.
        grid: ``(z, y, x)`` grid that holds everything the surround does not.
        nodes: of the FFT model (:class:`recon.gram.gram.Gram`).

    The Fisher information of every ray is that of the expected counts behind the SURROUND: information from the noisy
    counts would bias the result, and a small inset changes it by a few per cent only.

    Raises:
        ValueError: a scan without energy bins or without window, a model of another scanner or exposure, a grid
            outside the field of view or the scan's window.
    """

    def __init__(self, scan: Scan, model: SpectralModel, grid: VolumeGrid, nodes: int = 5) -> None:
        background = decompose_surround(scan, model)
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
        self.gram = Gram(self.projector, mean_weights(self.information), nodes=nodes)

    @property
    def anisotropy(self) -> float:
        """Root mean square of F / (½ tr F) − 1 over the rays: what the FFT model leaves out, 0 for equal noise."""
        f11, f12, f22 = (v.double() for v in self.information)
        mean = 0.5 * (f11 + f22)
        return float(((((f11 - f22) / 2).square() + f12.square()) / mean.square()).mean().sqrt())

    def data(self, lines: Tensor, window: DetectorWindow) -> Tensor:
        """Whitened line integrals on the grid's footprint, background taken off, ``(..., 2, views, rows, columns)``.

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
        tolerance: float = 0.2,
        max_exact: int = 20,
    ) -> tuple[Tensor, dict[str, Any]]:
        """Basis images.

        Args:
            lines, window: decomposed line integrals, see :meth:`data`.
            prior: None: :data:`recon.least_squares.qggmrf.DEFAULT_PRIOR`.
            dose: of the data relative to the model's exposure; it scales the information.
            tolerance, max_exact: of :func:`recon.least_squares.joint.joint_pwls`.

        Returns:
            ``(..., 2, z, y, x)`` basis coefficients (dimensionless), and the solver's report.

        Raises:
            ValueError: shapes that do not fit, ``dose`` ≤ 0.
        """
        number("dose", dose, positive=True, unit="of the model's exposure")
        result = joint_pwls(
            self.projector, self.data(lines, window), self.information * dose, prior or DEFAULT_PRIOR,
            gram=self.gram.scaled(dose), tolerance=tolerance, max_exact=max_exact,
        )  # fmt: skip
        images = self.whitening.undo(result.x) + self.level.to(lines.dtype).reshape(2, 1, 1, 1)
        return images, dict(result.report)
