"""Metal is named, noise and bone are not taken for it."""

from __future__ import annotations

import numpy as np
import torch

from recon import reconstruct
from recon.metal import metal_warnings
from torchpcct import ParallelBeam, Scan, VolumeGrid


def _noise(sd):
    return sd * torch.randn((16, 24, 24), generator=torch.Generator().manual_seed(0))


def test_noise_and_bone_are_no_metal():
    assert metal_warnings(_noise(900.0)) == []  # its largest value is 3500 HU
    assert float(_noise(900.0).max()) > 3000
    bone = _noise(50.0)
    bone[4:8, 4:8, 4:8] += 2200
    assert metal_warnings(bone) == []


def test_a_rod_of_titanium_is_metal_whatever_the_noise():
    for sd in (0.0, 50.0, 900.0):
        volume = _noise(sd)
        volume[:, 10:13, 10:13] += 16000.0
        (text,) = metal_warnings(volume)
        assert "metal" in text


def test_fbp_names_metal_in_hu_and_knows_nothing_of_it_in_other_units():
    columns = (np.arange(64) - 31.5) * 0.5
    geometry = ParallelBeam(np.arange(90) * np.pi / 90, 64, 0.5)

    def disc(radius):
        return 2 * np.sqrt(np.clip(radius**2 - columns**2, 0, None))

    grid = VolumeGrid((40, 40), 0.5)
    for pin, unit, warned in ((0.0, {"mu_water": 0.02}, False), (0.4, {"mu_water": 0.02}, True), (0.4, {}, False)):
        lines = np.broadcast_to(0.02 * disc(12) + pin * disc(1.5), geometry.shape)
        volume = reconstruct(Scan.from_line_integrals(lines, geometry, photons=1e5, **unit), grid, "fbp")
        assert any("metal" in text for text in volume.report["warnings"]) is warned
