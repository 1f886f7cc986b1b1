"""The passes of the CPU: numba kernels, SIMD written out where the compiler does not find it.

Cone beam: read :mod:`~torchpcct.projector.cpu.cone_passes`, then :mod:`~.cone_kernels`. Parallel
and fan beam: :mod:`~.plane_passes`, :mod:`~.symmetry` (which views share their work),
:mod:`~.plane_kernels`. Both rest on the vector instructions of :mod:`~.simd` and
:mod:`~.simd_interpolation`.
"""
