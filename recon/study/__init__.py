"""Whole studies: simulate, reconstruct, measure, report.

Reading order: ``study`` says what a study is, ``registry`` lists and runs them, ``report`` renders
what they found by the texts of ``templates``, ``figures`` is what their pictures share. ``paper``
holds what is published and what the studies of its plaque share, ``results`` renders what was found
in all. Then the studies, a module or package each: ``compare`` first, it is the main job. What a
method saves is measured by :mod:`recon.evaluate`, of which ``compare`` and ``bowtie`` ask one task
each.
"""
