"""Ready-made scenes beside the plaque.

Read :mod:`~torchpcct.scene.phantoms.quality` (water cylinder, CTDI phantom) or
:mod:`~torchpcct.scene.phantoms.thorax` (a chest at the height of the heart).
"""

from torchpcct.scene.phantoms.quality import ctdi, water_cylinder
from torchpcct.scene.phantoms.thorax import thorax

__all__ = ["ctdi", "thorax", "water_cylinder"]
