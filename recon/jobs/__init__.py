"""Jobs and what is kept of them, below all methods: nothing here knows what a job computes.

:mod:`~recon.jobs.execute` runs jobs in other processes or on other machines,
:mod:`~recon.jobs.store` caches finished results on disk, :mod:`~recon.jobs.sources` tells by the
sources of a result whether it still holds.
"""
