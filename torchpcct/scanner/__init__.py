"""Scanners: tube, filters, bowties, detectors and presets.

Reading order, along the beam: ``source`` (spectrum) → ``filters`` (slabs, bowties) → ``detector``
(what a photon leaves in each bin, with ``compton``) → ``scanner``, which puts them together with a
geometry; ``presets`` are the paper's two. What a scanner makes of its readings: ``pileup`` and
``linearisation`` (water correction). ``silicon_transport`` follows single photons as a reference
for the silicon detector; its ``TransportedSilicon`` counts what they do.
"""

from torchpcct.scanner import presets
from torchpcct.scanner.detector import Detector, Scintillator, SiliconDetector
from torchpcct.scanner.filters import Bowtie, large_bowtie, roi_bowtie
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.scanner.scanner import Scanner
from torchpcct.scanner.silicon_transport import TransportedSilicon
from torchpcct.scanner.source import Source, Spectrum

__all__ = [
    "Bowtie",
    "Detector",
    "Scanner",
    "Scintillator",
    "SiliconDetector",
    "Source",
    "Spectrum",
    "TransportedSilicon",
    "WaterLinearisation",
    "large_bowtie",
    "presets",
    "roi_bowtie",
]
