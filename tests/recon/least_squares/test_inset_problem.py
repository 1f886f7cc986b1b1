"""Model-based reconstruction of an inset from a scan: units, convergence, batches, refusals."""

import gc
import weakref
from dataclasses import replace

import pytest
import torch
from refusals import refused
from small_scan import GRID

from recon import reconstruct
from recon.least_squares.inset_problem import InsetProblem
from recon.least_squares.qggmrf import QGGMRF
from torchpcct import VolumeGrid

WEAK = QGGMRF(strength=1e-3, threshold=300.0)


def inner(volume):
    """Means in the ball's middle and in the fat beside it."""
    return float(volume[3:5, 8:10, 8:10].mean()), float(volume[3:5, :2, :2].mean())


def test_noise_free_values_in_hu(clean, problem):
    volume = reconstruct(clean, GRID, "pwls", prior=WEAK, problem=problem)
    ball, fat = inner(volume.data)
    reference = inner(reconstruct(clean, GRID, "fbp", kernel="soft").data)
    assert fat == pytest.approx(reference[1], abs=3)
    # of the transmitted spectrum, see the paper's target of 100
    assert ball == pytest.approx(97.0, abs=8)
    assert volume.report["converged"]
    assert volume.report["rmsd_hu"][-1] <= volume.report["tolerance_hu"]
    assert volume.report["exact_pairs"] >= 1


def test_batch_equals_single(clean, problem):
    scans, seen = [clean.with_noise(2.0, s) for s in range(3)], []
    options = {"prior": WEAK, "problem": problem, "tolerance": 0.02, "max_exact": 30}
    together = reconstruct(scans, GRID, "pwls", **options, batch=2, progress=seen.append)
    assert seen == [pytest.approx(2 / 3), 1.0]
    for scan, volume in zip(scans, together, strict=True):
        alone = reconstruct(scan, GRID, "pwls", **options)
        assert float((alone.data - volume.data).square().mean().sqrt()) < 0.1


def test_readings_of_a_problem_are_prepared_once_and_released_with_their_scan(
    clean, problem, monkeypatch
):
    looked_at, data = [], InsetProblem.data
    monkeypatch.setattr(
        InsetProblem, "data", lambda self, scan: looked_at.append(id(scan)) or data(self, scan)
    )
    scan = clean.with_noise(2.0, 11)
    options = {"problem": problem, "tolerance": 5.0}
    first, second = (reconstruct(scan, GRID, "pwls", **options).data for _ in range(2))
    assert looked_at == [id(scan)]
    assert torch.equal(first, second)
    moved = problem.with_motion(torch.full((scan.geometry.views, 3), 0.1).numpy())
    moved.given(scan)  # of another problem: other readings
    assert len(looked_at) == 2
    scan.counts.mul_(1.001)
    assert not torch.equal(reconstruct(scan, GRID, "pwls", **options).data, first)
    assert len(looked_at) == 3
    alive = weakref.ref(problem.given(scan)[0])
    del scan
    gc.collect()
    assert alive() is None


def test_prior_lowers_the_noise(clean, problem):
    """Noise (noisy − noise free) inside the inset: below that of the standard kernel, and
    falling with the strength."""
    noisy = clean.with_noise(0.35, 5)

    def noise(method, **options):
        difference = (
            reconstruct(noisy, GRID, method, **options).data
            - reconstruct(clean, GRID, method, **options).data
        )
        return float(difference[2:-2, 4:-4, 4:-4].std())

    fbp = noise("fbp", kernel="standard")
    strong, stronger = (noise("pwls", prior=QGGMRF(s, 300.0), problem=problem) for s in (0.5, 4.0))
    assert stronger < strong < fbp


def test_an_unfinished_iteration_warns_on_the_volume(clean, problem):
    with pytest.warns(RuntimeWarning, match="raise max_exact"):
        volume = reconstruct(
            clean, GRID, "pwls", prior=WEAK, problem=problem, tolerance=1e-9, max_exact=1
        )
    assert "raise max_exact" in volume.report["warnings"][0]
    assert reconstruct(clean, GRID, "pwls", prior=WEAK, problem=problem).report["warnings"] == []


def test_refusals(clean):
    whole = replace(clean, geometry=clean.geometry, window=clean.window)
    with pytest.raises(ValueError, match="one exposure"):
        reconstruct([clean.with_noise(t, 0) for t in (1.0, 2.0)], GRID, "pwls", batch=2)
    spectral = replace(
        whole, counts=clean.counts[None], air=clean.air[None], exterior=clean.exterior[None]
    )
    refused(
        ("energy of its quanta", lambda: InsetProblem(replace(clean, counting=False), GRID)),
        ("counting-mode", lambda: reconstruct(spectral, GRID, "pwls")),
        (
            "region",
            lambda: reconstruct(clean, VolumeGrid((8, 18, 18), 0.4, (0.0, 0.0, 60.0)), "pwls"),
        ),
    )


def test_the_default_prior_follows_the_noise(clean, problem):
    """A hundredth of the dose: 10 times the noise; a threshold in HU/mm would let single voxels
    pass as edges (21)."""
    found, thresholds = {}, {}
    for exposure in (2.0, 0.02):
        volume = reconstruct(
            clean.with_noise(exposure, 0), GRID, "pwls", problem=problem, tolerance=3.0
        )
        found[exposure] = float((volume.data - volume.data.mean()).std())
        thresholds[exposure] = volume.report["threshold_hu_per_mm"]
    assert thresholds[0.02] == pytest.approx(10 * thresholds[2.0], rel=1e-3)
    assert found[0.02] < 14 * found[2.0]
