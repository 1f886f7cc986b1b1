"""Whole studies: simulate, reconstruct, measure, report.

Reading order: ``study`` says what a study is, ``registry`` lists them. A report is made of ``report`` (files, tables),
``checks`` (our figures beside the paper's) and ``figures``. ``paper`` holds what is published and what the studies of
its plaque share. ``results`` renders what was found. Then the folders, each settings → measure → report: ``compare``
first, it is the main job. What a method saves is measured by :mod:`recon.evaluate`, of which ``compare`` and ``bowtie``
ask one task each.
"""
