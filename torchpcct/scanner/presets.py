"""The two scanners of the plaque study: deep-silicon photon counting (PCCT) and energy integrating
(EID-CT).

Li et al. publish distances, cell counts, focal spots, tube setting, views and the bowtie. What they
leave open is a named constant here.
"""

from __future__ import annotations

from collections.abc import Sequence

from torchpcct.geometry import ConeBeam, full_turn
from torchpcct.scanner.detector import Scintillator, SiliconDetector
from torchpcct.scanner.filters import Bowtie, large_bowtie, roi_bowtie
from torchpcct.scanner.scanner import Scanner
from torchpcct.scanner.source import Source
from torchpcct.scene.materials import MATERIALS
from torchpcct.validate import checked, choice

__all__ = ["eid", "pcct"]

PCCT_VIEWS = 1968
"""Published views per turn of the PCCT."""
EID_VIEWS = 984
"""Published views per turn of the EID-CT."""

PCCT_PITCH_MM = (0.50, 0.35)
"""Inferred (row, column) pitch at the detector: 40 rows of 0.5 mm cover the 11.3 mm that the
published volumes hold at the isocentre, and "0.4 mm ≈ 2 pixels" at the isocentre gives 0.35 mm
columns."""

EID_PITCH_MM = (1.0988, 1.0239)
"""(row, column) pitch of the public LightSpeed-VCT configuration."""

EID_OFFSET_COLUMNS = -1.25
"""Column offset of the public LightSpeed-VCT configuration, in columns."""

FLAT_FILTER_MM = 3.0
"""Assumed flat aluminium filter in front of the tube (public CatSim/XCIST default)."""

QUARTER_OFFSET_COLUMNS = 0.25
"""Offset of the detector by which opposite views interleave."""

_BOWTIES = ("large", "roi", "large+roi", "none")
"""Bowties of the presets."""


def _bowties(name: object, sod: float) -> tuple[Bowtie, ...]:
    if isinstance(name, Bowtie):
        return (name,)
    if not isinstance(name, str):
        if name is not None and not isinstance(name, Sequence):
            raise TypeError(
                f"bowtie must be one of {', '.join(_BOWTIES)}, a Bowtie or a sequence of them, "
                f"got {name!r}"
            )
        return tuple(name or ())
    choice("bowtie", name, _BOWTIES)
    large = (large_bowtie(),) if "large" in name else ()
    return (*large, roi_bowtie(sod)) if "roi" in name else large


@checked
def pcct(
    views: int = PCCT_VIEWS,
    mode: str = "counting",
    *,
    bowtie: object = "large",
    kvp: float = 100.0,
    current_ma: float = 1000.0,
    rows: int = 40,
    columns: int = 1500,
    quarter_offset: bool = False,
    detector: SiliconDetector | None = None,
    energy_bin_kev: float = 1.0,
) -> Scanner:
    """Deep-silicon photon-counting CT: 626 / 1098 mm, 40 × 1500 cells of 0.5 × 0.35 mm, 0.5 × 0.5
    mm focal spot.

    Args:
        views: views per turn.
        mode: ``"counting"`` (sum of all bins) or ``"spectral"`` (8 energy bins).
        bowtie: ``"large"``, ``"roi"``, ``"large+roi"``, ``"none"``, a :class:`Bowtie` or a sequence
            of them.
        kvp, current_ma: tube setting.
        rows, columns: detector cells.
        quarter_offset: shift the detector by a quarter column, so that conjugate rays interleave.
        detector: another silicon detector (then ``mode`` is ignored).
        energy_bin_kev: width of the energy bins of the simulation.

    Raises:
        ValueError, TypeError: bad values, see :class:`Scanner` and its parts.
    """
    offset = QUARTER_OFFSET_COLUMNS * PCCT_PITCH_MM[1] if quarter_offset else 0.0
    geometry = ConeBeam(
        full_turn(views),
        626.0,
        1098.0,
        columns,
        rows,
        PCCT_PITCH_MM,
        offset=(0.0, offset),
        detector="curved",
    )
    return Scanner(
        "PCCT",
        geometry,
        Source(kvp, current_ma, focal_spot=(0.5, 0.5)),
        SiliconDetector(mode) if detector is None else detector,
        filters=((MATERIALS["aluminium"], FLAT_FILTER_MM),),
        bowties=_bowties(bowtie, geometry.sod),
        energy_bin_kev=energy_bin_kev,
    )


@checked
def eid(
    views: int = EID_VIEWS,
    *,
    bowtie: object = "large",
    kvp: float = 100.0,
    current_ma: float = 1000.0,
    rows: int = 64,
    columns: int = 888,
    detector: Scintillator | None = None,
    energy_bin_kev: float = 1.0,
) -> Scanner:
    """Energy-integrating CT like the LightSpeed VCT: 541 / 949 mm, 64 × 888 cells of 1.10 × 1.02
    mm, 0.9 × 0.7 mm spot.

    Args:
        views: views per turn.
        bowtie, kvp, current_ma, rows, columns, energy_bin_kev: as for :func:`pcct`.
        detector: another scintillator.

    Raises:
        ValueError, TypeError: bad values, see :class:`Scanner` and its parts.
    """
    offset = EID_OFFSET_COLUMNS * EID_PITCH_MM[1]
    geometry = ConeBeam(
        full_turn(views),
        541.0,
        949.0,
        columns,
        rows,
        EID_PITCH_MM,
        offset=(0.0, offset),
        detector="curved",
    )
    return Scanner(
        "EID-CT",
        geometry,
        Source(kvp, current_ma, focal_spot=(0.9, 0.7)),
        Scintillator() if detector is None else detector,
        filters=((MATERIALS["aluminium"], FLAT_FILTER_MM),),
        bowties=_bowties(bowtie, geometry.sod),
        energy_bin_kev=energy_bin_kev,
    )
