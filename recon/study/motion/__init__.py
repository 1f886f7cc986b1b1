"""How much residual motion the plaque's image bears, in PCCT and EID-CT, and what motion compensation gets back.

Protocol of Li et al., section "Motion Artifacts": the vessel moves rigidly in the axial plane, 2 mm · sin(2π t) (60
beats a minute), during one turn of 0.35 s; residual motion is 10 to 60 % of that. FBP on 0.2 mm voxels without noise.
Every view sees the vessel where it is then, and blurred by its way during the view: no phase volumes.

Beyond the paper: reconstruction with the motion known (FBP, penalised least squares and the learned MBIR, each with
the displaced inset in its backprojector or projector), with the motion known wrongly, and with noise.

Read ``settings``, ``observed`` (what one image yields), ``measure`` (scans, images with residual motion),
``compensation``, then ``report`` and ``figures``.
"""
