"""The passes of CUDA devices.

Read :mod:`~torchpcct.projector.cuda.passes` (tables on the device, slices that fit its memory,
launches), then the Triton :mod:`~.kernels`, counterparts of the CPU's. They run on the CPU, too,
under Triton's interpreter: so they are tested.
"""
