"""What the ROI bowtie saves in dose and costs in noise, and what MBIR and ROI bowtie give together.

Read ``settings`` → ``measure`` (the order of the parts) → ``slices`` (scans of one slice with both bowties: noise, CT
numbers, residual cupping) → ``dose_maps`` (transmission, CTDI and thorax doses) → ``absolute_noise`` and
``muscle_dose`` (what could make them the paper's) → ``combined`` (the plaque by FBP and MBIR with both bowties) →
``report`` → ``figures``. Not to be confused with :mod:`recon.study.dose_factor`, which
measures what MBIR saves at 200 realisations.
"""
