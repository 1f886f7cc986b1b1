"""Spectral imaging: basis materials, decomposition of energy bins, virtual monochromatic images,
tissue maps; or the bins summed with weights.

Reading order: ``basis`` (two materials instead of an attenuation at every energy) → ``model``
(expected counts of a scanner behind them) → ``decompose`` with ``decompose_kernels`` (counts → line
integrals of the two). What is made of the two reconstructed images: ``vmi`` (one energy) and
``mmd`` (tissues). Without any of these: ``weighting`` (weights per bin that show one contrast best,
and one channel of line integrals).
"""

from typing import TYPE_CHECKING

from torchpcct.spectral.basis import Basis, pe_pvc
from torchpcct.spectral.decompose import (
    Decomposition,
    cramer_rao,
    decompose,
    decompose_exterior,
    decompose_scan,
    inverse,
)
from torchpcct.spectral.mmd import MMD_TISSUES, clean, label, mmd, nearest
from torchpcct.spectral.model import SpectralModel
from torchpcct.spectral.vmi import (
    VMI_ENERGIES_KEV,
    VmiCurve,
    vmi,
    vmi_curve,
    vmi_noise,
    vmi_weights,
)
from torchpcct.spectral.weighting import (
    BinWeights,
    bin_weights,
    contrast_information,
    weighting_gain,
)
from torchpcct.validate import now_called

__all__ = [
    "MMD_TISSUES",
    "VMI_ENERGIES_KEV",
    "Basis",
    "BinWeights",
    "Decomposition",
    "SpectralModel",
    "VmiCurve",
    "bin_weights",
    "clean",
    "contrast_information",
    "cramer_rao",
    "decompose",
    "decompose_exterior",
    "decompose_scan",
    "inverse",
    "label",
    "mmd",
    "nearest",
    "pe_pvc",
    "vmi",
    "vmi_curve",
    "vmi_noise",
    "vmi_weights",
    "weighting_gain",
]

if not TYPE_CHECKING:  # to mypy every name would exist

    def __getattr__(name: str) -> object:
        if former := now_called([name]):
            # Of an AttributeError the statement "from … import" would drop the text.
            raise ImportError(f"torchpcct.spectral has no {name}{former}")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
