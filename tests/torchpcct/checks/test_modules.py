"""Modules of a detector that lie beside their places: found, measured and told from a wrong centre;
sound scans are told nothing."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, line_integrals
from sound_scans import BALL, Solid, transmissions

from recon import reconstruct
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Scan, VolumeGrid, full_turn
from torchpcct.checks.conjugate_rays import geometry_test
from torchpcct.checks.modules import module_test
from torchpcct.checks.ray_pairs import RayPairs

MU = 0.02
BODIES = [
    Ellipsoid((2.0, -3.0), (70.0, 92.0), value=MU),
    Ellipsoid((30.0, 20.0), (12.0, 17.0), 0.4, value=MU),
    Ellipsoid((-30.0, -40.0), (10.0, 15.0), value=-0.6 * MU),
    Ellipsoid((-20.0, 45.0), (14.0, 9.0), 1.0, value=0.5 * MU),
]
BEAMS = {
    "parallel": ParallelBeam(full_turn(180), 128, 1.7, 0.4),
    "fan": FanBeam(full_turn(180), 600.0, 1100.0, 128, 3.2, 0.8),
    "cone": ConeBeam(full_turn(120), 600.0, 1100.0, 128, 4, (3.0, 3.2)),
}


def _shone(g):
    flat = FanBeam(g.angles, g.sod, g.sdd, 128, 3.2) if g.has_rows else g
    shone = np.exp(-line_integrals(flat, BODIES, sub=1))
    return np.repeat(shone[:, None], 4, 1) if g.has_rows else shone


COUNTS = {
    name: np.random.default_rng(7).poisson(1e5 * _shone(g)).astype(float)
    for name, g in BEAMS.items()
}


def displaced(counts, first, width, by):
    """Columns that read what those ``by`` places further on should."""
    out = counts.copy()
    out[..., first : first + width] = counts[..., first + by : first + by + width]
    return out


def _tested(counts, g):
    scan = Scan.from_counts(counts, g, air=1e5, mu_water=MU)
    return geometry_test(scan.line_integrals(), g)


@pytest.mark.parametrize(("first", "width", "by"), [(80, 20, 1), (84, 10, -1), (24, 24, -2)])
@pytest.mark.parametrize("beam", BEAMS)
def test_a_displaced_module_is_found_and_measured(beam, first, width, by):
    g = BEAMS[beam]
    found = _tested(displaced(COUNTS[beam], first, width, by), g)
    (text,) = found.findings
    assert "a module of the detector" in text
    assert abs(found.sizes["module"] + by) < 0.2 * abs(by)
    said, known = (float(x) for x in re.search(r"about ([\d.]+) ± ([\d.]+)", text).groups())
    assert abs(said - abs(by)) < known < 0.5 * abs(by)
    sides = [(int(a), int(b)) for a, b in re.findall(r"(\d+) … (\d+)", text)]
    assert any(
        abs(low - first) <= 2 and abs(high - (first + width - 1)) <= 2 for low, high in sides
    ), text


@pytest.mark.parametrize("beam", BEAMS)
def test_columns_that_were_sorted_into_each_other_are_found(beam):
    counts = COUNTS[beam].copy()
    counts[..., 80:104] = np.roll(counts[..., 80:104], 1, -1)
    (text,) = _tested(counts, BEAMS[beam]).findings
    assert "a module of the detector" in text


@pytest.mark.parametrize("beam", BEAMS)
def test_sound_scans_and_other_faults_show_no_module(beam):
    g, counts = BEAMS[beam], COUNTS[beam]
    assert _tested(counts, g).findings == ()
    dark = counts.copy()
    dark[..., 80:104] *= 0.9  # a module of another gain
    assert not any("a module" in text for text in _tested(dark, g).findings)
    shifted = g.with_column_offset(g.column_offset + 0.8 * g.column_pitch)
    found = _tested(counts, shifted)
    assert "rotation centre" in found.findings[0]
    assert len(found.findings) == 1
    turned = replace(g, angles=1.01 * g.angles)
    assert not any("module" in text for text in _tested(counts, turned).findings)
    if beam != "parallel":
        assert not any("module" in text for text in _tested(counts, g.scaled(1.04)).findings)


@pytest.mark.parametrize("height", [0.8, 6.8])
def test_rays_of_a_short_scan_that_part_along_z_show_no_module(height):
    """A body that ends beyond two rows: in the third of the turn that has conjugate rays they pass
    it at other heights, in the middle of its shadow the other way than at its border."""
    turn = -0.27314 + 0.033841 * np.arange(115)
    g = ConeBeam(turn, 134.542, 294.512, 193, 2, (1.45983, 0.954142), (0.0, 0.23854))
    bodies = [
        Solid(BALL, (-12.87, 5.558, 0.0), (20.425, 18.279, 1.653), 0.04334),
        Solid(BALL, (-12.87, 5.558, 0.277), (6.808, 6.808, height), -0.04279),
    ]
    shone = transmissions(g, bodies, subs=(3, 16, 1))
    lines = torch.from_numpy(-np.log(np.random.default_rng(1).poisson(7500.0 * shone) / 7500.0))
    pairs = RayPairs.of(lines, g, None, (0.0, 0.0))
    assert module_test(pairs).findings == ()
    pairs.parted = 0.0
    assert module_test(pairs).findings  # but for what rays part by
    assert not any("a module" in text for text in geometry_test(lines, g).findings)


def test_what_is_round_about_the_axis_shows_nothing():
    """Its readings are the same in all views, as gains are."""
    g = FanBeam(full_turn(180), 600.0, 1100.0, 128, 3.2)
    shone = np.exp(-line_integrals(g, [Ellipsoid((0.0, 0.0), (80.0, 80.0), value=MU)], sub=1))
    counts = np.random.default_rng(3).poisson(1e5 * shone).astype(float)
    found = _tested(displaced(counts, 80, 20, 1), g).findings
    assert not any("a module" in text for text in found)


def test_every_method_says_it():
    g = BEAMS["fan"]
    counts = displaced(COUNTS["fan"], 80, 20, 1)
    scan = Scan.from_counts(counts, g, air=1e5, mu_water=MU)
    said = reconstruct(scan, VolumeGrid((40, 40), 5.0), "fbp").report["warnings"]
    assert sum("a module of the detector" in text for text in said) == 1
    short = scan.select(slice(0, 120))  # no conjugate rays of most columns
    assert isinstance(reconstruct(short, VolumeGrid((40, 40), 5.0), "fbp").data, torch.Tensor)
