"""What dose MBIR saves at the paper's plaque, beside FBP, PWLS and the best simple filter: the main job.

``settings`` → ``measure`` (one task of :mod:`recon.evaluate`) → ``answer`` (the result in a sentence) → ``report`` →
``figures``.
"""
