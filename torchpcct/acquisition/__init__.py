"""From a scene and a scanner to a scan.

Read :mod:`~torchpcct.acquisition.acquire` first: it leads a scene through the others. :mod:`~.bodies` packs the scene
for the kernel, :mod:`~.plan` decides by a few views what must be modelled, :mod:`~.transmission` computes expected
readings of the finite, polychromatic beam. :mod:`~.path_lengths` gives the same beam's path in every tissue, for the
limits of the data. :mod:`~.voxels` scans voxel volumes instead of bodies. :mod:`~.detection` is what both leave to the
detector. Noise is :mod:`torchpcct.counting_noise`; a scan draws it.
"""
