"""Scanners: tube, filters, bowties, detectors and presets."""

from torchpcct.scanner import presets
from torchpcct.scanner.detector import Detector, Scintillator, SiliconDetector
from torchpcct.scanner.filters import Bowtie, large_bowtie, roi_bowtie
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.scanner.scanner import Scanner
from torchpcct.scanner.source import Source, Spectrum

__all__ = [
    "Bowtie",
    "Detector",
    "Scanner",
    "Scintillator",
    "SiliconDetector",
    "Source",
    "Spectrum",
    "WaterLinearisation",
    "large_bowtie",
    "presets",
    "roi_bowtie",
]
