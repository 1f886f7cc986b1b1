"""Files of other software: scans in, volumes in and out.

Read :mod:`~torchpcct.formats.scans` first: it opens whatever it is given. Scans: :mod:`~.data_exchange` (synchrotrons,
neutrons), :mod:`~.dicom_ct_pd` (clinical projections), :mod:`~.stack` (TIFF or NumPy with a geometry in YAML,
:mod:`~.geometry_yaml`), :mod:`~.catsim`; :mod:`~.rtk` reads per-view geometry. Volumes: :mod:`~.volume_files`.
:mod:`~.preprocess` finds rotation axes and takes out stripes. :mod:`~.damage` turns what broken files raise into one
clear error. Packages that only a format needs are the optional extra ``io``.
"""
