"""The coronary plaque of the paper and variants of it, in which a learned prior may show structures
that are not there.

Read :mod:`~torchpcct.scene.plaque.plaque` (geometry and scene), then
:mod:`~torchpcct.scene.plaque.variants` (without a core, moved, mirrored, calcified, stented,
textured …).
"""

from torchpcct.scene.plaque.plaque import (
    PAPER_POSITION,
    PATIENT_DIAMETER,
    Plaque,
    interpolate_material,
    plaque_scene,
)
from torchpcct.scene.plaque.variants import plaque_variant

__all__ = [
    "PAPER_POSITION",
    "PATIENT_DIAMETER",
    "Plaque",
    "interpolate_material",
    "plaque_scene",
    "plaque_variant",
]
