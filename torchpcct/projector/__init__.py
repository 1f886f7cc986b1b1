"""Line integrals of voxel grids, and the exact adjoint.

Read :mod:`~torchpcct.projector.operator` (the PyTorch module), :mod:`~.engine` (which passes a
tensor takes), :mod:`~.tables` with :mod:`~.rays` (what a geometry and a grid come to), then the
passes: :mod:`~torchpcct.projector.cpu` (numba) or :mod:`~torchpcct.projector.cuda` (Triton),
neither of which knows the other. A :class:`~torchpcct.vector_geometry.VectorGeometry` that is no
circle has its own passes, ``cpu/vector_passes``.
"""

from torchpcct.projector.operator import Projector

__all__ = ["Projector"]
