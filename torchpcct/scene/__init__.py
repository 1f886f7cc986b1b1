"""The scanned object: analytic bodies in mm, their materials and their motion.

Read :mod:`~torchpcct.scene.scene` first (what a scene is, how bodies nest), then :mod:`~.bodies`
and :mod:`~.tubes` (shapes), :mod:`~.materials`, :mod:`~.motion`. :mod:`~.chords` packs shapes for
the numba kernels of :mod:`~.chord_kernels`: exact path lengths of rays. :mod:`~.raster` fills
voxels, for reference images only. :mod:`~.voxels` makes a scene of a CT volume. Ready-made scenes:
:mod:`~torchpcct.scene.plaque`, :mod:`~torchpcct.scene.phantoms`.
"""

from typing import TYPE_CHECKING

from torchpcct.scene.bodies import Box, Ellipsoid, EllipticCylinder, Shape, rotation_matrix
from torchpcct.scene.motion import SinusoidalMotion
from torchpcct.scene.scene import Body, Scene
from torchpcct.scene.tubes import BulgedTube, NarrowedTube
from torchpcct.scene.voxels import VoxelScene

if TYPE_CHECKING:
    from torchpcct.scene.chords import chord_lengths

__all__ = [
    "Body",
    "Box",
    "BulgedTube",
    "Ellipsoid",
    "EllipticCylinder",
    "NarrowedTube",
    "Scene",
    "Shape",
    "SinusoidalMotion",
    "VoxelScene",
    "chord_lengths",
    "rotation_matrix",
]


def __getattr__(name: str) -> object:
    # The chord kernels need numba: loaded on first use, so that importing the package stays quick.
    if name == "chord_lengths":
        from torchpcct.scene.chords import chord_lengths

        return chord_lengths
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
