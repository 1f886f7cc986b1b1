"""Does a scan contradict itself? What its readings say, without a volume, and what no object can
have caused.

:mod:`~.defects` finds readings that no object can cause and interpolates them (``repair_defects``).
:mod:`~.readings` finds readings that are not what they are described as (``reading_warnings``),
:mod:`~.floor` among them those that were clipped at a lowest value or made positive;
:mod:`~.logarithm` says by how much line integrals of few photons are off.
:mod:`~.conjugate_rays` (``geometry_test``) and :mod:`~.moments` (``moment_test``) test the
description of the geometry, of full and of half turns; conjugate rays also whether a block of
columns is displaced (:mod:`~.modules`) and whether each view lies at its angle
(:mod:`~.view_scatter`). :mod:`~.rotation_axis` measures where the axis is. What a volume leaves of
its data is tested by :func:`torchpcct.metrics.residual_test`.
"""
