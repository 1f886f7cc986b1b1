"""Model-based reconstruction with the learned network, from a scan to HU."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from certificate import certificate
from small_scan import CENTER, GRID

from recon import reconstruct
from recon.mbir.mbir import Mbir, average_onto, working_grid
from recon.mbir.minimise import minimise, minimise_passes
from recon.mbir.prior import PriorConfig
from recon.mbir.unrolled import Unrolled
from recon.pwls.inset_problem import InsetProblem
from torchpcct import VolumeGrid
from torchpcct.volume import to_hu


@pytest.fixture(scope="module")
def network():
    """An untrained network for voxels of 0.4 mm that has seen the scans of these tests."""
    torch.manual_seed(0)
    model = Unrolled(PriorConfig(levels=2, filters=12, units=4, voxel_mm=0.4), 6)
    model.seen_scale_hu = torch.tensor([10.0, 2000.0])
    return Mbir(model)


def test_report(clean, problem, network):
    noisy = clean.with_noise(4.0, 3)
    volume = reconstruct(noisy, GRID, "mbir", network=network, problem=problem, noise_map=True)
    report = volume.report
    assert report["method"] == "mbir"
    assert report["iterations"] == 6
    assert 0 < report["residual"] < 1
    assert report["chi2"] == pytest.approx(1.0, abs=0.05)
    assert report["warnings"] == []
    assert report["noise_sd_hu"].shape == GRID.shape
    assert 1 < float(report["noise_sd_hu"].mean()) < 200


def test_noise_free_values_in_hu(clean, problem, network):
    """Without the learned part the energy is quadratic and weak: means in the ball and in fat are those of FBP."""
    model = Unrolled(network.model.prior.config, 6)
    with torch.no_grad():
        model.prior.gain.fill_(-60.0)
        model.prior.along[0] = -60.0
    found, fbp = (
        reconstruct(clean, GRID, method, **options).data
        for method, options in (
            ("mbir", {"network": Mbir(model), "problem": problem, "converge": True}),
            ("fbp", {"kernel": "soft"}),
        )
    )
    for place in (np.s_[3:5, 8:10, 8:10], np.s_[3:5, :2, :2]):
        assert float(found[place].mean()) == pytest.approx(float(fbp[place].mean()), abs=5)


def test_noise_map_is_the_noise(clean, problem, network):
    """Against the standard deviation over realisations."""
    scans = [clean.with_noise(2.0, s) for s in range(24)]
    volumes = reconstruct(scans, GRID, "mbir", network=network, problem=problem)
    measured = torch.stack([v.data for v in volumes]).var(0).mean().sqrt()
    estimated = network.noise_map(problem, problem.statistic(scans[0]).b, 2.0, draws=16).square().mean().sqrt()
    assert float(estimated / measured) == pytest.approx(1.0, abs=0.15)


def test_converged_energy_has_a_certificate(clean, problem, network):
    scan = clean.with_noise(1.0, 0)
    one = reconstruct(scan, GRID, "mbir", network=network, problem=problem)
    more = reconstruct(scan, GRID, "mbir", network=network, problem=problem, converge=True)
    assert more.report["residual"] <= 1e-3 < one.report["residual"]
    assert more.report["iterations"] > one.report["iterations"] == 6


@pytest.fixture(scope="module")
def twice(network):
    """The same network with a second pass."""
    model = Unrolled(network.model.prior.config, 6, (1.0, 0.3))
    model.load_state_dict(network.model.state_dict())
    return Mbir(model)


def test_residual_is_that_of_the_last_pass(clean, problem, twice):
    """Of the volume that is returned, by its definition, with the first pass that it was made with."""
    scan = clean.with_noise(1.0, 0)
    normal = twice.problem(problem, problem.statistic(scan).b[None], 1.0)
    for converge in (False, True):
        u1 = twice.model.descend(normal, twice.model.vessel_smoothing(normal))
        if converge:
            u1 = minimise(twice.model, normal, u1)[0]
        volume = reconstruct(scan, GRID, "mbir", network=twice, problem=problem, converge=converge)
        u = (volume.data[None] - to_hu(problem.level, problem.mu_ref)) / normal.scale_hu
        expected = float(certificate(twice.model, normal, u1, u))
        assert volume.report["residual"] == pytest.approx(expected, rel=0.01)
        assert (expected <= 1e-3) == converge
        assert volume.report.get("converged", False) == converge


def test_a_run_that_stops_early_says_so(clean, problem, twice, monkeypatch, caplog):
    monkeypatch.setattr("recon.mbir.mbir.minimise_passes", partial(minimise_passes, most=2))
    scan = clean.with_noise(1.0, 0)
    report = reconstruct(scan, GRID, "mbir", network=twice, problem=problem, converge=True).report
    assert not report["converged"]
    assert report["iterations"] == 6 + 2 + 2
    assert any("not converged" in text for text in report["warnings"])
    assert "not converged" in caplog.text


@pytest.fixture(scope="module")
def fine(clean):
    """The problem on the voxels of the shipped weights."""
    return InsetProblem(clean, VolumeGrid((16, 36, 36), 0.2, CENTER))


@pytest.mark.parametrize(("exposure", "distance"), [(0.35, 12.0), (2.0, 6.5)])
def test_shipped_steps_against_their_own_limit(clean, fine, exposure, distance):
    """The limit does not depend on the start; the unrolled steps end 9.5 HU from it at 0.35 s, 5.0 HU at 2 s.

    Other noise ends up to 10.2 and 5.3 HU away, one pass alone 44 and 25 HU.
    """
    shipped, scan = Mbir.load(), clean.with_noise(exposure, 0)
    unrolled = reconstruct(scan, fine.grid, "mbir", network=shipped, problem=fine)
    limit = reconstruct(scan, fine.grid, "mbir", network=shipped, problem=fine, converge=True)
    normal = shipped.problem(fine, fine.statistic(scan).b[None], exposure)
    other, report = minimise_passes(shipped.model, normal, torch.zeros_like(normal.beta))
    assert limit.report["converged"]
    assert limit.report["residual"] <= 1e-3 < unrolled.report["residual"]
    assert max(report["residual"]) <= 1e-3

    def rms(difference):
        return float(difference.square().mean().sqrt())

    assert rms(shipped._hu(fine, other, normal)[0] - limit.data) < 0.5
    assert 1.0 < rms(unrolled.data - limit.data) < distance


def test_wrong_exposure_is_noticed(clean, problem, network, caplog):
    scan = clean.with_noise(1.0, 0)
    wrong = replace(scan, exposure_s=4.0, counts=scan.counts * 4.0)
    volume = reconstruct(wrong, GRID, "mbir", network=network, problem=problem)
    assert volume.report["chi2"] > 2
    assert any("noise variance" in text for text in volume.report["warnings"])
    assert "noise variance" in caplog.text


def test_unseen_dose_is_noticed(clean, problem, network):
    model = Unrolled(network.model.prior.config, 6)
    model.seen_scale_hu = torch.tensor([50.0, 60.0])
    volume = reconstruct(clean.with_noise(0.01, 0), GRID, "mbir", network=Mbir(model), problem=problem)
    assert any("outside of the 50…60 HU" in text for text in volume.report["warnings"])


def test_other_voxels_are_averages_of_the_working_grid(clean, network):
    coarse = VolumeGrid((4, 9, 9), 0.8, CENTER)
    fine = working_grid(coarse, 0.4)
    assert fine.shape == (8, 18, 18)
    scan = clean.with_noise(4.0, 0)
    whole = reconstruct(scan, fine, "mbir", network=network).data
    averaged = whole.reshape(4, 2, 9, 2, 9, 2).mean(dim=(1, 3, 5))
    torch.testing.assert_close(reconstruct(scan, coarse, "mbir", network=network).data, averaged, rtol=1e-4, atol=0.02)


@pytest.mark.parametrize("voxel", [0.2, 0.25, 0.3, 0.4])
def test_averages_keep_a_ramp(voxel):
    target = VolumeGrid((5, 6, 7), voxel, (1.0, -2.0, 3.0))
    source = working_grid(target, 0.2)
    z, y, x = np.meshgrid(*source.axes, indexing="ij")
    ramp = torch.from_numpy(1.0 + 2 * z - y + 3 * x)
    z, y, x = np.meshgrid(*target.axes, indexing="ij")
    expected = 1.0 + 2 * z - y + 3 * x
    inner = (slice(1, -1),) * 3
    np.testing.assert_allclose(average_onto(ramp, source, target).numpy()[inner], expected[inner], atol=0.35 * 0.2)


def test_refusals(clean, problem, network, tmp_path):
    with pytest.raises(ValueError, match="another grid"):
        reconstruct(clean, VolumeGrid((4, 9, 9), 0.4, CENTER), "mbir", network=network, problem=problem)
    with pytest.raises(ValueError, match="one exposure"):
        reconstruct([clean.with_noise(t, 0) for t in (1.0, 2.0)], GRID, "mbir", network=network, problem=problem)
    coarse = InsetProblem(clean, VolumeGrid((4, 9, 9), 0.8, CENTER))
    with pytest.raises(ValueError, match=r"voxels of 0\.4 mm"):
        network(coarse, torch.zeros(1, 4, 9, 9), 1.0)
    with pytest.raises(FileNotFoundError, match="no weights"):
        Mbir.load(tmp_path / "none.safetensors")
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(b"not weights")
    with pytest.raises(ValueError, match="holds no weights"):
        Mbir.load(bad)


def test_shadow_of_dead_readings(clean, problem, network):
    """Readings without a count give a finite volume: the logarithm is bounded, the weight is the expected one."""
    scan = clean.with_noise(0.5, 1)
    scan.counts[::10] = 0
    volume = reconstruct(scan, GRID, "mbir", network=network, problem=problem)
    assert torch.isfinite(volume.data).all()
    assert volume.report["warnings"]
    assert math.isfinite(volume.report["chi2"])


def test_metal_is_outside_of_what_the_prior_knows(network):
    scale = float(network.model.seen_scale_hu.mean())
    assert network.check(scale, 1.0, 1800.0) == []
    assert any("metal" in text for text in network.check(scale, 1.0, 3000.0))
