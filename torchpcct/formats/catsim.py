"""Raw files of CatSim / XCIST: float32 without a header, view by view, row by row."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchpcct.formats.damage import reading
from torchpcct.geometry import Geometry
from torchpcct.scan import Scan

if TYPE_CHECKING:
    from torchpcct.typing import Reals


__all__ = ["read_catsim"]


def read_catsim(results: str | os.PathLike[str], geometry: Geometry, **options: Any) -> Scan:
    """A scan from CatSim's results.

    ``NAME.prep`` holds line integrals; else ``NAME.scan``, ``NAME.air`` and, if there is one,
    ``NAME.offset`` (dark) hold readings. Columns are taken as they come: CatSim's run along its own
    direction, so that a mirrored image means a mirrored detector (flip the last axis, or the sign
    of the angles).

    Args:
        results: path and name without the ending, CatSim's ``resultsName``; or one of the files.
        geometry: of the scan; the files say nothing of it.
        options: of ``Scan.from_counts`` or ``Scan.from_line_integrals``.

    Raises:
        FileNotFoundError: neither file is there.
        ValueError: a file of another size than the geometry's.
    """
    base = Path(results)
    if base.suffix in (".prep", ".scan", ".air", ".offset"):
        base = base.with_suffix("")
    info = {"file": str(base), "format": "CatSim"}
    prep = base.with_name(base.name + ".prep")
    if prep.exists():
        return Scan.from_line_integrals(_raw(prep, geometry.shape), geometry, info=info, **options)
    files = {end: base.with_name(f"{base.name}.{end}") for end in ("scan", "air", "offset")}
    if not files["scan"].exists():
        raise FileNotFoundError(f"neither {prep} nor {files['scan']} exists")
    air = _raw(files["air"], geometry.shape[1:])
    dark = _raw(files["offset"], geometry.shape[1:]) if files["offset"].exists() else 0.0
    return Scan.from_counts(
        _raw(files["scan"], geometry.shape), geometry, air=air, dark=dark, info=info, **options
    )


def _raw(path: Path, shape: tuple[int, ...]) -> Reals:
    with reading(path, "raw float32 readings"):
        expected = 4 * int(np.prod(shape))
        if path.stat().st_size != expected:
            raise ValueError(
                f"it has {path.stat().st_size} bytes, the geometry {shape} needs {expected}"
            )
        return np.fromfile(path, dtype="<f4").reshape(shape)
