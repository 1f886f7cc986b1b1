"""The measured dose factor: every method on the same noise realisations of the paper's scan.

``settings`` say what is measured. A scene is a ``variant`` (where things are), then a ``scene`` (its scan, true values
by rods) with facts that hold exactly: ``tissue_values``, ``exact_fbp``. ``realisations`` draws its noise, ``methods``
reconstruct it, ``readings`` (with ``measures``) says what is read off a volume, ``exact_linear`` and ``exact_figures``
give the same without realisations, ``shape_limit`` and ``stability`` bound what can be had. ``places`` are further
scenes and ``vessels`` (of ``vessel_shapes``) in any direction, with the ``response`` of a method as its control;
``measure`` runs it all in resumable pieces (:mod:`recon.evaluate.store`). From readings to figures: ``controls``,
``figures_found``, ``merit``, ``exact``, and of places ``seen``, ``further_scenes``, ``vessel_rows``; with ``tables``
and ``figures`` they make the ``report``.
"""
