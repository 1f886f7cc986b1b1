"""The main job: what dose MBIR saves against FBP, with intervals, and the paper's CNR tables beside its numbers.

``settings`` → ``measure``, which scans and reconstructs by FBP and PWLS itself; for MBIR ``regions`` says where is
read, ``draws`` reconstructs with and without the core beside a linear control, ``reference`` has the exact FBP.
``placements`` moves ROIs and grid under the figures outside their tolerance. → ``report`` with ``factors`` (dose
factors), ``answer`` (the sentence on top and their tables), ``tables`` (the paper's) and ``figures``.
"""
