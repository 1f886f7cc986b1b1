"""Jobs and what is kept of them, below all methods: nothing here knows what a job computes.

:mod:`~recon.jobs.execute` runs jobs in other processes or on other machines,
:mod:`~recon.jobs.store` keeps finished pieces on disk, :mod:`~recon.jobs.sources` tells by the
sources of a piece whether it still holds.
"""
