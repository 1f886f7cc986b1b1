"""Model-based reconstruction with the learned network, from a scan to HU."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_scan import CENTER, GRID

from recon import reconstruct
from recon.least_squares.inset_problem import InsetProblem
from recon.mbir.known import KnownImage
from recon.mbir.mbir import Mbir, average_onto, working_grid
from recon.mbir.network import NetworkConfig
from recon.mbir.unrolled import Unrolled, low_residual
from recon.vessel.known import KnownVessel
from torchpcct import Volume, VolumeGrid


@pytest.fixture(scope="module")
def network():
    """An untrained network for voxels of 0.4 mm that has seen the scans of these tests."""
    torch.manual_seed(0)
    model = Unrolled(NetworkConfig((6, 8, 8), 0.4), 2)
    torch.nn.init.normal_(model.network.leave.weight, std=0.01)
    model.seen_scale_hu = torch.tensor([10.0, 2000.0])
    return Mbir(model)


def test_report(clean, problem, network):
    noisy = clean.with_noise(4.0, 3)
    volume = reconstruct(noisy, GRID, "mbir", network=network, problem=problem, noise_map=True)
    report = volume.report
    assert report["method"] == "mbir"
    assert report["iterations"] == 2
    assert report["fidelity"] == network.fidelity
    assert 0 < report["residual"] < 1
    assert report["chi2"] == pytest.approx(1.0, abs=0.05)
    assert report["warnings"] == []
    assert report["noise_sd_hu"].shape == GRID.shape
    assert 1 < float(report["noise_sd_hu"].mean()) < 200


def test_noise_free_values_in_hu(clean, problem):
    """An untrained network adds nothing: a linear filter, means in the ball and in fat are those
    of FBP."""
    plain = Mbir(Unrolled(NetworkConfig((6, 8, 8), 0.4), 2), fidelity=1.0)
    found = reconstruct(clean, GRID, "mbir", network=plain, problem=problem).data
    fbp = reconstruct(clean, GRID, "fbp", kernel="soft").data
    for place in (np.s_[3:5, 8:10, 8:10], np.s_[3:5, :2, :2]):
        assert float(found[place].mean()) == pytest.approx(float(fbp[place].mean()), abs=6)


@pytest.mark.extended
def test_noise_map_is_the_noise(clean, problem, network):
    """Against the standard deviation over realisations."""
    scans = [clean.with_noise(2.0, s) for s in range(24)]
    volumes = reconstruct(scans, GRID, "mbir", network=network, problem=problem)
    measured = torch.stack([v.data for v in volumes]).var(0).mean().sqrt()
    estimated = network.noise_map(problem.term(scans[0]), draws=16).square().mean().sqrt()
    assert float(estimated / measured) == pytest.approx(1.0, abs=0.15)


def test_residual_and_chi2_by_their_definitions(clean, problem, network):
    """From the returned volume: what is left of the readings, weighed, per reading; and of their
    low frequencies."""
    scan = clean.with_noise(1.0, 0)
    report = (volume := reconstruct(scan, GRID, "mbir", network=network, problem=problem)).report
    x = (volume.data / 1000.0 + 1.0) * problem.mu_ref - problem.level
    y = problem.data(scan).double()
    rest = y - problem.projector(x).double()
    assert report["chi2"] == pytest.approx(
        float((problem.weights * rest.square()).sum() / y.numel()), rel=2e-3
    )
    normal = network.normal(problem.term(scan))
    u = x[None] * 1000.0 / problem.mu_ref / normal.unit_hu
    expected = float(low_residual(normal, normal.b - normal.apply(u), network.fidelity))
    assert report["residual"] == pytest.approx(expected, rel=0.01)


def test_fidelity(clean, problem, network):
    """By name or with the network; more of it, more of the data's noise; out of range: refused."""
    scan = clean.with_noise(1.0, 0)
    # what such a network takes away is much, and would come back
    bare = Mbir(network.model, restore=False)
    quiet, middle, sharp = (
        reconstruct(scan, GRID, "mbir", network=bare, problem=problem, fidelity=fidelity)
        for fidelity in (0.0, 0.5, 1.0)
    )
    assert [v.report["fidelity"] for v in (quiet, middle, sharp)] == [0.0, 0.5, 1.0]
    assert float(quiet.data.std()) < float(middle.data.std()) < float(sharp.data.std())
    kept = reconstruct(
        scan, GRID, "mbir", network=Mbir(network.model, 1.0, restore=False), problem=problem
    )
    assert torch.equal(kept.data, sharp.data)
    with pytest.raises(ValueError, match="fidelity"):
        reconstruct(scan, GRID, "mbir", network=network, problem=problem, fidelity=1.5)


def test_wrong_exposure_is_noticed(clean, problem, network, caplog):
    scan = clean.with_noise(1.0, 0)
    wrong = replace(scan, exposure_s=4.0, counts=scan.counts * 4.0)
    volume = reconstruct(wrong, GRID, "mbir", network=network, problem=problem)
    assert volume.report["chi2"] > 2
    assert any("noise variance" in text for text in volume.report["warnings"])
    assert "noise variance" in caplog.text


def test_unseen_dose_is_noticed(clean, problem, network):
    model = Unrolled(network.model.network.config, 2)
    model.seen_scale_hu = torch.tensor([50.0, 60.0])
    volume = reconstruct(
        clean.with_noise(0.01, 0), GRID, "mbir", network=Mbir(model), problem=problem
    )
    assert any("outside of the 50…60 HU" in text for text in volume.report["warnings"])


def test_other_voxels_are_averages_of_the_working_grid(clean, network):
    coarse = VolumeGrid((4, 9, 9), 0.8, CENTER)
    fine = working_grid(coarse, 0.4)
    assert fine.shape == (8, 18, 18)
    scan = clean.with_noise(4.0, 0)
    whole = reconstruct(scan, fine, "mbir", network=network).data
    averaged = whole.reshape(4, 2, 9, 2, 9, 2).mean(dim=(1, 3, 5))
    torch.testing.assert_close(
        reconstruct(scan, coarse, "mbir", network=network).data, averaged, rtol=1e-4, atol=0.02
    )


@pytest.mark.parametrize("voxel", [0.2, 0.25, 0.3, 0.4])
def test_averages_keep_a_ramp(voxel):
    target = VolumeGrid((5, 6, 7), voxel, (1.0, -2.0, 3.0))
    source = working_grid(target, 0.2)
    z, y, x = np.meshgrid(*source.axes, indexing="ij")
    ramp = torch.from_numpy(1.0 + 2 * z - y + 3 * x)
    z, y, x = np.meshgrid(*target.axes, indexing="ij")
    expected = 1.0 + 2 * z - y + 3 * x
    inner = (slice(1, -1),) * 3
    np.testing.assert_allclose(
        average_onto(ramp, source, target).numpy()[inner], expected[inner], atol=0.35 * 0.2
    )


def test_refusals(clean, problem, network, tmp_path):
    with pytest.raises(ValueError, match="another grid"):
        reconstruct(
            clean, VolumeGrid((4, 9, 9), 0.4, CENTER), "mbir", network=network, problem=problem
        )
    coarse = InsetProblem(clean, VolumeGrid((4, 9, 9), 0.8, CENTER))
    with pytest.raises(ValueError, match=r"voxels of 0\.4 mm"):
        network(coarse.term(clean))
    with pytest.raises(FileNotFoundError, match="no weights"):
        Mbir.load(tmp_path / "none.safetensors")
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(b"not weights")
    with pytest.raises(ValueError, match="holds no weights"):
        Mbir.load(bad)


def test_scans_of_several_exposures_may_be_one_batch(clean, problem, network):
    scans = [clean.with_noise(t, 0) for t in (1.0, 2.0)]
    given = {"network": network, "problem": problem}
    together = reconstruct(scans, GRID, "mbir", **given)
    for scan, volume in zip(scans, together, strict=True):
        alone = reconstruct(scan, GRID, "mbir", **given)
        torch.testing.assert_close(volume.data, alone.data, rtol=0, atol=1e-2)
        assert volume.report["noise_scale_hu"] == alone.report["noise_scale_hu"]


def test_shadow_of_dead_readings(clean, problem, network):
    """Readings without a count give a finite volume: the logarithm is bounded, the weight is the
    expected one."""
    scan = clean.with_noise(0.5, 1)
    scan.counts[::10] = 0
    volume = reconstruct(scan, GRID, "mbir", network=network, problem=problem)
    assert torch.isfinite(volume.data).all()
    assert volume.report["warnings"]
    assert math.isfinite(volume.report["chi2"])


def test_metal_is_outside_of_what_the_prior_knows(network):
    scale = float(network.model.seen_scale_hu.mean())
    assert network.check([scale], 1800.0) == []
    assert any("metal" in text for text in network.check([scale], 3000.0))
    # A tooth in mm⁻¹ reaches 4 mm⁻¹: no metal, no HU, and both ends of its noise in one sentence.
    texts = network.check([1e4, 2e4], 2e5, "mm^-1", 0.02)
    assert len(texts) == 2
    assert not any("HU" in text or "metal" in text for text in texts)
    assert "the noise scale of the scan, 0.2 mm^-1 and 0.4 mm^-1, lies outside" in texts[0]
    assert "the volume reaches 4.02 mm^-1" in texts[1]


@pytest.fixture
def always_known(monkeypatch):
    """Something is known of every scan."""

    def image_of(self, term, fidelity):
        image = torch.full(term.shape, -90.0)
        image[2:6, 6:10, 6:10] = 60.0
        return KnownImage(image)

    monkeypatch.setattr(KnownVessel, "image_of", image_of)


def test_a_volume_says_what_was_drawn_and_what_that_changed(
    clean, problem, network, always_known, tmp_path
):
    scan = clean.with_noise(2.0, 1)
    given = {"network": network, "problem": problem}
    plain = reconstruct(scan, GRID, "mbir", **given)
    assert "vessel" not in plain.report
    volume = reconstruct(scan, GRID, "mbir", vessel=True, **given)
    assert volume.report["vessel"] == {"used": True}
    assert any("may be missing" in text for text in volume.report["warnings"])
    changed = volume.report["vessel_difference_hu"]
    assert float(changed.abs().max()) > 1.0
    torch.testing.assert_close(volume.data - changed, plain.data, rtol=0, atol=1e-3)
    volume.save(tmp_path / "v.h5")
    again = Volume.load(tmp_path / "v.h5").report
    assert torch.equal(again["vessel_difference_hu"], changed)
    assert again["vessel"] == {"used": True}
