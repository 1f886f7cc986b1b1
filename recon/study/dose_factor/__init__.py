"""The measured dose factor: every method on the same noise realisations of the paper's scan.

``settings`` say what is measured; ``scene`` simulates a scene and keeps its ``facts`` (what holds exactly), ``noise``
draws its realisations, ``methods`` reconstruct them, ``study`` runs all of that in resumable pieces (``store``).
``analysis``, ``further``, ``rois`` and ``stability`` turn samples into figures, ``report`` and ``figures`` into text
and pictures.
"""
