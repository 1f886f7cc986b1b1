"""Line integrals of voxel grids, and the exact adjoint.

Read :mod:`~torchpcct.projector.operator` (the PyTorch module; what it shares with its adjoint is
:mod:`~.base`), :mod:`~.engine` (which passes a tensor takes; the log message while kernels compile:
:mod:`~.compiling`), :mod:`~.tables` with :mod:`~.rays` (what a geometry and a grid come to), then the passes:
:mod:`~torchpcct.projector.cpu` (numba) or :mod:`~torchpcct.projector.cuda` (Triton), neither of which knows the other.
:mod:`~.vectors` translates geometries to and from ASTRA's, and finds the circle in a
:class:`~torchpcct.vector_geometry.VectorGeometry`; any other has its own passes, ``cpu/vector_passes``.
"""

from torchpcct.projector.operator import Projector

__all__ = ["Projector"]
