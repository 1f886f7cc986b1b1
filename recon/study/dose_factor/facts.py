"""What holds of a scene of the study without sampling error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["SceneFacts", "fbp_label"]

Floats = NDArray[np.float64]


def fbp_label(kernel: str, voxel_mm: float, blur_mm: float = 0.0) -> str:
    """Name of an FBP variant."""
    return f"{kernel} {voxel_mm:.2f} mm" + (f" + {blur_mm:.2f} mm Gauss" if blur_mm else "")


@dataclass(frozen=True)
class SceneFacts:
    """What holds without sampling error, at 1 s.

    Attributes:
        statistic: ``(z, y, x)`` AᵀW y of the noise-free scan.
        tissues: names; amplitudes_hu: their values as the scanner sees them (generalised least squares on exact path
            lengths of the noise-free scan), ``(tissues,)``; information: ``(tissues, tissues)`` HU⁻².
        reference_hu: ROI means of noise-free standard FBP on 0.1 mm, ``(2,)``.
        labels: FBP variants; fbp_hu: their ROI means ``(variants, 2)``; fbp_covariance: label → ``(F, F)`` HU² of the
            ROI means and, where they were asked for, of the observer's channels; fbp_crop: label → image of the core.
    """

    statistic: NDArray[np.float32]
    tissues: list[str]
    amplitudes_hu: Floats
    information: Floats
    reference_hu: Floats
    labels: list[str]
    fbp_hu: Floats
    fbp_covariance: dict[str, Floats]
    fbp_crop: dict[str, Any]

    def tissue(self, name: str) -> int:
        """Index of a tissue."""
        return self.tissues.index(name)

    @property
    def contrast_hu(self) -> float:
        """True contrast, fibrous tissue minus core, HU."""
        return float(self.amplitudes_hu[self.tissue("fibrous")] - self.amplitudes_hu[self.tissue("core")])

    @property
    def truth_hu(self) -> Floats:
        """``(foreground, background)``."""
        return self.amplitudes_hu[[self.tissue("core"), self.tissue("fibrous")]]

    def fbp_contrast(self, label: str) -> float:
        """Noise-free contrast of an FBP variant, HU."""
        fg, bg = self.fbp_hu[self.labels.index(label)]
        return float(bg - fg)

    @classmethod
    def of(cls, arrays: dict[str, Any]) -> SceneFacts:
        """From the arrays of a piece."""

        def all_of(prefix: str) -> dict[str, Any]:
            return {k[len(prefix) :]: v for k, v in arrays.items() if k.startswith(prefix)}

        return cls(
            statistic=arrays["statistic"],
            tissues=[str(t) for t in arrays["tissues"]],
            amplitudes_hu=arrays["amplitudes_hu"],
            information=arrays["information"],
            reference_hu=arrays["reference_hu"],
            labels=[str(v) for v in arrays["labels"]],
            fbp_hu=arrays["fbp_hu"],
            fbp_covariance=all_of("covariance "),
            fbp_crop=all_of("crop "),
        )
