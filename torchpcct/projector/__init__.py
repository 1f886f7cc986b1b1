"""Line integrals of voxel grids and of analytic bodies."""

from torchpcct.projector.operator import Projector

__all__ = ["Projector"]
