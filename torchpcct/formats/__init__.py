"""Files of other software: scans in, volumes in and out.

Read :mod:`~torchpcct.formats.scans` first: it opens whatever it is given, by one table of readers.
Scans: :mod:`~.data_exchange` and :mod:`~.nexus` (synchrotrons, neutrons), :mod:`~.nikon` and
:mod:`~.zeiss` (laboratory machines), :mod:`~.dicom_ct_pd` (clinical projections), :mod:`~.stack`
(:mod:`~.arrays` of TIFF, NumPy, Zarr or MATLAB, in the order of :mod:`~.file_names`, with a
geometry in YAML, :mod:`~.geometry_yaml`), :mod:`~.matlab`, :mod:`~.catsim`; :mod:`~.rtk` reads
per-view geometry. Volumes: :mod:`~.volume_files`, :mod:`~.volume_slabs`, :mod:`~.dicom_series`.
:mod:`~.preprocess` finds rotation axes and takes out stripes. :mod:`~.damage` turns what broken
files raise into one clear error and bounds what hostile ones ask for, :mod:`~.hdf5` keeps to the
file itself. Packages that only a format needs are the optional extra ``io``.
"""
