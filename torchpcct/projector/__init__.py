"""Line integrals of voxel grids, and the exact adjoint.

Read :mod:`~torchpcct.projector.operator` (the PyTorch module), :mod:`~.engine` (which passes a
tensor takes), :mod:`~.tables` with :mod:`~.rays` (what a geometry and a grid come to), then the
passes: :mod:`~torchpcct.projector.cpu` (numba) or :mod:`~torchpcct.projector.cuda` (Triton),
neither of which knows the other. A :class:`~torchpcct.vector_geometry.VectorGeometry` that is no
circle has its own passes, ``vector_passes`` of either. Gradients by geometry and motion:
:mod:`~torchpcct.projector.poses` (which numbers may be tensors), :mod:`~torchpcct.projector.posed`
(the passes), :mod:`~torchpcct.projector.cpu.pose_kernels` (the derivative).
"""

from torchpcct.projector.operator import Projector
from torchpcct.projector.poses import ParametricGeometry, with_parameters

__all__ = ["ParametricGeometry", "Projector", "with_parameters"]
