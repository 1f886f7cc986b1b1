"""``mu_water`` in another unit is named for tissue and plastic, and for nothing else: exact chords,
photons."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from sound_scans import BOX, CYLINDER, Solid, transmissions

from recon.analytic.coverage import consistency_warnings
from recon.analytic.water_unit import unit_warnings
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid, full_turn
from torchpcct.scan import Scan

ENDLESS = 1e5


def disc(radius, value=1.0, at=(0.0, 0.0), other=None):
    return Solid(CYLINDER, (*at, 0.0), (radius, other or radius, ENDLESS), value)


def pores(radius):
    return [
        disc(radius, -1.0, (15.0 * i, 15.0 * j))
        for i in range(-5, 6)
        for j in range(-5, 6)
        if math.hypot(i, j) < 6
    ]


# In multiples of water.
TISSUE = {
    "water": [disc(100.0)],
    "oblong": [disc(150.0, other=75.0)],
    "thorax": [
        disc(150.0, other=100.0),
        disc(45.0, -0.75, (-70.0, 0.0), 70.0),
        disc(45.0, -0.75, (70.0, 0.0), 70.0),
        disc(12.0, 2.0, (0.0, -70.0)),
    ],
    "head": [disc(80.0, 2.5, other=100.0), disc(74.0, -1.5, other=94.0)],
    "plastic": [Solid(BOX, (20.0, 10.0, 0.0), (40.0, 60.0, ENDLESS), 1.1, 0.5)],
    "mouse": [disc(18.0)],
}
SPARSE = {
    "shell": [disc(100.0), disc(95.0, -1.0)],
    "shell of half a cell": [disc(100.0), disc(99.3, -1.0)],
    "filled shell": [disc(100.0), disc(80.0, -0.87)],
    "filled shell of a cell": [disc(100.0), disc(94.0, -0.88)],
    "filled oval of a cell": [disc(100.0, other=80.0), disc(94.0, -0.9, other=75.0)],
    "tablets": [
        disc(5.0, 1.0, (80.0 * math.cos(a), 80.0 * math.sin(a))) for a in np.arange(12) / 2
    ],
    "pores": [disc(100.0), *pores(7.4)],
    "foam": [disc(100.0, 0.03)],
    "wood": [disc(30.0, 0.4)],
}


def beam(kind, solids, columns=160):
    reach = max(math.hypot(*s.center[:2]) + math.hypot(*s.radii[:2]) for s in solids)
    if kind == "parallel":
        return ParallelBeam(np.arange(120) * np.pi / 120, columns, 2.2 * reach / columns)
    sizes = (full_turn(120), 4.0 * reach, 6.0 * reach, columns)
    pitch = 3.4 * reach / columns
    return FanBeam(*sizes, pitch) if kind == "fan" else ConeBeam(*sizes, 3, (pitch, pitch))


def scanned(solids, geometry, mu, photons=1e6):
    shone = transmissions(geometry, [replace(s, value=mu * s.value) for s in solids])
    return np.random.default_rng(0).poisson(photons * shone).astype(np.float64)


def lines_of(solids, geometry, mu, photons=1e6):
    return torch.from_numpy(-np.log(scanned(solids, geometry, mu, photons).clip(1.0) / photons))


@pytest.mark.parametrize("kind", ["parallel", "fan"])
@pytest.mark.parametrize("name", list(TISSUE))
def test_another_unit_is_named_for_tissue(name, kind):
    mu = 0.04 if name == "mouse" else 0.02
    geometry = beam(kind, TISSUE[name])
    lines = lines_of(TISSUE[name], geometry, mu)
    assert unit_warnings(lines, geometry, mu) == []
    for factor, text in (
        (10.0, "is mu_water given in cm⁻¹?"),
        (100.0, "the wrong way?"),
        (1000.0, "in m⁻¹?"),
        (0.1, "by 10 twice?"),
    ):
        (found,) = unit_warnings(lines, geometry, factor * mu)
        assert text in found
        assert f"if {mu:.3g} mm⁻¹ is meant" in found


@pytest.mark.parametrize("columns", [40, 160])
@pytest.mark.parametrize("kind", ["parallel", "fan"])
@pytest.mark.parametrize("name", list(SPARSE))
def test_what_is_hollow_porous_or_light_has_no_other_unit(name, kind, columns):
    for mu in (0.14, 0.25, 0.5):  # 16 to 10 keV
        geometry = beam(kind, SPARSE[name], columns)
        assert unit_warnings(lines_of(SPARSE[name], geometry, mu), geometry, mu) == []


def test_metal_in_a_beam_of_megavolts_has_no_other_unit():
    for density in (2.7, 7.2, 7.4):  # aluminium, iron, copper
        solids = [disc(30.0, density)]
        geometry = beam("fan", solids)
        assert unit_warnings(lines_of(solids, geometry, 0.005), geometry, 0.005) == []


@pytest.mark.parametrize("photons", [1e3, 1e6])
def test_what_is_opaque_has_no_other_unit(photons):
    for name in ("water", "thorax", "pores"):
        solids = (TISSUE | SPARSE)[name]
        geometry = beam("fan", solids)
        assert unit_warnings(lines_of(solids, geometry, 0.9, photons), geometry, 0.9) == []


def test_small_objects_are_scanned_with_soft_photons():
    """20 mm of foam of a tenth of water's density: its line integral is .4."""
    solids = [disc(10.0, 0.1)]
    geometry = beam("fan", solids)
    assert unit_warnings(lines_of(solids, geometry, 0.2), geometry, 0.2) == []


def test_scans_name_it_once_and_only_where_light_passes():
    solids = TISSUE["thorax"]
    geometry = beam("cone", solids)
    counts = scanned(solids, geometry, 0.02)
    for mu_water, named in ((0.2, True), (0.02, False)):
        scan = Scan.from_counts(counts, geometry, air=1e6, mu_water=mu_water)
        found = consistency_warnings(scan, VolumeGrid((1, 40, 40), 8.0))
        assert sum("given in cm⁻¹" in text for text in found) == named, found
    tube = [disc(100.0), disc(95.0, -1.0)]
    geometry = beam("fan", tube)
    scan = Scan.from_counts(scanned(tube, geometry, 0.9), geometry, air=1e6, mu_water=0.9)
    found = consistency_warnings(scan, VolumeGrid((40, 40), 8.0))
    assert not any("mu_water" in text for text in found), found
