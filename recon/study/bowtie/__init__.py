"""What the ROI bowtie saves in dose and costs in noise, and what MBIR and ROI bowtie give together.

Read ``settings`` → ``measure`` (the order of the parts) → ``slices`` (scans of one slice with both bowties: noise, CT
numbers, residual cupping) → ``dose_maps`` (transmission, CTDI and thorax doses) → ``combined`` (the plaque by FBP and
MBIR with both bowties) → ``report`` → ``figures``.
"""
