"""FBP as a differentiable linear operator: dense matrices, transposes, gradients, batches."""

import math

import numpy as np
import pytest
import torch
from linear_maps import mismatch

from recon.analytic import filter_plan
from recon.analytic.angular_weights import angular_weights
from recon.analytic.backproject import BackprojectionPlan, backproject
from recon.analytic.fbp import fbp, filter_sinogram
from recon.analytic.filter_plan import FilterPlan
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam, VolumeGrid, full_turn
from torchpcct.threads import get_num_threads, set_num_threads

# Random numbers are no objects: they do not end in air.
pytestmark = pytest.mark.filterwarnings("ignore:the rows end inside the object")

SHORT = np.arange(16) * (math.pi + 0.9) / 16 + 0.3
CASES: dict[str, tuple[Geometry, VolumeGrid]] = {
    "parallel": (
        ParallelBeam(np.arange(9) * math.pi / 9, 14, 1.1, 0.2),
        VolumeGrid((5, 6), 1.0, (0.4, -0.3)),
    ),
    "fan-flat": (
        FanBeam(full_turn(9), 50, 90, 19, 1.3, 0.3),
        VolumeGrid((5, 6), (1.0, 0.8), (1.4, -2.3)),
    ),
    "fan-curved-short": (
        FanBeam(SHORT, 50, 90, 21, 1.3, -0.3, "curved"),
        VolumeGrid((5, 4), (1.0, 0.8), (1.4, -2.3)),
    ),
    "fan-covering": (FanBeam(full_turn(9), 50, 90, 11, 1.3, 0.3), VolumeGrid((9, 9), 1.5)),
    # Views that symmetries of the grid map onto one another share positions and weights.
    "parallel-symmetric": (
        ParallelBeam(np.arange(8) * math.pi / 8, 14, 1.1),
        VolumeGrid((6, 6), 1.0),
    ),
    "fan-symmetric": (FanBeam(full_turn(8), 50, 90, 18, 1.3), VolumeGrid((5, 5), 1.0)),
    "fan-turned": (FanBeam(full_turn(8), 50, 90, 19, 1.3, 0.3), VolumeGrid((6, 6), 1.0)),
    "fan-oblong": (FanBeam(full_turn(6), 50, 90, 18, 1.3, 0.0, "curved"), VolumeGrid((4, 7), 1.0)),
    "fan-symmetric-covering": (FanBeam(full_turn(8), 50, 90, 11, 1.3), VolumeGrid((10, 10), 1.5)),
    "cone-flat": (
        ConeBeam(full_turn(7), 50, 90, 15, 6, (1.2, 1.6), (0.2, 0.1)),
        VolumeGrid((3, 4, 5), (0.9, 1.0, 1.1), (0.3, 1.4, -1.3)),
    ),
    "cone-curved": (
        ConeBeam(full_turn(7), 50, 90, 15, 6, (1.2, 1.6), (0.2, 0.1), "curved"),
        VolumeGrid((3, 4, 5), (0.9, 1.0, 1.1), (0.3, 1.4, -1.3)),
    ),
    "cone-high": (  # heights change by several rows across a tile, and leave the detector
        ConeBeam(full_turn(7), 50, 90, 15, 12, (0.8, 1.6), (0.2, 0.1), "curved"),
        VolumeGrid((9, 4, 5), (1.5, 1.0, 1.1), (0.3, 1.4, -1.3)),
    ),
}


@pytest.fixture(params=CASES, ids=list(CASES))
def case(request: pytest.FixtureRequest) -> tuple[Geometry, VolumeGrid]:
    return CASES[request.param]


def dense(op, shape: tuple[int, ...]) -> torch.Tensor:
    """Matrix of a linear map from its images of the unit vectors."""
    n = math.prod(shape)
    return op(torch.eye(n, dtype=torch.float64).view(n, *shape)).reshape(n, -1).T


def reference_backprojection(geometry: Geometry, grid: VolumeGrid) -> torch.Tensor:
    """The backprojection matrix voxel by voxel, written from the conventions alone."""
    axes = grid.axes
    z_axis = axes[0] if grid.ndim == 3 else np.zeros(1)
    rows = geometry.rows if isinstance(geometry, ConeBeam) else 1
    matrix = np.zeros(
        (z_axis.size, axes[-2].size, axes[-1].size, geometry.views, rows, geometry.columns)
    )
    u = geometry.column_positions
    for v, beta in enumerate(geometry.angles):
        for iy, y in enumerate(axes[-2]):
            for ix, x in enumerate(axes[-1]):
                across = -x * math.sin(beta) + y * math.cos(beta)
                weight = stretch = 1.0
                position = across
                if not isinstance(geometry, ParallelBeam):
                    source = geometry.sod * np.array([math.cos(beta), math.sin(beta)])
                    depth = geometry.sod - (x * math.cos(beta) + y * math.sin(beta))
                    if geometry.detector == "flat":
                        position = geometry.sdd * across / depth
                        distance = depth
                    else:
                        position = geometry.sdd * math.atan2(across, depth)
                        distance = math.hypot(x - source[0], y - source[1])
                    weight, stretch = (geometry.sod / distance) ** 2, geometry.sdd / distance
                hat = np.zeros(geometry.columns)
                k = float(np.clip(np.interp(position, u, np.arange(u.size)), 0, u.size - 1))
                hat[int(k)] += 1 - (k - int(k))
                hat[min(int(k) + 1, u.size - 1)] += k - int(k)
                for iz, z in enumerate(z_axis):
                    row_hat = np.ones(1)
                    if isinstance(geometry, ConeBeam):
                        p = geometry.row_positions
                        r = float(np.interp(z * stretch, p, np.arange(p.size)))
                        row_hat = np.zeros(p.size)
                        row_hat[int(r)] += 1 - (r - int(r))
                        row_hat[min(int(r) + 1, p.size - 1)] += r - int(r)
                    matrix[iz, iy, ix, v] = weight * row_hat[:, None] * hat
    if not isinstance(geometry, ParallelBeam):
        y, x = axes[-2:]
        matrix[:, np.hypot(y[:, None], x[None, :]) > geometry.fov_radius] = 0.0
    return torch.from_numpy(matrix.reshape(grid.voxels, -1))


def test_backprojector_equals_the_dense_reference(case):
    geometry, grid = case
    matrix = dense(lambda d: backproject(d, geometry, grid), geometry.shape)
    torch.testing.assert_close(matrix, reference_backprojection(geometry, grid), rtol=0, atol=1e-10)


def test_transposes_are_exact(case):
    geometry, grid = case
    plan = BackprojectionPlan(geometry, grid, DetectorWindow.full(geometry))
    forward = dense(plan.forward, geometry.shape)
    transpose = dense(plan.transpose, grid.shape)
    torch.testing.assert_close(transpose, forward.T, rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["parallel", "fan-curved-short", "fan-turned", "fan-symmetric"])
def test_slices_of_a_batch_have_the_bits_of_one(name, dtype):
    geometry, grid = CASES[name]
    data = torch.randn((9, *geometry.shape), generator=torch.Generator().manual_seed(3)).to(dtype)
    alone = torch.stack([backproject(d, geometry, grid) for d in data])
    assert torch.equal(backproject(data, geometry, grid), alone)


@pytest.mark.parametrize("pixel", [0.05, 0.9, 1.9, 4.0])
@pytest.mark.parametrize("center", [(0.0, 0.0), (1.3, -2.1)])
def test_columns_are_interpolated_in_single_precision_at_any_step(pixel, center):
    """Few or many columns lie between neighbouring pixels, in rising and in falling order."""
    grid = VolumeGrid((5, 21), pixel, center)
    geometry = FanBeam(full_turn(8), 300, 500, 161, 1.0, 0.0, "curved")
    window = DetectorWindow.full(geometry)
    if pixel < 1.0:
        window = footprint(geometry, grid, margin=1)
    data = torch.randn(geometry.shape, generator=torch.Generator().manual_seed(4)).cumsum(1)
    found = backproject(
        DetectorWindow.full(geometry).crop(data[:, None], window)[:, 0], geometry, grid, window
    )
    exact = backproject(data.double(), geometry, grid)
    torch.testing.assert_close(found.double(), exact, rtol=0, atol=2e-3)


@pytest.mark.parametrize("name", ["parallel", "fan-curved-short", "cone-curved"])
def test_filter_transpose_is_exact(name):
    geometry, _ = CASES[name]
    window = DetectorWindow.full(geometry)
    plan = FilterPlan(geometry, ("bone", "standard"), angular_weights(geometry), window, window)
    shape = (window.views, window.rows, window.columns)
    assert mismatch(plan.forward, plan.transpose, (3, *shape), (3, 2, *shape)) < 1e-15


# forward-mode AD of PyTorch itself still goes through torch.jit
@pytest.mark.filterwarnings("ignore:.*torch.jit.script.*")
def test_gradients_of_first_and_second_order(case):
    geometry, grid = case
    data = torch.randn(
        geometry.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2)
    )
    data.requires_grad_()

    def run(s: torch.Tensor) -> torch.Tensor:
        return 100.0 * fbp(s, geometry, grid, ("soft", "bone"))

    assert torch.autograd.gradcheck(run, (data,), fast_mode=True, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(lambda s: run(s) ** 2, (data,), fast_mode=True)


def test_vmap_and_leading_axes(case):
    geometry, grid = case
    data = torch.randn(
        (2, 3, *geometry.shape), dtype=torch.float64, generator=torch.Generator().manual_seed(3)
    )
    whole = fbp(data, geometry, grid, ["soft", "ram-lak"])
    assert whole.shape == (2, 2, 3, *grid.shape)
    for i in range(2):
        for j in range(3):
            one = torch.stack([fbp(data[i, j], geometry, grid, k) for k in ("soft", "ram-lak")])
            torch.testing.assert_close(whole[:, i, j], one, rtol=0, atol=1e-12)
    mapped = torch.vmap(lambda s: fbp(s, geometry, grid, "soft"), in_dims=1, out_dims=1)(data)
    torch.testing.assert_close(mapped, whole[0], rtol=0, atol=1e-12)
    strided = data.flip(1).transpose(-1, -2).contiguous().transpose(-1, -2)
    assert not strided.is_contiguous()
    torch.testing.assert_close(
        fbp(strided, geometry, grid, "soft"), whole[0].flip(1), rtol=0, atol=1e-12
    )
    assert fbp(data[:, :0], geometry, grid).shape == (2, 0, *grid.shape)


def test_modes_threads_and_buffers(case):
    geometry, grid = case
    data = torch.randn(geometry.shape, generator=torch.Generator().manual_seed(4))
    kept = data.clone()
    first = fbp(data, geometry, grid)
    snapshot = first.clone()
    fbp(2 * data, geometry, grid)
    assert torch.equal(first, snapshot)
    assert torch.equal(data, kept)
    with torch.inference_mode():
        assert torch.equal(fbp(data, geometry, grid), snapshot)
    threads = get_num_threads()
    try:
        set_num_threads(1)
        filtered = filter_sinogram(data, geometry)
        alone = backproject(filtered, geometry, grid)
        set_num_threads(threads)
        assert torch.equal(backproject(filtered, geometry, grid), alone)
    finally:
        set_num_threads(threads)


@pytest.mark.parametrize("columns", [61, 400], ids=["fft", "matrix"])
@pytest.mark.parametrize("detector", ["flat", "curved"])
def test_windows_change_nothing(columns, detector):
    """Filtering into, and out of, windows that follow an inset equals cropping the whole."""
    geometry = ConeBeam(
        full_turn(24), 600, 1000, columns, 8, (2.0, 400 / columns), (0, 0.3), detector
    )
    grid = VolumeGrid((4, 6, 5), 2.0, (1.0, 31.0, -25.0))
    window = footprint(geometry, grid, margin=1)
    data = torch.randn(
        (2, *geometry.shape), dtype=torch.float64, generator=torch.Generator().manual_seed(5)
    )
    index = torch.from_numpy(window.column_indices)[:, None, :].expand(
        24, window.rows, window.columns
    )
    rows = slice(window.first_row, window.first_row + window.rows)

    def crop(x: torch.Tensor) -> torch.Tensor:
        return torch.take_along_dim(
            x[..., rows, :], index.expand(*x.shape[:-3], *index.shape), dim=-1
        )

    names = ("standard", "bone")
    whole = filter_sinogram(data, geometry, names)
    inside = filter_sinogram(data, geometry, names, window)
    torch.testing.assert_close(inside, crop(whole), rtol=0, atol=1e-12 * float(whole.abs().max()))
    volume = backproject(whole, geometry, grid)
    torch.testing.assert_close(
        backproject(inside, geometry, grid, window), volume, rtol=0, atol=1e-12
    )
    torch.testing.assert_close(fbp(data, geometry, grid, names), volume, rtol=0, atol=1e-12)

    source = DetectorWindow(
        np.clip(window.first_column - 2, 0, None), window.columns, window.first_row, window.rows
    )
    small = torch.randn((2, 24, source.rows, source.columns), dtype=torch.float64)
    padded = torch.zeros((2, *geometry.shape), dtype=torch.float64)
    place = torch.from_numpy(source.column_indices)[:, None, :].expand(
        2, 24, source.rows, source.columns
    )
    padded[:, :, rows] = padded[:, :, rows].scatter(-1, place, small)
    expected = crop(filter_sinogram(padded, geometry, names))
    actual = filter_sinogram(small, geometry, names, window, held=source)
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-12 * float(expected.abs().max()))


def test_chunks_change_nothing(monkeypatch):
    geometry, _ = CASES["cone-curved"]
    data = torch.randn((2, *geometry.shape), dtype=torch.float64)
    whole = filter_sinogram(data, geometry)
    monkeypatch.setattr(filter_plan, "CHUNK_BYTES", 1)
    torch.testing.assert_close(filter_sinogram(data, geometry), whole, rtol=0, atol=1e-12)
    gradient = torch.randn_like(whole)
    window = DetectorWindow.full(geometry)
    plan = FilterPlan(geometry, ("standard",), angular_weights(geometry), window, window)
    assert plan.chunk == 1
    mismatch = (whole * gradient).sum() - (data * plan.transpose(gradient.unsqueeze(1))).sum()
    assert abs(mismatch) < 1e-12 * whole.norm() * gradient.norm()
