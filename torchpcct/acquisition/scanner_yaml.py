"""A scanner of one's own as YAML: geometry, tube, detector, filters, bowtie.

A scanner with all its keys::

    name: bench                 # optional
    geometry:                   # of torchpcct.formats.geometry_yaml, kind cone; one turn of views
      {kind: cone, angles_deg: {step: 0.5, count: 720}, sod: 400, sdd: 800, columns: 640, rows: 32,
       pitch: 0.8}
    source:                     # a tungsten tube (torchpcct.scanner.source.Source)
      kvp: 80
      current_ma: 50
      focal_spot: [0.4, 0.4]    # width along the columns, length along z, mm
      filtration: {aluminium: 2.5}    # inherent, mm
      # spectrum: tube.txt      # instead of the model; lines of keV, photons / mm² / mAs at 1 m
    detector:                   # silicon (counts photons) or scintillator (integrates energy)
      {kind: scintillator, material: gos, depth_mm: 0.3, electronic_noise_kev: 20}
    filters: {copper: 0.2}      # flat, in front of the tube, mm
    bowtie: none                # large, or material, fan_angles_deg and thickness_mm of one's own

What is left out has the default of its class.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from torchpcct.formats.damage import read_numbers
from torchpcct.formats.geometry_yaml import geometry_of
from torchpcct.geometry import ConeBeam
from torchpcct.scanner.detector import Scintillator, SiliconDetector
from torchpcct.scanner.filters import Bowtie, large_bowtie
from torchpcct.scanner.scanner import Scanner
from torchpcct.scanner.source import THICKEST_MM, Slabs, Source
from torchpcct.scene.materials import material
from torchpcct.validate import choice, number, reals

_KEYS = ("name", "geometry", "source", "detector", "filters", "bowtie", "energy_bin_kev")
"""Fields of ``scanner``."""
_DETECTORS = {"silicon": SiliconDetector, "scintillator": Scintillator}
"""Detectors by ``kind``."""
_BOWTIE = ("material", "fan_angles_deg", "thickness_mm")
"""Fields of ``bowtie``."""


def scanner_of(values: object, folder: Path = Path()) -> Scanner:
    """The scanner that a mapping describes; see the module's text.

    Args:
        values: mapping, as read from YAML.
        folder: where the files that it names are looked for.

    Raises:
        FileNotFoundError: no such file.
        ValueError, TypeError: missing, unknown or bad values; the message names them.
    """
    given = _mapping("scanner", values, _KEYS)
    missing = [name for name in ("geometry", "detector") if name not in given]
    if missing:
        raise ValueError(f"scanner needs {', '.join(missing)}; or preset: pcct, eid")
    geometry = geometry_of(given["geometry"], folder)
    if not isinstance(geometry, ConeBeam):
        raise ValueError(
            "scanner.geometry must be of kind cone, without pose: scans are simulated on a circle; "
            f"got {type(geometry).__name__}"
        )
    name = given.get("name")
    if not isinstance(name, str | int | float | None) or isinstance(name, bool):
        raise TypeError(f"scanner.name must be a text, got {name!r:.200}")
    return Scanner(
        "own scanner" if name is None else str(name),
        geometry,
        _source(given.get("source", {}), folder),
        _detector(given["detector"]),
        filters=_slabs("scanner.filters", given.get("filters", {})),
        bowties=_bowties(given.get("bowtie")),
        energy_bin_kev=given.get("energy_bin_kev", 1.0),
    )


def _mapping(name: str, value: object, keys: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise TypeError(f"{name} must be a mapping of {', '.join(keys)}, got {value!r:.200}")
    unknown = sorted(str(key) for key in value if key not in keys)
    if unknown:
        raise ValueError(f"{name}: unknown {', '.join(unknown)}; it takes {', '.join(keys)}")
    return dict(value)


def _slabs(name: str, value: object) -> Slabs:
    """Material and thickness in mm of each slab."""
    if not isinstance(value, Mapping):
        raise TypeError(f"{name} must be a mapping such as {{aluminium: 2.5}} (mm), got {value!r}")
    return tuple(
        (material(str(key)), number(f"{name}.{key}", mm, low=0.0, high=THICKEST_MM, unit="mm"))
        for key, mm in value.items()
    )


def _source(value: object, folder: Path) -> Source:
    known = tuple(f.name for f in fields(Source) if f.name != "table")
    given = _mapping("scanner.source", value, (*known, "spectrum"))
    if "filtration" in given:
        given["filtration"] = _slabs("scanner.source.filtration", given["filtration"])
    table = given.pop("spectrum", None)
    if table is None:
        return Source(**given)
    numbers = read_numbers(folder / str(table), "a table of a spectrum")
    if numbers.ndim != 2 or numbers.shape[1] != 2:
        raise ValueError(
            f"scanner.source.spectrum: {table} must hold two columns, energies in keV and photons "
            f"/ mm² / mAs at 1 m, got the shape {numbers.shape}"
        )
    return Source.tabulated(*np.asarray(numbers).T, **given)


def _detector(value: object) -> SiliconDetector | Scintillator:
    given = dict(value) if isinstance(value, Mapping) else {}
    kind = choice("scanner.detector.kind", given.pop("kind", None), tuple(_DETECTORS))
    made = _DETECTORS[kind]
    given = _mapping("scanner.detector", given, tuple(f.name for f in fields(made)))
    if "material" in given:
        given["material"] = material(str(given["material"]))
    if "thresholds_kev" in given:
        thresholds = reals("scanner.detector.thresholds_kev", given["thresholds_kev"])
        given["thresholds_kev"] = tuple(np.atleast_1d(thresholds).tolist())
    detector: SiliconDetector | Scintillator = made(**given)
    return detector


def _bowties(value: object) -> tuple[Bowtie, ...]:
    if value in (None, "none"):
        return ()
    if value == "large":
        return (large_bowtie(),)
    if isinstance(value, str):
        choice("scanner.bowtie", value, ("none", "large"))
    given = _mapping("scanner.bowtie", value, _BOWTIE)
    missing = [name for name in _BOWTIE if name not in given]
    if missing:
        raise ValueError(f"scanner.bowtie needs {', '.join(missing)}")
    angles = np.deg2rad(reals("scanner.bowtie.fan_angles_deg", given["fan_angles_deg"]))
    thickness = reals("scanner.bowtie.thickness_mm", given["thickness_mm"])
    return (Bowtie(material(str(given["material"])), tuple(angles), tuple(thickness)),)
