"""What every projector must do, over the registry of geometries; degenerate sizes, extreme
numbers, odd orders."""

import math
import tracemalloc

import numpy as np
import pytest
import torch
from analytic import Gaussian, line_integrals, rasterize
from geometries import REGISTRY
from linear_maps import mismatch
from torch.autograd import gradcheck, gradgradcheck

from torchpcct.detector_window import footprint
from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid, full_turn
from torchpcct.projector import Projector
from torchpcct.projector.cpu import cone_passes
from torchpcct.threads import get_num_threads, set_num_threads

NAMES = sorted(REGISTRY)
EPS = {torch.float32: 1e-6, torch.float64: 1e-13}


def _projector(name: str) -> Projector:
    return Projector(*REGISTRY[name])


def _random(shape, dtype=torch.float64, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_adjoint_is_the_transpose(name, dtype):
    A = _projector(name)
    assert mismatch(A, A.T, A.domain_shape, A.range_shape, dtype) <= EPS[dtype]


@pytest.mark.parametrize("name", NAMES)
def test_dense_matrix_of_both_directions_agrees(name):
    A = _projector(name)
    n, m = torch.Size(A.domain_shape).numel(), torch.Size(A.range_shape).numel()
    forward = A(torch.eye(n, dtype=torch.float64).reshape(n, *A.domain_shape)).reshape(n, m)
    # Cone-beam volumes pass one by one: a random part of the readings.
    some = torch.randperm(m, generator=torch.Generator().manual_seed(0))[
        : 120 if len(A.domain_shape) == 3 else m
    ]
    adjoint = A.T(torch.eye(m, dtype=torch.float64)[some].reshape(-1, *A.range_shape)).reshape(
        -1, n
    )
    torch.testing.assert_close(
        forward[:, some], adjoint.T, rtol=0, atol=1e-12 * float(forward.abs().max())
    )
    assert float(forward.min()) > -1e-12 * float(forward.max())


@pytest.mark.parametrize(
    "name", ["parallel_half_turn", "fan_window", "cone_window", "cone_curved_offset"]
)
def test_gradients_of_first_and_second_order(name):
    A = _projector(name)
    x = _random((2, *A.domain_shape)).requires_grad_()
    y = _random((2, *A.range_shape)).requires_grad_()
    assert gradcheck(A, x, fast_mode=True)
    assert gradcheck(A.T, y, fast_mode=True)
    square = lambda t: A(t) ** 2  # noqa: E731
    assert gradgradcheck(square, x, fast_mode=True)


SOME = [
    "parallel_half_turn",
    "fan_flat",
    "fan_flat_offset_shifted_grid",
    "fan_symmetric_shifted_grid",
    "cone_curved_offset",
    "cone_window",
]


# --- geometry -------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-3, 7.0, 1e4])
def test_scaling_every_length_scales_the_line_integrals(scale):
    def build(s):
        geometry = ConeBeam(
            full_turn(4, 0.1), 60 * s, 110 * s, 14, 9, (1.8 * s, 2.5 * s), (0.2 * s, 0.5 * s)
        )
        return Projector(
            geometry, VolumeGrid((5, 7, 6), (1.5 * s, 2 * s, 2.2 * s), (0.4 * s, s, -2 * s))
        )

    x = _random((5, 7, 6))
    torch.testing.assert_close(build(scale)(x), build(1.0)(x) * scale, rtol=1e-9, atol=1e-9 * scale)


def test_source_inside_the_circumscribed_circle_is_right():
    grid = VolumeGrid((30, 100), 1.0)  # reaches 52 mm; the source passes 40 mm above its middle
    geometry = FanBeam([math.pi / 2, math.pi / 2 + 0.2], 40.0, 110.0, 80, 2.0)
    body = Gaussian((1.0, 3.0), (3.0, 4.0))
    exact = line_integrals(geometry, [body], sub=5)
    found = Projector(geometry, grid)(torch.as_tensor(rasterize(grid, [body]))).numpy()
    assert np.linalg.norm(found - exact) < 1e-2 * np.linalg.norm(exact)


@pytest.mark.parametrize("name", ["parallel_half_turn", "fan_flat", "cone_flat"])
def test_views_in_any_order_and_repeated(name):
    geometry, grid, _ = REGISTRY[name]
    order = np.array([3, 1, 3, 0, 2, 1])
    x = _random(grid.shape)
    whole = Projector(geometry, grid)(x)
    torch.testing.assert_close(
        Projector(geometry.select(order), grid)(x), whole[order], rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize(
    ("name", "operations", "reach"),
    [
        ("fan_flat", 8, 0),
        ("fan_symmetric_shifted_grid", 8, 2),
        ("fan_symmetric_grid_off_by_parts_of_a_voxel", 8, 3),
        ("fan_quarter_column_shifted_grid", 4, 2),
        ("fan_mirrored_views_shifted_grid", 2, 0),
        ("parallel_symmetric_shifted_grid", 4, 3),
    ],
)
def test_symmetric_views_share_work_and_read_the_same(name, operations, reach):
    geometry, grid, _ = REGISTRY[name]
    A = Projector(geometry, grid)
    passes = A._engine.cpu
    x = _random((3, *grid.shape))
    assert (passes.operations, len(passes.tables(np.dtype(np.float64), passes.lanes(3)).reach)) == (
        operations,
        reach,
    )
    singly = torch.cat(
        [Projector(geometry.select([v]), grid)(x) for v in range(geometry.views)], dim=-2
    )
    # A ray along an exact diagonal takes rows or columns; its symmetric copies may take the other.
    even = geometry.columns % 2 == 0 or geometry.offset != 0
    torch.testing.assert_close(
        A(x), singly, rtol=0, atol=(1e-12 if even else 0.2) * float(singly.abs().max())
    )


@pytest.mark.parametrize("name", ["fan_window", "cone_window"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_window_is_exactly_the_crop(name, dtype):
    geometry, grid, window = REGISTRY[name]
    x = _random(grid.shape, dtype)
    whole = Projector(geometry, grid)(x)
    rows = slice(window.first_row, window.first_row + window.rows)
    columns = torch.as_tensor(window.column_indices)
    if whole.dim() == 2:
        crop = whole.gather(1, columns)
    else:
        crop = whole[:, rows].gather(2, columns[:, None].expand(-1, window.rows, -1))
    tolerance = 1e-6 if dtype == torch.float32 else 1e-14
    torch.testing.assert_close(
        Projector(geometry, grid, window)(x), crop, rtol=0, atol=tolerance * float(crop.abs().max())
    )


def test_cells_much_larger_than_the_grid_conserve_mass():
    geometry = ParallelBeam([0.0, 0.5, 2.0], 3, 1e4)
    x = torch.rand(6, 5, dtype=torch.float64)
    y = Projector(geometry, VolumeGrid((6, 5), 1.0))(x)
    assert (y.sum(-1) * 1e4).numpy() == pytest.approx(float(x.sum()), rel=1e-9)


def test_cells_of_a_tenth_of_a_micrometre_add_up_to_a_larger_cell():
    x = torch.rand(6, 5, dtype=torch.float64)
    grid = VolumeGrid((6, 5), 1.0)
    fine = Projector(ParallelBeam([0.0, 0.5, 2.0], 40, 1e-4, 0.3), grid)(x)
    coarse = Projector(ParallelBeam([0.0, 0.5, 2.0], 1, 40e-4, 0.3), grid)(x)
    torch.testing.assert_close(fine.mean(-1), coarse[:, 0], rtol=1e-9, atol=0)


# --- numbers --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SOME)
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_nan_and_inf_reach_every_reading_that_sees_them(name, bad):
    A = _projector(name)
    x = torch.zeros(A.domain_shape)
    voxel = tuple(n // 2 for n in A.domain_shape)
    x[voxel] = 1.0
    seen = A(x) > 1e-3
    assert seen.any()
    x[voxel] = bad
    assert not torch.isfinite(A(x)[seen]).any()
    y = torch.zeros(A.range_shape)
    cell = tuple(int(i[0]) for i in seen.nonzero(as_tuple=True))
    y[cell] = 1.0
    touched = A.T(y) > 1e-3
    y[cell] = bad
    assert not torch.isfinite(A.T(y)[touched]).any()


# --- operator -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_one_thread_or_two_give_the_same_bits(name):
    A = _projector(name)
    x, y = _random((2, *A.domain_shape), torch.float32), _random((2, *A.range_shape), torch.float32)
    threads = get_num_threads()
    results = []
    try:
        for n in (1, 2, 3, 1):
            set_num_threads(n)
            results.append((A(x), A.T(y)))
    finally:
        set_num_threads(threads)
    for other in results[1:]:
        assert torch.equal(results[0][0], other[0])
        assert torch.equal(results[0][1], other[1])


@pytest.mark.parametrize("name", SOME)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batches_of_any_size_and_layout(name, dtype):
    """Of a cone beam a batch is its single volumes to the bit."""
    A = _projector(name)
    close = (
        {"rtol": 0, "atol": 0}
        if len(A.domain_shape) == 3
        else {"rtol": 100 * EPS[dtype], "atol": 10 * EPS[dtype]}
    )
    x = _random((11, *A.domain_shape), dtype)
    whole = A(x)
    for n in (0, 1, 2, 3, 9):
        torch.testing.assert_close(A(x[:n]), whole[:n], **close)
        assert A(x[:n]).shape == (n, *A.range_shape)
    assert A(x[:0].reshape(0, 3, *A.domain_shape)).shape == (0, 3, *A.range_shape)
    assert A.T(A(x[:0])).shape == (0, *A.domain_shape)
    torch.testing.assert_close(A(x[:6].reshape(2, 3, *A.domain_shape)).flatten(0, 1), whole[:6])
    flipped = x.transpose(-1, -2).contiguous().transpose(-1, -2)
    assert not flipped.is_contiguous() or min(A.domain_shape[-2:]) == 1
    torch.testing.assert_close(A(flipped), whole)
    torch.testing.assert_close(torch.stack([A(one) for one in x]), whole, **close)
    torch.testing.assert_close(torch.stack([A.T(one) for one in whole]), A.T(whole), **close)


def test_volumes_of_a_batch_are_projected_together(monkeypatch):
    A = _projector("cone_window")
    passes = A._engine.cpu
    most = passes.together(8)
    sizes = []
    for name in ("project", "backproject"):
        kernel = getattr(cone_passes, name)
        monkeypatch.setattr(
            cone_passes, name, lambda *a, k=kernel: sizes.append(len(a[-1])) or k(*a)
        )
    A.T(A(_random((most + 2, *A.domain_shape))))
    assert sizes == [most, 2] * 2
    # Of large volumes one alone fits the cache.
    monkeypatch.setattr(cone_passes, "TOGETHER_BYTES", 1)
    assert passes.together(8) == 1


def test_columns_without_readings_add_nothing_and_take_nothing():
    A = _projector("cone_window")
    y = _random(A.range_shape)
    columns = y.shape[-1]
    alone = torch.where(torch.arange(columns) == torch.arange(columns)[:, None, None, None], y, 0.0)
    torch.testing.assert_close(A.T(alone).sum(0), A.T(y))
    # NaN is a reading, and so are two that cancel.
    bad = torch.zeros(A.range_shape, dtype=y.dtype)
    bad[1, 2, columns // 2] = math.nan
    assert bool(A.T(bad).isnan().any())
    bad[1, 2, columns // 2], bad[1, 3, columns // 2] = 1.0, -1.0
    assert bool(A.T(bad).any())


@pytest.mark.parametrize("name", SOME)
def test_calls_do_not_share_buffers(name):
    A = _projector(name)
    x = _random(A.domain_shape)
    first = A(x)
    copy = first.clone()
    second = A(2 * x)
    assert torch.equal(first, copy)
    assert first.data_ptr() != second.data_ptr()
    back = A.T(first)
    copy = back.clone()
    A.T(second)
    assert torch.equal(back, copy)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script.*")  # raised inside torch.func.jvp
@pytest.mark.parametrize("name", ["fan_flat", "cone_window"])
def test_modes_and_torch_func(name):
    A = _projector(name)
    assert A.T.T is A
    assert A.T.domain_shape == A.range_shape
    x, t = _random((3, *A.domain_shape)), _random((3, *A.domain_shape), seed=1)
    with torch.inference_mode():
        inferred = A(x)
    with torch.no_grad():
        assert not A(x.clone().requires_grad_()).requires_grad
    torch.testing.assert_close(inferred.clone(), A(x))
    torch.testing.assert_close(torch.func.vmap(A)(x), A(x))
    torch.testing.assert_close(torch.func.vmap(A, in_dims=1)(x.transpose(0, 1).contiguous()), A(x))
    value, tangent = torch.func.jvp(A, (x,), (t,))
    torch.testing.assert_close(value, A(x))
    torch.testing.assert_close(tangent, A(t))
    _, pull = torch.func.vjp(A, x)
    y = A(t)
    torch.testing.assert_close(pull(y)[0], A.T(y))
    gradient = torch.func.grad(lambda z: (A(z) ** 2).sum())(x)
    torch.testing.assert_close(gradient, 2 * A.T(A(x)))


@pytest.mark.parametrize("batch", [1, 3])
def test_memory_estimate_is_an_upper_bound_and_not_far_off(batch):
    geometry = ConeBeam(full_turn(60), 626.0, 1098.0, 400, 40, (0.5, 0.35), detector="curved")
    grid = VolumeGrid((56, 45, 45), 0.2)
    A = Projector(geometry, grid, footprint(geometry, grid))
    x = _random((batch, *A.domain_shape), torch.float32)
    A.T(A(x))
    peaks = []
    for operator, given in ((A, x), (A.T, A(x))):
        tracemalloc.start()
        operator(given)
        peaks.append(tracemalloc.get_traced_memory()[1] + given.numel() * 4)
        tracemalloc.stop()
    assert max(peaks) <= A.memory_estimate(batch) <= 2.5 * max(peaks)
    assert A.memory_estimate(batch, torch.float64) > 1.5 * A.memory_estimate(batch)
    assert A.memory_estimate(0) == 0


@pytest.mark.parametrize("name", ["cone_window", "fan_flat", "fan_window"])
def test_working_memory_does_not_grow_with_the_batch(name):
    A = Projector(*REGISTRY[name])

    def working(batch: int) -> int:
        arrays = 4 * batch * (math.prod(A.domain_shape) + math.prod(A.range_shape))
        return A.memory_estimate(batch) - arrays

    assert working(8) == working(16) == working(1000)


@pytest.mark.parametrize("name", ["cone_window", "cone_flat"])
def test_chunks_of_views_give_the_same_bits(name, monkeypatch):
    A = Projector(*REGISTRY[name])
    y = _random((2, *A.range_shape), torch.float32)
    whole = A.T(y)
    assert A._engine.cpu.views_at_once(4) == A.range_shape[0]
    monkeypatch.setattr(cone_passes, "ROW_SUMS_BYTES", 2 * A._engine.cpu.bytes(4)[2])
    assert A._engine.cpu.views_at_once(4) == 2
    assert torch.equal(A.T(y), whole)


def test_nan_and_inf_do_not_leak_into_other_cells_of_slabs_far_apart():
    # Slabs farther apart than the depth layers are interpolated one by one, through a buffer that
    # cells share.
    A = Projector(*REGISTRY["cone_flat"])
    x = torch.zeros(A.domain_shape, dtype=torch.float64)
    x[:, 0, 0] = float("nan")
    hit = torch.zeros(A.domain_shape, dtype=torch.float64)
    hit[:, 0, 0] = 1.0
    clean = A(hit).abs().amax(dim=-2, keepdim=True) == 0  # columns that miss the voxel in all rows
    assert clean.any()
    assert not A(x).isnan()[clean.expand(A.range_shape)].any()
