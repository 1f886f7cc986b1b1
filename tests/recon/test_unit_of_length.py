"""A scan in another unit of length, or of an object of another size on a scanner to match, gives
the same image."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_scan import CENTER, GRID, SCENE, scanner

from recon import reconstruct
from recon.gram.gram import information_at
from recon.least_squares.field_model import FieldModel
from recon.least_squares.qggmrf import DEFAULT_PRIOR, QGGMRF
from torchpcct import (
    ConeBeam,
    FanBeam,
    ParallelBeam,
    Projector,
    Scan,
    VolumeGrid,
    acquire,
    full_turn,
)
from torchpcct.vector_geometry import VectorGeometry

SCALES = [1e-7, 2.54, 1e6]
FAN = FanBeam(full_turn(60), 200.0, 300.0, 48, 1.5)


def chords(geometry):
    """Line integrals of a disc of water, 18 mm, and of a rod for parallel beams."""
    if isinstance(geometry, ParallelBeam):
        u, t = geometry.column_positions, geometry.angles[:, None]
        rod = np.sqrt(np.clip(25 - (u + 7 * np.sin(t) - 5 * np.cos(t)) ** 2, 0, None))
        return 0.04 * (np.sqrt(np.clip(18.0**2 - u**2, 0, None)) + 0.5 * rod)
    u = 200.0 * np.sin(geometry.fan_angles)
    return np.broadcast_to(0.04 * np.sqrt(np.clip(18.0**2 - u**2, 0, None)), geometry.shape)


def stretched(geometry, k):
    lengths = ("sod", "sdd", "pitch", "offset")
    changes = {
        n: np.multiply(getattr(geometry, n), k).tolist() for n in lengths if hasattr(geometry, n)
    }
    return replace(geometry, **changes)


def wobbling(geometry, k):
    """A fan whose source leaves its circle by 1.5 mm, view by view."""
    vectors = np.array(VectorGeometry.of(geometry).vectors)
    vectors[:, :2] *= 1.0 + 1.5 / 200.0 * np.sin(geometry.angles)[:, None]
    return VectorGeometry(vectors * k, geometry.columns)


CASES = {
    "parallel": (
        ParallelBeam(np.arange(45) * math.pi / 45, 44, 1.0, 0.1),
        VolumeGrid((40, 40), 1.0),
        stretched,
    ),
    "fan": (FAN, VolumeGrid((40, 40), 1.0), stretched),
    "vectors": (FAN, VolumeGrid((40, 40), 1.0), wobbling),
    "cone": (
        ConeBeam(full_turn(45), 200.0, 300.0, 46, 8, 1.4),
        VolumeGrid((4, 40, 40), 1.0),
        stretched,
    ),
    "inset": (
        ConeBeam(full_turn(45), 200.0, 300.0, 56, 8, 1.2),
        VolumeGrid((3, 12, 12), 0.8, (0.0, 3.0, -2.0)),
        stretched,
    ),
}


def scan(name, k):
    geometry, grid, change = CASES[name]
    counts = np.random.default_rng(0).poisson(2e4 * np.exp(-chords(geometry))).astype(float)
    grid = VolumeGrid(grid.shape, [k * s for s in grid.spacing], [k * c for c in grid.center])
    return Scan.from_counts(counts, change(geometry, k), air=2e4, mu_water=0.02 / k), grid


@pytest.mark.parametrize("method", ["fbp", "pwls"])
@pytest.mark.parametrize("name", list(CASES))
def test_fbp_and_pwls(name, method):
    wanted = reconstruct(*scan(name, 1.0), method)
    for k in SCALES if method == "fbp" else (SCALES[0], SCALES[-1]):
        found = reconstruct(*scan(name, k), method)
        torch.testing.assert_close(found.data, wanted.data, atol=0.1, rtol=0)
        assert len(found.report["warnings"]) == len(wanted.report["warnings"])


@pytest.mark.parametrize(
    ("name", "method"), [("parallel", "fbp"), ("vectors", "pwls"), ("cone", "pwls")]
)
def test_scans_that_do_not_know_water(name, method):
    """Volumes in mm⁻¹: as many times smaller as lengths are larger."""
    wanted = reconstruct(*without_water(name, 1.0), method)
    assert wanted.unit == "mm^-1"
    for k in (SCALES[0], SCALES[-1]):
        found = reconstruct(*without_water(name, k), method)
        torch.testing.assert_close(k * found.data, wanted.data, atol=0.02 * 1e-4, rtol=0)
        assert len(found.report["warnings"]) == len(wanted.report["warnings"])


def without_water(name, k):
    known, grid = scan(name, k)
    return Scan.from_counts(known.counts, known.geometry, air=2e4), grid


def test_mbir_of_a_field():
    wanted = reconstruct(*scan("parallel", 1.0), "mbir")
    torch.testing.assert_close(
        reconstruct(*scan("parallel", 1e-3), "mbir").data, wanted.data, atol=0.1, rtol=0
    )


@pytest.fixture(scope="module")
def windowed():
    return acquire(SCENE, scanner(), region=GRID, exposure_s=1.0, seed=0)


@pytest.mark.parametrize("k", [1e-3, 1e4])
def test_insets_of_windowed_scans(windowed, k):
    """The exterior is known; MBIR, whose network knows voxels of 0.2 mm, says so."""
    grid = VolumeGrid((4, 8, 8), 0.4, CENTER)
    linearisation = replace(windowed.linearisation, mu_ref=windowed.linearisation.mu_ref / k)
    other = replace(windowed, geometry=stretched(windowed.geometry, k), linearisation=linearisation)
    there = VolumeGrid(grid.shape, 0.4 * k, [c * k for c in CENTER])
    for method in ("fbp", "pwls"):
        wanted, found = (
            reconstruct(windowed, grid, method).data,
            reconstruct(other, there, method).data,
        )
        torch.testing.assert_close(found, wanted, atol=0.1, rtol=0)
    with pytest.raises(ValueError, match="check that lengths are in mm"):
        reconstruct(other, there, "mbir")


@pytest.mark.parametrize("voxel", [0.05, 0.4, 1.2, 1.67, 2.4, 3.0, 10.0])
def test_information_is_positive_for_voxels_of_any_size(voxel):
    """At any frequency, also where voxels or grid do not hold it: once negative for voxels of
    1.2 to 3 mm."""
    n = max(1, round(24 / voxel)) if voxel >= 1 else 12
    geometry = ConeBeam(full_turn(40), 500.0, 900.0, 40, 6, 3.0)
    model = FieldModel(
        Projector(geometry, VolumeGrid((3, n, n), voxel)), torch.full(geometry.shape, 1e4)
    )
    for frequency in (1e-3, 0.1, 0.5, 5.0):
        assert model.information(2e-5, frequency) > 0


def test_information_of_a_voxel_alone():
    """S = c / f on the square of frequencies that a voxel holds has the mean 4 c h ln(1 + √2)."""
    c, h = 3.0, 0.5
    own = 4.0 * c * h * math.log(1.0 + math.sqrt(2.0))
    found = information_at(0.5, torch.full((1, 1, 1), own), (1, 1), (h, h), 1.0)
    assert found == pytest.approx(0.1 * c / 0.5 / h**2, rel=1e-6)  # the least that is believed


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (2, 2)])
def test_grids_of_a_few_voxels(shape):
    geometry = FanBeam(full_turn(20), 50.0, 80.0, 12, 1.6)
    counts = np.full(geometry.shape, 9e3)
    volume = reconstruct(
        Scan.from_counts(counts, geometry, air=1e4, mu_water=0.02), VolumeGrid(shape, 1.0), "pwls"
    )
    assert torch.isfinite(volume.data).all()


def test_a_prior_is_stretched_with_its_scan():
    """R keeps its value, and the ring on which the data are asked."""
    for dimensions in (2, 3):
        for prior in (DEFAULT_PRIOR, QGGMRF(0.3, 20.0)):
            x = torch.rand(
                (5,) * dimensions, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
            )
            k = 7.3
            one = prior.bind(2.0, (0.5,) * dimensions, 2e-5).value(x)
            # The information, 1 / (HU² mm³), at the frequency that voxels hold alike.
            other = prior.stretched(k, dimensions).bind(
                2.0 / k**dimensions, (0.5 * k,) * dimensions, 2e-5 / k
            )
            assert other.value(x / k) == pytest.approx(float(one), rel=1e-9)
