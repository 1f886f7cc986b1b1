"""FBP and FDK against exact chords: gain, position, invariances, resolution, bad input."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, line_integrals
from fresh_python import run_python
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.analytic.backproject import backproject
from recon.analytic.fbp import Fbp, fbp, filter_sinogram, interleave
from recon.names import KERNELS
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam, VolumeGrid, full_turn

MU = 0.02
# Some tests here filter constants, which do not end in air.
pytestmark = pytest.mark.filterwarnings("ignore:the rows end inside the object")


def project(
    geometry: Any,
    center: tuple[float, ...],
    radius: float,
    half_height: float | None = None,
    sub: int = 1,
):
    """Exact line integrals of an ellipsoid of revolution about z at (x, y, z); of a cylinder
    without a height; MU."""
    x, y, *z = center
    body = Ellipsoid((y, x), radius, value=MU)
    if half_height is not None:
        body = Ellipsoid((z[0], y, x), (half_height, radius, radius), value=MU)
    return torch.from_numpy(line_integrals(geometry, [body], sub=sub))


@settings(max_examples=15, deadline=None)
@given(
    beam=st.sampled_from(["parallel", "flat", "curved"]),
    kernel=st.sampled_from(KERNELS),
    size=st.floats(0.01, 100),
    magnification=st.floats(1.05, 3),
    fan=st.floats(0.1, 0.6),
    columns=st.integers(480, 700),
    offset=st.floats(-3, 3),
    voxel=st.floats(0.002, 0.05),
    x=st.floats(-0.3, 0.3),
    y=st.floats(-0.3, 0.3),
)
def test_gain_is_one(beam, kernel, size, magnification, fan, columns, offset, voxel, x, y):
    """A cylinder reads its value for every scanner size, fan, pitch, offset, voxel size,
    position and kernel."""
    sod = 600.0 * size
    radius = sod * math.sin(fan)
    if beam == "parallel":
        pitch = 2.1 * radius / columns
        geometry: Geometry = ParallelBeam(
            np.arange(360) * math.pi / 360, columns, pitch, offset * pitch
        )
    else:
        sdd = sod * magnification
        pitch = 2.1 * (sdd * fan if beam == "curved" else sdd * math.tan(fan)) / columns
        geometry = FanBeam(full_turn(360, 0.1), sod, sdd, columns, pitch, offset * pitch, beam)
    center = (0.1 * radius * x, 0.1 * radius * y)
    sinogram = project(geometry, center, 0.85 * radius)
    spacing = voxel * radius
    grid = VolumeGrid((9, 8), (spacing, 1.3 * spacing), (y * radius, x * radius))
    image = fbp(sinogram, geometry, grid, kernel)
    assert image.mean().item() / MU == pytest.approx(1, abs=1e-3)
    assert (image / MU - 1).abs().max() < 4e-3
    single = fbp(sinogram.float(), geometry, grid, kernel)
    assert single.dtype == torch.float32
    assert (single - image).abs().max() < 1e-4 * MU  # 0.1 HU


@pytest.mark.parametrize("detector", ["flat", "curved"])
def test_cone_gain_is_one_in_every_slice_for_every_kernel(detector):
    """FDK is exact for bodies that do not change along z: the inset of an off-centre plaque in a
    cylinder."""
    geometry = ConeBeam(full_turn(360), 626, 1098, 500, 6, (3.0, 1.05), (0.4, 0.2625), detector)
    grid = VolumeGrid((5, 8, 8), (1.8, 0.2, 0.2), (0.2, -30.38, -29.63))
    sinogram = project(geometry, (0.0, 0.0), 120.0)
    image = fbp(sinogram, geometry, grid, KERNELS)
    assert (image.mean(dim=(-1, -2)) / MU - 1).abs().max() < 1e-3
    # the same body from far larger cone angles: every slice reads the same
    steep = ConeBeam(full_turn(360), 626, 1098, 500, 9, (60.0, 1.05), (0.0, 0.2625), detector)
    slices = fbp(
        project(steep, (0.0, 0.0), 120.0), steep, VolumeGrid((5, 3, 3), (30.0, 4.0, 4.0)), KERNELS
    )
    assert (slices.mean(dim=(-1, -2)) / MU - 1).abs().max() < 1e-3
    # heights beyond the outermost row's centre read that row: nothing but its obliquity changes
    high = fbp(sinogram, geometry, replace(grid, center=(6.0, *grid.center[1:])), KERNELS)
    assert (high.mean(dim=(-1, -2, -3)) / MU - 1).abs().max() < 2e-3


@pytest.mark.parametrize("detector", ["flat", "curved"])
def test_position_and_orientation_of_a_sphere(detector):
    """Angular sign, column sign and row sign: the centre of mass lands where the sphere is."""
    geometry = ConeBeam(full_turn(180, 0.4), 300, 500, 64, 32, (2.0, 2.1), (0.7, -0.5), detector)
    center = (11.0, -6.5, 4.0)
    grid = VolumeGrid((24, 24, 24), 1.0, (3.0, -5.0, 10.0))
    image = (
        fbp(project(geometry, center, 6.0, 6.0), geometry, grid, "soft").clamp_min(0.4 * MU)
        - 0.4 * MU
    )
    z, y, x = (torch.from_numpy(a) for a in grid.axes)
    mass = image.sum()
    found = [
        ((image.sum(dim=d) @ a) / mass).item() for d, a in (((0, 1), x), ((0, 2), y), ((1, 2), z))
    ]
    assert found == pytest.approx(center, abs=0.05)


@pytest.mark.parametrize("detector", ["flat", "curved"])
@pytest.mark.parametrize("extra", [0.0, 20.0, 145.0])
def test_short_scans(detector, extra):
    """Minimal, over- and nearly full scans reconstruct an off-centre disc as the full circle
    does."""
    columns, pitch = 400, 0.9
    half = (
        0.5 * columns * pitch / 1098
        if detector == "curved"
        else math.atan(0.5 * columns * pitch / 1098)
    )
    span = math.pi + 2 * half + math.radians(extra)
    assert span < 2 * math.pi
    grid = VolumeGrid((24, 24), 3.0, (-14.0, 5.0))
    n = 500
    geometry = FanBeam(np.arange(n) * span / n + 2.0, 626, 1098, columns, pitch, 0.2, detector)
    image = fbp(project(geometry, (8.0, -15.0), 75.0), geometry, grid)
    assert (image / MU - 1).abs().mean() < 6e-4
    assert (image.mean() / MU - 1).abs() < 3e-4
    shuffled = np.random.default_rng(0).permutation(n)
    again = fbp(project(geometry, (8.0, -15.0), 75.0)[shuffled], geometry.select(shuffled), grid)
    torch.testing.assert_close(again, image, rtol=0, atol=1e-12)


def test_irregular_repeated_and_many_turns():
    rng = np.random.default_rng(1)
    regular = full_turn(300)
    angles = {
        "jitter": regular + rng.uniform(-0.4, 0.4, 300) * 2 * math.pi / 300,
        "dense half": np.concatenate(
            [np.linspace(0, math.pi, 400, endpoint=False), math.pi + full_turn(200)[:100]]
        ),
        "repeated": np.concatenate([regular, regular[:77]]),
        "400 degrees": np.arange(334) * 2 * math.pi / 300,
    }
    grid = VolumeGrid((16, 16), 3.0, (-14.0, 5.0))
    for name, a in angles.items():
        geometry = FanBeam(a, 626, 1098, 400, 0.9, 0.2, "curved")
        image = fbp(project(geometry, (8.0, -15.0), 75.0), geometry, grid)
        assert (image / MU - 1).abs().max() < 3e-3, name
        # plain equal weights would be wrong by far more where the density of views changes
    geometry = FanBeam(angles["dense half"], 626, 1098, 400, 0.9, 0.2, "curved")
    equal = np.full(geometry.views, math.pi / geometry.views)
    plain = fbp(project(geometry, (8.0, -15.0), 75.0), geometry, grid, weights=equal)
    assert (plain / MU - 1).abs().max() > 3e-3


@pytest.mark.parametrize("detector", ["flat", "curved"])
def test_invariances(detector):
    """Turning the scan turns the image; a part of the grid is the crop; far away, a fan is
    parallel."""
    geometry = ConeBeam(full_turn(36), 50, 90, 41, 6, (1.5, 1.5), (0.2, 0.3), detector)
    data = torch.randn(
        geometry.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    grid = VolumeGrid((3, 8, 8), 1.2)
    image = fbp(data, geometry, grid)
    turned = fbp(data, replace(geometry, angles=geometry.angles + math.pi / 2), grid)
    # a quarter turn counter-clockwise: (x, y) → (−y, x)
    torch.testing.assert_close(turned, image.transpose(-1, -2).flip(-1), rtol=0, atol=1e-12)
    part = VolumeGrid((2, 3, 4), 1.2, (0.6, -0.5 * 1.2, 1.2))
    torch.testing.assert_close(fbp(data, geometry, part), image[1:3, 2:5, 3:7], rtol=0, atol=1e-12)
    both = torch.cat([data, data.flip(0)])
    order = np.concatenate([np.arange(36), np.arange(36)[::-1]])
    torch.testing.assert_close(fbp(both, geometry.select(order), grid), image, rtol=0, atol=1e-12)


def bead(geometry: FanBeam, at: tuple[float, float]) -> np.ndarray:
    grid = VolumeGrid((41, 41), 0.05, (at[1], at[0]))
    return fbp(project(geometry, at, 0.05, sub=16), geometry, grid, "standard").numpy()


@pytest.mark.parametrize("detector", ["flat", "curved"])
def test_quarter_column_offset_raises_the_resolution_at_the_isocentre(detector):
    """With an even number of columns and no offset the isocentre always falls between two
    columns."""
    plain = FanBeam(full_turn(180), 626, 1098, 60, 1.0, 0.0, detector)
    quarter = replace(plain, offset=0.25)
    a, b = bead(plain, (0.0, 0.0)), bead(quarter, (0.0, 0.0))
    assert b.max() > 1.2 * a.max()
    width = [2 * math.sqrt(float((v > v.max() / 2).sum()) * 0.05**2 / math.pi) for v in (a, b)]
    assert width[1] < 0.95 * width[0]


@pytest.mark.extended
@pytest.mark.parametrize("at", [(0.0, 0.0), (7.3, -4.1)])
def test_interleaving_resolves_what_single_views_alias(at):
    """Bars at 0.71 of the Nyquist frequency of the doubled sampling: contrast only with offset
    and interleaving."""
    period = 1.4 / 1.754

    def modulation(offset: float, interleaved: bool) -> float:
        geometry = FanBeam(full_turn(360), 626, 1098, 80, 1.0, offset, "curved")
        data = torch.stack(
            [project(geometry, (at[0] + i * period, at[1]), 0.1, sub=16) for i in range(-3, 4)]
        ).sum(0)
        if interleaved:
            data, geometry = interleave(data, geometry)
        half = VolumeGrid((1, 5), (1.0, period / 2), (at[1], at[0]))
        line = fbp(data, geometry, half, "standard" if interleaved else "bone")[0]
        bright, dark = line[0::2].mean(), line[1::2].mean()
        return float((bright - dark) / (bright + dark))

    assert modulation(0.25, True) > 0.12
    assert abs(modulation(0.25, False)) < 0.06


def test_interleaved_gain_and_cone():
    geometry = FanBeam(full_turn(360), 626, 1098, 300, 1.2, 0.3)
    data, fine = interleave(project(geometry, (0, 0), 80.0), geometry)
    image = fbp(data, fine, VolumeGrid((8, 8), 4.0), "standard")
    assert (image.mean() / MU - 1).abs() < 1e-3
    cone = ConeBeam(full_turn(8), 626, 1098, 30, 4, (1.0, 1.2), (0.1, 0.3))
    data, fine_cone = interleave(torch.ones(2, *cone.shape), cone)
    assert data.shape == (2, *fine_cone.shape)
    assert fine_cone.column_positions[::2] == pytest.approx(cone.column_positions)
    assert fine_cone.row_positions == pytest.approx(cone.row_positions)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("columns", [40, 400], ids=["fft", "matrix"])
def test_nan_and_inf_reach_the_filtered_rows_and_fbp_bridges_them(bad, columns):
    geometry = ConeBeam(
        full_turn(12), 600, 1000, columns, 3, (2.0, 400 / columns), detector="curved"
    )
    grid = VolumeGrid((2, 3, 3), 2.0)
    data = torch.ones(geometry.shape)
    data[5, 1, columns // 2] = bad
    image = backproject(filter_sinogram(data, geometry), geometry, grid)
    assert not image[:, 1, 1].isfinite().any()
    with pytest.warns(UserWarning, match="1 of .* readings are NaN or Inf"):
        interpolated = fbp(data, geometry, grid, outside=0.0)
    torch.testing.assert_close(
        interpolated, fbp(torch.ones(geometry.shape), geometry, grid, outside=0.0)
    )


def test_grids_and_the_field_of_view():
    geometry = FanBeam(full_turn(90), 626, 1098, 200, 1.0)
    data = project(geometry, (0, 0), 40.0)
    covering = fbp(data, geometry, VolumeGrid((64, 64), 2.0))
    y, x = VolumeGrid((64, 64), 2.0).axes
    outside = np.hypot(y[:, None], x[None, :]) > geometry.fov_radius
    assert outside.any()
    assert (covering[torch.from_numpy(outside)] == 0).all()
    assert (covering[torch.from_numpy(~outside)] != 0).all()
    with pytest.raises(
        ValueError, match=r"leaves the field of view of radius 5\d\.\d\d mm: move or shrink"
    ):
        fbp(data, geometry, VolumeGrid((10, 10), 2.0, (0.0, 50.0)))
    with pytest.raises(ValueError, match="beyond the source orbit"):
        fbp(data, geometry, VolumeGrid((10, 10), 2.0, (0.0, 620.0)))
    with pytest.raises(ValueError, match="needs a 2-D grid, got 3"):
        fbp(data, geometry, VolumeGrid((4, 10, 10), 2.0))


def test_windows_that_do_not_fit_are_named():
    geometry = FanBeam(full_turn(9), 50, 90, 19, 1.3)
    grid = VolumeGrid((3, 3), 1.0)
    data = torch.zeros(geometry.shape)
    window = footprint(geometry, grid, margin=1)
    narrow = DetectorWindow(window.first_column + 2, window.columns - 3)
    with pytest.raises(ValueError, match=r"misses columns that the grid needs in view 0.*margin=1"):
        backproject(filter_sinogram(data, geometry, window=narrow), geometry, grid, narrow)
    with pytest.raises(ValueError, match="beyond the detector of 1 rows × 19 columns"):
        filter_sinogram(data, geometry, window=DetectorWindow(np.full(9, 15), 5))
    with pytest.raises(ValueError, match="8 views, but the geometry has 9"):
        filter_sinogram(data, geometry, window=DetectorWindow(np.zeros(8, int), 5))
    cone = ConeBeam(full_turn(9), 50, 90, 19, 8, 1.3)
    low, high = (DetectorWindow(np.zeros(9, int), 19, r, 4) for r in (0, 4))
    with pytest.raises(ValueError, match=r"rows 4…7, but the data only rows 0…3"):
        filter_sinogram(torch.zeros(9, 4, 19), cone, "soft", high, held=low)
    with pytest.raises(ValueError, match=r"rows 4…7 do not cover the grid"):
        backproject(torch.zeros(9, 4, 19), cone, VolumeGrid((3, 3, 3), 1.0), high)


_PEAK = """
import ctypes
import numpy as np, torch
from recon.analytic.fbp import fbp
from recon.analytic.filter_plan import CHUNK_BYTES
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import ConeBeam, FanBeam, VolumeGrid, full_turn
torch.set_num_threads(1)
def peak():
    line = next(l for l in open("/proc/self/status") if l.startswith("VmHWM"))
    return int(line.split()[1]) * 1024
inset = {inset}
if inset:
    geometry = ConeBeam(full_turn(600), 626, 1098, 1500, 40, (0.5, 0.35), detector="curved")
    grid = VolumeGrid((56, 45, 45), 0.2, (0.0, -30.38, -29.63))
else:
    geometry, grid = FanBeam(full_turn(6000), 626, 1098, 2500, 0.25), VolumeGrid((64, 64), 1.0)
small = geometry.select(slice(None, None, 20))
fbp(torch.zeros(small.shape), small, grid)  # compile
data = torch.zeros(geometry.shape) + 1.0
# What compiling left free would be used again, unseen.
getattr(ctypes.CDLL(None), "malloc_trim", int)(0)
with open("/proc/self/clear_refs", "w") as f:
    f.write("5")
before = peak()
fbp(data, geometry, grid, ("soft", "bone"))
window = footprint(geometry, grid, margin=1) if inset else DetectorWindow.full(geometry)
kept = 2 * 4 * (window.views * window.rows * window.columns + grid.voxels)
print(peak() - before, kept, CHUNK_BYTES)
"""


@pytest.mark.extended
@pytest.mark.parametrize("inset", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_memory_is_bounded(inset):
    """Filtered data and volumes, and one chunk of views: never a second sinogram."""
    if not Path("/proc/self/clear_refs").exists():
        pytest.skip("the peak of a process can be reset on Linux only")
    measured, kept, chunk = map(int, run_python(_PEAK.format(inset=inset)).stdout.split())
    assert 0.4 * kept < measured < 1.15 * (kept + chunk) + 8e6


def test_layer_is_the_function_with_batch_and_channels():
    geometry, grid = ParallelBeam(np.arange(8) * math.pi / 8, 15, 1.9), VolumeGrid((9, 9), 2.0)
    y = torch.randn(2, 3, 8, 15, generator=torch.Generator().manual_seed(0))
    layer = Fbp(geometry, grid, "soft")
    assert torch.equal(layer(y), fbp(y, geometry, grid, "soft"))
    assert not list(layer.parameters())
    narrow = y.bfloat16().requires_grad_()
    out = layer(narrow)
    assert out.dtype == torch.float32
    assert torch.equal(out.detach(), fbp(y.bfloat16().float(), geometry, grid, "soft"))
    out.sum().backward()
    assert narrow.grad.dtype == torch.bfloat16
