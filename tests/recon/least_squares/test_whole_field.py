"""PWLS of whole fields of view: dense float64 minima, monotony, honest stops, the choice of the
model, memory."""

import itertools
import math

import numpy as np
import pytest
import torch
from inset_operators import HU, dense, minimum, problem

from recon.gram.gram import Gram
from recon.least_squares import field_model
from recon.least_squares.field_model import (
    SECTORS,
    SECTORS_BESIDE_COARSE_SCAN,
    FieldModel,
)
from recon.least_squares.field_problem import field_prior
from recon.least_squares.pwls import Approach, data_model, pwls
from recon.least_squares.qggmrf import QGGMRF, quadratic
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Projector, VolumeGrid, full_turn
from torchpcct.vector_geometry import VectorGeometry

EDGE = QGGMRF(0.3, 4.0, relative=True)
# Nearly flat where noise makes gradients of thousands of HU/mm: converges slowly.
FLAT = QGGMRF(0.3, 300.0)
SCANS = {
    # A dead column runs through all views.
    "parallel": (
        ParallelBeam(torch.arange(40).numpy() * math.pi / 40, 26, 1.0),
        VolumeGrid((18, 18), 1.0),
    ),
    "short fan": (
        FanBeam(full_turn(60)[:36], 90.0, 150.0, 48, 1.0),
        VolumeGrid((20, 22), 1.0, (1.0, -0.5)),
    ),
    "cone": (ConeBeam(full_turn(40), 60.0, 100.0, 30, 14, 1.2), VolumeGrid((5, 12, 12), 1.2)),
}


@pytest.fixture(scope="module", params=list(SCANS))
def scan(request):
    """A, noisy data, weights that change by an order of magnitude, the float64 matrix."""
    geometry, grid = SCANS[request.param]
    A = Projector(geometry, grid)
    r = [torch.from_numpy(a) for a in grid.axes]
    y, x = torch.meshgrid(r[-2], r[-1], indexing="ij")
    body = 0.02 * (torch.hypot(y, x) < 0.4 * grid.extent[-1]) + 0.02 * (
        torch.hypot(y - 2, x + 3) < 2
    )
    truth = body.expand(grid.shape).float()
    lines = A(truth)
    w = 4e4 * torch.exp(-4 * lines / lines.max())
    if request.param == "parallel":
        w[:, 9] = 0
    data = (
        lines
        + torch.randn(lines.shape, generator=torch.Generator().manual_seed(3))
        / w.clamp_min(1).sqrt()
    )
    return A, data, w, dense(A)


def test_voxels_too_large_for_the_reference_frequency():
    """Voxels of 2 mm do not hold 0.5 lp/mm: their information is read off where they do (once it
    was negative)."""
    geometry = FanBeam(full_turn(120), 600.0, 1000.0, 150, 500.0 / 150)
    weights = torch.full(geometry.shape, 1e5)
    small, large = (
        FieldModel(Projector(geometry, VolumeGrid((n, n), 200.0 / n)), weights).information(HU)
        for n in (96, 64)
    )
    assert 0.5 < small / large < 1.0


def exact_minimum(matrix, A, y, w, bound):
    """With dense float64 matrices, to 1e-6 HU."""
    weights = w.double().flatten()
    H, b = matrix.T @ (weights[:, None] * matrix), matrix.T @ (weights * y.double().flatten())
    return minimum(H, b, bound, A.domain_shape, 1e-6 * HU)


def energy(matrix, y, w, bound, x):
    residual = y.double().flatten() - matrix @ x.double().flatten()
    return float(0.5 * (w.double().flatten() * residual.square()).sum() + bound.value(x.double()))


def hu_rms(a, b):
    return float((a.double() - b.double()).square().mean().sqrt()) / HU


@pytest.mark.parametrize("prior", [quadratic(0.3), EDGE], ids=["quadratic", "edge-preserving"])
def test_finds_the_dense_minimum(scan, prior):
    A, y, w, matrix = scan
    bound = prior.bind(FieldModel(A, w).information(HU), A.grid.spacing, HU)
    exact = exact_minimum(matrix, A, y, w, bound)
    found = pwls(A, y, w, prior, mu_per_hu=HU, tolerance=0.5)
    assert found.report["converged"]
    assert found.report["model"] == "gradient"
    assert hu_rms(found.volume, exact) < 1.0
    assert hu_rms(found.volume, exact) < 3 * found.report["rmsd_hu"][-1]
    residual = (w * (y - A(found.volume)).square()).sum() / (w > 0).sum()
    assert found.report["misfit"] == [pytest.approx(float(residual), rel=1e-3)]


def test_every_pair_lowers_the_objective(scan):
    """From a start that is far, from one that is near, and from the minimum itself."""
    A, y, w, matrix = scan
    bound = EDGE.bind(FieldModel(A, w).information(HU), A.grid.spacing, HU)
    exact = exact_minimum(matrix, A, y, w, bound)
    noise = torch.randn(A.domain_shape, generator=torch.Generator().manual_seed(1))
    model = FieldModel(A, w)
    for start in (3000 * HU * noise, exact.float() + 5 * HU * noise, exact.float()):
        values = [energy(matrix, y, w, bound, start)]
        for pairs in range(2, 9):
            x = pwls(
                A,
                y,
                w,
                bound,
                mu_per_hu=HU,
                gram=model,
                start=start,
                tolerance=1e-9,
                max_exact=pairs,
            ).volume
            values.append(energy(matrix, y, w, bound, x))
        slack = 1e-6 * energy(matrix, y, w, bound, torch.zeros(A.domain_shape))
        assert all(b <= a + slack for a, b in itertools.pairwise(values)), values


@pytest.mark.extended
def test_batch_is_each_alone(scan):
    A, y, w, _ = scan
    both = pwls(A, torch.stack([y, 0.5 * y]), w, EDGE, mu_per_hu=HU, tolerance=0.3)
    assert len(both.report["misfit"]) == 2
    for data, x in zip((y, 0.5 * y), both.volume, strict=True):
        assert hu_rms(x, pwls(A, data, w, EDGE, mu_per_hu=HU, tolerance=0.3).volume) < 1.0


def test_voxels_that_some_views_miss_converge_last_and_that_is_said():
    """Corners beyond the field of view hang on the prior alone; inside, the volume is at the
    minimum long before."""
    A = Projector(
        ParallelBeam(torch.arange(40).numpy() * math.pi / 40, 26, 1.0), VolumeGrid((24, 24), 1.0)
    )
    r = torch.hypot(*torch.meshgrid(*[torch.from_numpy(a) for a in A.grid.axes], indexing="ij"))
    y = A((0.02 * (r < 10)).float())
    w = 4e4 * torch.exp(-4 * y / y.max())
    matrix = dense(A)
    bound = EDGE.bind(FieldModel(A, w).information(HU), A.grid.spacing, HU)
    exact = exact_minimum(matrix, A, y, w, bound)
    found = pwls(A, y, w, bound, mu_per_hu=HU, tolerance=1.0)
    assert hu_rms(found.volume[r < 11], exact[r < 11]) < 2.0
    assert found.report["rmsd_hu"][-1] > hu_rms(found.volume, exact) / 3


def test_a_flat_prior_is_not_called_converged_before_it_is(scan):
    A, y, w, matrix = scan
    bound = FLAT.bind(FieldModel(A, w).information(HU), A.grid.spacing, HU)
    exact = exact_minimum(matrix, A, y, w, bound)
    for pairs in (20, 60):
        found = pwls(A, y, w, bound, mu_per_hu=HU, tolerance=1.0, max_exact=pairs)
        assert found.report["rmsd_hu"][-1] > hu_rms(found.volume, exact) / 3


@pytest.fixture(scope="module")
def flat_faces():
    """A disc across the axis of a cone beam: off the middle slice no ray runs along its faces."""
    A = Projector(ConeBeam(full_turn(48), 100.0, 160.0, 48, 48, 1.2), VolumeGrid((24, 24, 24), 1.1))
    z, y, x = torch.meshgrid(*[torch.from_numpy(a) for a in A.grid.axes], indexing="ij")
    lines = A((0.02 * ((torch.hypot(y, x) < 10) & (z.abs() < 8))).float())
    w = 1e5 * torch.exp(-lines)
    return (
        A,
        lines + torch.randn(lines.shape, generator=torch.Generator().manual_seed(0)) / w.sqrt(),
        w,
    )


def test_flat_faces_in_a_cone_beam_need_a_spectrum_of_their_own_slice(flat_faces, monkeypatch):
    A, y, w = flat_faces
    prior = QGGMRF(2.0, 4.0, relative=True)
    # As of operators that have no coarser scan.
    monkeypatch.setattr(field_model, "coarse_scan", lambda A, w: None)
    many = pwls(A, y, w, prior, mu_per_hu=HU, tolerance=0.1)
    monkeypatch.setattr(field_model, "FACTOR", math.inf)
    one = pwls(A, y, w, prior, mu_per_hu=HU, tolerance=0.1)
    assert many.report["converged"]
    assert one.report["converged"]
    assert many.report["exact_pairs"] < 0.6 * one.report["exact_pairs"]
    assert hu_rms(many.volume, one.volume) < 0.5


def test_slices_beyond_the_rows_do_not_slow_the_rest_down(monkeypatch):
    """A grid that is half again as high as what all views see, as many scans are reconstructed."""
    A = Projector(ConeBeam(full_turn(48), 100.0, 160.0, 40, 28, 1.2), VolumeGrid((30, 20, 20), 1.1))
    z, y, x = torch.meshgrid(*[torch.from_numpy(a) for a in A.grid.axes], indexing="ij")
    monkeypatch.setattr(field_model, "coarse_scan", lambda A, w: None)  # it knows such slices
    y = A((0.02 * ((torch.hypot(y, x) < 8) & (z.abs() < 7))).float())
    w = 1e5 * torch.exp(-y)
    assert float((FieldModel(A, w).seen == 0).float().mean()) > 0.1
    found = pwls(A, y, w, EDGE, mu_per_hu=HU, tolerance=0.3)
    monkeypatch.setattr(field_model, "LEAST_MET", 1e-4)
    slow = pwls(
        A, y, w, EDGE, mu_per_hu=HU, tolerance=0.3, max_exact=2 * found.report["exact_pairs"]
    )
    assert found.report["converged"]
    assert not slow.report["converged"]


def test_slices_share_the_field(flat_faces):
    A, _, w = flat_faces
    model = FieldModel(A, w)
    assert len(model.nodes) == field_model.NODES
    assert float(sum(s.square() for _, s in model.nodes).sub(1).abs().max()) < 1e-6
    # By symmetry the slices above the middle see what those below see; the further out, the less
    # along z.
    along = [float(k[:, 0, 0].log().mean()) for k, _ in model.nodes]
    assert along == pytest.approx(along[::-1], abs=0.1)
    assert along[0] < along[1] < along[2]
    parallel = VectorGeometry.of(ConeBeam(full_turn(48), 1e5, 1.6e5, 48, 48, 1.2))
    A = Projector(parallel, A.grid)
    assert len(FieldModel(A, torch.ones(A.range_shape)).nodes) == 1


def test_model_is_chosen_by_the_grid_and_dropped_by_its_misfit():
    A, w = problem(views=120, shape=(4, 9, 9), rows=6)
    assert isinstance(data_model(A, w), Gram)
    whole = Projector(*SCANS["cone"])
    assert isinstance(data_model(whole, torch.ones(whole.range_shape)), FieldModel)
    y = A(torch.full(A.domain_shape, 50 * HU))
    gram = Gram(A, w)
    prior = EDGE.bind(gram.information(HU), A.grid.spacing, HU)
    right = pwls(A, y, w, prior, mu_per_hu=HU, gram=gram, tolerance=0.05)
    assert right.report["model"] == "gram"
    assert right.report["model_misfit"] < 0.1
    wrong = pwls(A, y, w, prior, mu_per_hu=HU, gram=gram.scaled(20.0), tolerance=0.05)
    assert wrong.report["model_misfit"] > 1
    assert wrong.report["model"] == "gradient"
    assert wrong.report["converged"]
    assert hu_rms(right.volume, wrong.volume) < 0.2


def test_information_is_that_of_the_fft_model():
    A, w = problem(views=120, shape=(6, 21, 21), rows=8)
    gram, field = Gram(A, w), FieldModel(A, w)
    assert field.information(HU) == pytest.approx(gram.information(HU), rel=0.15)
    assert field.scaled(3.0).information(HU) == pytest.approx(3 * field.information(HU), rel=1e-6)


def test_memory_is_predicted_and_refused_before_anything_is_allocated(scan, monkeypatch):
    A, y, w, _ = scan
    monkeypatch.setattr(Projector, "forward", lambda self, x: pytest.fail("projected"))
    with pytest.raises(ValueError, match=r"needs .* GiB, 0.00 GiB are available"):
        pwls(A, y, w, EDGE, mu_per_hu=HU, memory=1000)
    big = Projector(
        ConeBeam(full_turn(4), 6000.0, 10000.0, 8, 8, 1.0), VolumeGrid((3000, 3000, 3000), 1e-3)
    )
    with pytest.raises(ValueError, match="larger or fewer voxels"):
        pwls(big, torch.zeros(big.range_shape), torch.ones(big.range_shape), EDGE, memory=2**38)


@pytest.mark.parametrize("offset_mm", [-80.0, -40.0, 80.0])
@pytest.mark.parametrize("views", [60, 360])
def test_voxels_that_no_ray_meets_have_a_scale(views, offset_mm):
    """A detector on one side of the axis leaves the middle unseen; what the backprojector leaves
    there is rounding, of either sign, and volumes were NaN by it."""
    geometry = FanBeam(full_turn(views), 500.0, 1000.0, 54, 1.0, offset=offset_mm)
    A = Projector(geometry, VolumeGrid((120, 160), 1.0))
    w = 1e3 + 1e3 * torch.rand(geometry.shape, generator=torch.Generator().manual_seed(1))
    model = FieldModel(A, w)
    assert model.scale.min() > 0.1 * model.scale.median()
    lines = A(torch.full(A.domain_shape, 0.02))
    found = pwls(A, lines, w, field_prior(1.0, 2), max_exact=10)
    assert torch.isfinite(found.volume).all()


def test_rays_that_miss_the_grid_are_refused():
    A = Projector(ParallelBeam([0.0, 1.0], 8, 1.0, 500.0), VolumeGrid((4, 4), 1.0))
    with pytest.raises(ValueError, match="no ray of positive weight"):
        pwls(A, torch.zeros(A.range_shape), torch.ones(A.range_shape), EDGE)


def test_the_distance_to_the_limit_of_a_geometric_approach():
    """Known exactly: x_k = 1 − 0.9ᵏ is 0.9ᵏ from its limit; an estimate may be high, by what the
    lag costs, not low."""
    where = torch.arange(500) < 400
    start = torch.zeros(2, 500)
    seen, beyond = Approach(start, where), Approach(start, ~where)
    scale = torch.tensor([[1.0], [0.5]])
    for k in range(1, 61):
        x = scale * torch.full((2, 500), 1 - 0.9**k)
        x[:, ~where] *= 7
        for approach in (seen, beyond):
            approach.add(x)
        if k >= 24:
            for approach, most in ((seen, 1.0), (beyond, 7.0)):
                assert most * 0.9**k <= approach.remaining() <= 6 * most * 0.9**k
    assert not Approach(start).known
    assert Approach(start, torch.zeros(500, dtype=torch.bool)).remaining() == 0.0


def test_an_approach_that_gets_faster_is_seen():
    """As conjugate gradients often do; by the last quarter of the way alone it would be 26 and
    62 times too long."""
    approach = Approach(torch.ones(1, 500, dtype=torch.float64))
    for k in range(1, 61):
        left = math.exp(-((k / 12) ** 1.5))
        approach.add(torch.full((1, 500), left, dtype=torch.float64))
        if k >= 20:
            assert left <= approach.remaining() <= 13 * left


def test_corners_do_not_hold_the_stop_and_are_reported():
    A = Projector(
        ParallelBeam(torch.arange(40).numpy() * math.pi / 40, 26, 1.0), VolumeGrid((26, 26), 1.0)
    )
    r = torch.hypot(*torch.meshgrid(*[torch.from_numpy(a) for a in A.grid.axes], indexing="ij"))
    w = 4e4 * torch.ones(A.range_shape)
    model = FieldModel(A, w)
    assert bool(model.determined[r < 12].all())
    assert not bool(model.determined[r > 15].any())
    report = pwls(
        A, A((0.02 * (r < 10)).float()), w, EDGE, mu_per_hu=HU, tolerance=1.0, gram=model
    ).report
    assert report["undetermined"] == pytest.approx(1 - float(model.determined.float().mean()))
    assert report["undetermined_rmsd_hu"] > 0


@pytest.mark.parametrize("kind", ["parallel", "fan"])
def test_the_model_knows_how_well_each_direction_is_seen(kind):
    """Behind a dense body off the axis some directions are dark: sectors of directions halve the
    model's error, at the angle of the rays, not of the views."""
    angles = full_turn(90)
    geometry = (
        ParallelBeam(angles, 60, 1.0)
        if kind == "parallel"
        else FanBeam(angles, 60.0, 90.0, 64, 1.4)
    )
    A = Projector(geometry, VolumeGrid((40, 40), 1.0))
    y, x = torch.meshgrid(*[torch.from_numpy(a) for a in A.grid.axes], indexing="ij")
    w = torch.exp(-0.4 * A(((x - 6) ** 2 + (3 * y) ** 2 < 100).float()))
    model, plain = FieldModel(A, w), FieldModel(A, w)
    plain._ways = None
    assert (len(model.terms), len(plain.terms)) == (SECTORS, 1)
    volumes = torch.randn(4, 40, 40, generator=torch.Generator().manual_seed(0))
    volumes = volumes * (x**2 + y**2 < 256)
    exact = A.T(w * A(volumes))
    left, before = (float((m.apply(volumes) - exact).norm() / exact.norm()) for m in (model, plain))
    assert left < 0.5 * before
    twice = model.scaled(2.0).apply(volumes)
    torch.testing.assert_close(twice, 2.0 * model.apply(volumes), rtol=1e-4, atol=1e-4)


def test_a_whole_field_takes_few_pairs():
    """An object of thick bone, edge-preserving: 52 pairs by the preconditioned gradient alone."""
    angles = np.arange(160) * np.pi / 160
    A = Projector(ParallelBeam(angles, 140, 1.0), VolumeGrid((112, 112), 1.0))
    y, x = torch.meshgrid(*[torch.from_numpy(a) for a in A.grid.axes], indexing="ij")
    r = torch.hypot(x / 0.8, y)
    head = 0.02 * (
        1.0 * (r < 50) + 1.0 * ((r < 50) & (r > 45)) + 0.05 * (torch.hypot(x - 12, y) < 8)
    )
    lines = A(head.float())
    w = 5e4 * torch.exp(-lines)
    noise = torch.randn(A.range_shape, generator=torch.Generator().manual_seed(1))
    report = pwls(
        A, lines + noise / w.sqrt(), w, field_prior(1.0, 2), mu_per_hu=HU, tolerance=1.0
    ).report
    assert report["converged"]
    assert report["exact_pairs"] <= 25


@pytest.mark.parametrize("shape", [(10, 24, 24), (10, 23, 26)], ids=["even", "odd"])
def test_the_coarser_scan_knows_waves_that_change_slowly_in_the_plane(shape):
    """Whatever the height, behind a dense body off the axis, in slices that some rows miss."""
    A = Projector(ConeBeam(full_turn(61), 60.0, 100.0, 60, 14, 1.2), VolumeGrid(shape, 1.0))
    _, y, x = torch.meshgrid(*[torch.from_numpy(a) for a in A.grid.axes], indexing="ij")
    w = torch.exp(-0.4 * A(((x - 4) ** 2 + (2 * y) ** 2 < 40).float()))
    model = FieldModel(A, w)
    assert model.coarse is not None
    assert len(model.terms) == SECTORS_BESIDE_COARSE_SCAN
    noise = torch.randn(A.domain_shape, generator=torch.Generator().manual_seed(0))
    fy, fx = torch.fft.fftfreq(shape[1])[:, None], torch.fft.rfftfreq(shape[2])
    slow = torch.fft.irfft2(torch.fft.rfft2(noise) * (torch.hypot(fy, fx) < 0.11), s=shape[1:])
    exact = A.T(w * A(slow))
    for m, factor in ((model, 1.0), (model.scaled(2.0), 2.0)):
        assert float((m.coarse.apply(slow) - factor * exact).norm() / exact.norm()) < 0.15 * factor


def test_a_coarser_scan_only_where_it_saves_something(scan):
    A, _, w, _ = scan
    assert (FieldModel(A, w).coarse is not None) == (A.grid.ndim == 3)
    moving = Projector(*SCANS["cone"], motion=np.zeros((40, 3)))
    assert FieldModel(moving, torch.ones(moving.range_shape)).coarse is None
    small = Projector(SCANS["cone"][0], VolumeGrid((5, 6, 12), 1.2))
    assert FieldModel(small, torch.ones(small.range_shape)).coarse is None


def test_plates_in_a_cone_beam_take_few_pairs():
    """Faces across the axis, where no ray runs along them: twice the pairs and more by models of
    places and directions alone."""
    A = Projector(ConeBeam(full_turn(61), 80.0, 130.0, 54, 50, 1.6), VolumeGrid((32, 32, 32), 1.0))
    z, y, x = torch.meshgrid(*[torch.from_numpy(a) for a in A.grid.axes], indexing="ij")
    r = torch.hypot(x, y)
    plates = 1.0 * ((r < 12) & (z.abs() < 12)) + 0.5 * ((r < 8) & (z.abs() < 10) & (z % 5 < 2))
    lines = A((0.125 * plates).float())
    w = 5e4 * torch.exp(-lines)
    noise = torch.randn(A.range_shape, generator=torch.Generator().manual_seed(1))
    y, prior = lines + noise / w.sqrt(), field_prior(1.0, 3)
    found = pwls(A, y, w, prior, mu_per_hu=1.25e-4, tolerance=1.0)
    without = FieldModel(A, w)
    without.coarse = None
    most = 2 * found.report["exact_pairs"]
    before = pwls(
        A, y, w, prior, mu_per_hu=1.25e-4, tolerance=1.0, gram=without, max_exact=most
    ).report
    assert found.report["converged"]
    assert not before["converged"]
