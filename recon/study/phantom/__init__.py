"""The plaque itself beside the paper's: what it is made of, what it reads in HU, and its lengths.

Read ``settings`` → ``measure`` → ``materials`` (densities, fractions, CT numbers; ``recipes`` derives the tissues from
molecules) → ``geometry`` (lengths of the analytic bodies and of their raster) → ``report`` → ``figures``.
"""
