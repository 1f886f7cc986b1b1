"""The measured dose factor: every method on the same noise realisations of the paper's scan.

``settings`` say what is measured. A scene is a ``variant`` (where things are), then a ``scene`` (its scan) with facts
that hold exactly: ``tissue_values``, ``exact_fbp``. ``realisations`` draws its noise, ``methods`` reconstruct it,
``measures`` reads every volume, ``shape_limit`` and ``stability`` bound what can be had; ``measure`` runs it all in
resumable pieces (``store``). From samples to figures: ``estimates``, ``exact``, ``main_scenes``, ``other_rois``,
``further_scenes``; with ``tables`` and ``figures`` they make the ``report``.
"""
