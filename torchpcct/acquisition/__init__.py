"""From a scene and a scanner to a scan.

Read :mod:`~torchpcct.acquisition.acquire` first: it leads a scene, of bodies or of voxels, through
the others, and leaves what is expected to the detector. :mod:`~.bodies` packs the scene for the
kernel, :mod:`~.plan` decides by a few views what must be modelled, :mod:`~.transmission` computes
expected readings of the finite, polychromatic beam, of which :mod:`~.spectra` sums few energies;
:mod:`~.kept` holds them for another seed. :mod:`~.path_lengths` gives the same beam's
path in every tissue, for the limits of the data. Noise is :mod:`torchpcct.counting_noise`; a scan
draws it.
"""
