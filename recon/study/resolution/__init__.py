"""Which resolution the plaque needs: PCCT and EID-CT without noise, and PCCT blurred step by step.

Protocol of Li et al., section "Image Resolution": standard kernel, voxels of 0.1 mm, axial image interpolated linearly
to 0.035 mm pixels and blurred there with Gaussians of σ = 0 … 10 pixels; lumen and core by thresholds; an image is
acceptable where the lumen's area and the cap's thickness are within 20 % of those of the sharp image.

What the paper leaves open, and what is done here: the reference of the 20 % is the unblurred PCCT image (the paper
normalises the lumen's area so); the cap is measured on the line that joins lumen and core (the caption's red line);
the core counts as segmented while the band of its CT numbers does not join the rim around the vessel; and its
boundary as visible while its basin keeps half of its depth.

Read ``settings``, ``wire`` (how wide the system makes a point), ``blur`` (a blur series and its limits), ``measure``,
then ``report`` and ``figures``.
"""
