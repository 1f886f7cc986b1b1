"""Line integrals of voxel grids, and the exact adjoint.

Read :mod:`~torchpcct.projector.operator` (the PyTorch module; what it shares with its adjoint is
:mod:`~.manners`), :mod:`~.engine` (which passes a tensor takes; forks and compilation: :mod:`~.compiling`),
:mod:`~.tables` with :mod:`~.rays` (what a geometry and a grid come to), then the passes:
:mod:`~torchpcct.projector.cpu` (numba) or :mod:`~torchpcct.projector.cuda` (Triton), neither of which knows the other.
:mod:`~.vectors` translates geometries to and from ASTRA's.
"""

from torchpcct.projector.operator import Projector

__all__ = ["Projector"]
