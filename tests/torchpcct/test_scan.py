"""Scans: files, logarithms, refusals."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

import torchpcct
from recon import reconstruct
from recon.analytic.inset import InsetFbp
from torchpcct import ConeBeam, FanBeam, Scan, VectorGeometry, Volume, VolumeGrid, acquire, full_turn
from torchpcct.files import seal
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene

INSET = VolumeGrid((6, 36, 36), 0.25, (0.0, -30.38, -29.63))


def scanner(views=60):
    s = presets.pcct(views=views)
    return s.replace(geometry=replace(s.geometry, rows=8))


SCENE, _ = plaque_scene(vessel_length=6.2)
REGION = VolumeGrid((1, 1, 1), (6.4, 9.0, 9.0), INSET.center)


@pytest.fixture(scope="module")
def clean():
    return acquire(SCENE, scanner(), region=REGION, duty=0.03, sub_rays=16)


@pytest.fixture(scope="module")
def whole():
    return acquire(SCENE, scanner(), duty=0.03, sub_rays=16)


@pytest.mark.parametrize("noisy", [False, True])
def test_round_trip(tmp_path, clean, noisy):
    scan = clean.with_noise(0.35, 7) if noisy else clean
    scan.save(tmp_path / "scan.h5")
    back = Scan.load(tmp_path / "scan.h5")
    assert torch.equal(back.counts, scan.counts)
    assert torch.equal(back.air, scan.air)
    assert torch.equal(back.surround, scan.surround)
    assert back.window == scan.window
    assert back.geometry == scan.geometry
    assert (back.exposure_s, back.seed) == (scan.exposure_s, scan.seed)
    assert back.info["scanner"] == scan.info["scanner"]
    assert torch.equal(back.line_integrals(), scan.line_integrals())


def test_whole_scan_round_trip(tmp_path, whole):
    whole.save(tmp_path / "scan.h5")
    back = Scan.load(tmp_path / "scan.h5")
    assert back.window is None
    assert torch.equal(back.counts, whole.counts)


def test_truncated_foreign_and_newer_files(tmp_path, clean):
    clean.save(tmp_path / "scan.h5")
    content = (tmp_path / "scan.h5").read_bytes()
    for share in (0.1, 0.5, 0.99):
        (tmp_path / "cut.h5").write_bytes(content[: int(share * len(content))])
        with pytest.raises(ValueError, match=r"cut\.h5"):
            Scan.load(tmp_path / "cut.h5")
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["counts"] = np.zeros(3)
    with pytest.raises(ValueError, match="not a torchpcct scan"):
        Scan.load(tmp_path / "foreign.h5")
    with h5py.File(tmp_path / "scan.h5", "a") as file:
        file.attrs["version"] = 99
    seal(tmp_path / "scan.h5")
    with pytest.raises(ValueError, match="update torchpcct"):
        Scan.load(tmp_path / "scan.h5")
    with pytest.raises(FileNotFoundError):
        Scan.load(tmp_path / "none.h5")


def test_nothing_is_half_written(tmp_path, clean, monkeypatch):
    def fail(self, group):
        raise KeyboardInterrupt

    monkeypatch.setattr(type(clean.linearisation), "save", fail)
    with pytest.raises(KeyboardInterrupt):
        clean.save(tmp_path / "scan.h5")
    assert list(tmp_path.iterdir()) == []


def test_noise_on_noise_is_refused(clean):
    with pytest.raises(ValueError, match="noisy"):
        clean.with_noise(0.35, 0).with_noise(0.35, 1)


def test_the_logarithm_of_counts_is_finite_and_unbiased(clean):
    """E[ln(N + ½)] − ln λ falls as λ⁻²: below 1e-3 from λ = 20 on; zero counts stay finite."""
    flat = replace(
        clean,
        counts=torch.full_like(clean.counts, 20.0),
        linearisation=replace(
            clean.linearisation,
            coefficients=np.ones((clean.geometry.columns, 1)),
            scale=np.full(clean.geometry.columns, 10.0),
        ),
    )
    truth = float((flat._at_window(flat.air.log()) - np.log(20.0)).double().mean())
    noisy = flat.with_noise(1.0, 0)
    measured = noisy.line_integrals().double()
    standard_error = float(measured.sub(noisy._at_window(noisy.air.log())).std()) / np.sqrt(measured.numel())
    assert abs(float(measured.mean()) - truth) < 1e-4 + 1 / (24 * 400) + 4 * standard_error
    starved = flat.with_noise(1e-3, 0)
    assert (starved.counts == 0).float().mean() > 0.9
    assert torch.isfinite(starved.line_integrals()).all()


def test_inset_from_the_window_equals_the_fbp_of_whole_rows(clean, whole):
    for kernel in ("soft", "bone"):
        a = reconstruct(clean, INSET, "fbp", kernel=kernel)
        b = reconstruct(whole, INSET, "fbp", kernel=kernel)
        torch.testing.assert_close(a.data, b.data, atol=0.05, rtol=0)
        assert a.report["kernel"] == kernel


def test_noise_beyond_the_window_does_not_matter(clean, whole):
    """Noise is drawn around the inset's footprint only: the inset's noise is the same to a few per mille."""
    noise_a = (
        InsetFbp(clean, [INSET], ["soft"])(clean.with_noise(2.0, 3))[0] - InsetFbp(clean, [INSET], ["soft"])(clean)[0]
    )
    noise_b = (
        InsetFbp(whole, [INSET], ["soft"])(whole.with_noise(2.0, 3))[0] - InsetFbp(whole, [INSET], ["soft"])(whole)[0]
    )
    assert float((noise_a - noise_b).square().mean() / noise_b.square().mean()) < 2e-3


def test_refusals_of_reconstruct(clean):
    with pytest.raises(ValueError, match="unknown method"):
        reconstruct(clean, INSET, "magic")
    with pytest.raises(ValueError, match="kernel"):
        reconstruct(clean, INSET, "fbp", kernel="hard")
    with pytest.raises(ValueError, match=r"field of view|region"):
        reconstruct(clean, VolumeGrid((4, 4, 4), 0.2, (0, 0, 400.0)), "fbp")
    with pytest.raises(ValueError, match="region"):
        reconstruct(clean, VolumeGrid((4, 4, 4), 0.2, (0, 0, 60.0)), "fbp")
    with pytest.raises(ValueError, match="too few photons"):
        reconstruct(clean.with_noise(1e-5, 0), INSET, "fbp")
    with pytest.raises(TypeError, match="Scan"):
        reconstruct("scan.h5", INSET)


def test_noise_falls_with_the_square_root_of_dose():
    """log σ against log exposure over the inset's voxels: slope −0.50 ± 0.015 from 0.35 to 2.8 s."""
    clean = acquire(SCENE, scanner(240), region=REGION, duty=0.1, sub_rays=16)
    fbp = InsetFbp(clean, [INSET], ["soft"])
    truth = fbp(clean)[0]
    exposures = np.array([0.35, 0.7, 2.0, 2.8])
    sd = [np.sqrt(np.mean([float((fbp(clean.with_noise(e, s))[0] - truth).square().mean()) for s in range(4)]))
          for e in exposures]  # fmt: skip
    assert np.polyfit(np.log(exposures), np.log(sd), 1)[0] == pytest.approx(-0.5, abs=0.015)


def test_exact_roi_covariance_matches_monte_carlo():
    from recon.analytic.exact_noise import roi_covariance
    from torchpcct.metrics.roi import RoiMean, axial_grid

    clean = acquire(SCENE, scanner(120), region=REGION, duty=0.05, sub_rays=16)
    fbp = InsetFbp(clean, [INSET], ["soft", "bone"])
    image = axial_grid(INSET.center)
    y, x = np.meshgrid(image.axes[1] - INSET.center[1], image.axes[2] - INSET.center[2], indexing="ij")
    rois = [RoiMean(INSET, image, np.hypot(y, x - c) < 0.5) for c in (1.5, 0.0)]
    exact = roi_covariance(clean, fbp, [rois], 2.0)[0]
    runs = []
    for seed in range(60):
        volumes = fbp(clean.with_noise(2.0, seed))[0]
        runs.append([[float(roi(v)) for roi in rois] for v in volumes])
    runs = np.array(runs)
    expected = np.array([[float(roi(v)) for roi in rois] for v in fbp(clean)[0]])
    for k in range(2):
        sd = np.sqrt(np.diag(exact[k]))
        # Four standard errors of a mean and of an SD from 60 runs.
        assert (np.abs(runs[:, k].mean(0) - expected[k]) < 4 * sd / np.sqrt(60)).all()
        np.testing.assert_allclose(runs[:, k].std(0, ddof=1), sd, rtol=4 / np.sqrt(120))
        correlation = exact[k, 0, 1] / sd.prod()
        assert np.corrcoef(runs[:, k].T)[0, 1] == pytest.approx(correlation, abs=0.5)


def test_views_in_any_order_give_the_same_volume(clean):
    g = clean.geometry
    order = np.random.default_rng(0).permutation(g.views)
    window = replace(clean.window, first_column=clean.window.first_column[order])
    shuffled = replace(clean, geometry=g.select(order), counts=clean.counts[order], window=window)
    a, b = reconstruct(clean, INSET, "fbp").data, reconstruct(shuffled, INSET, "fbp").data
    torch.testing.assert_close(a, b, atol=0.02, rtol=0)
    assert full_turn(g.views).shape == (g.views,)


def test_a_lower_dose_of_a_measured_scan(clean):
    """As noisy as a scan that was simulated at that dose, cell by cell of many realisations; all bins by themselves."""
    high = [clean.with_noise(2.0, k).at_dose(0.25, k) for k in range(24)]
    low = [clean.with_noise(0.5, 100 + k) for k in range(24)]
    assert high[0].exposure_s == pytest.approx(0.5)
    torch.testing.assert_close(high[0].air, low[0].air)
    torch.testing.assert_close(high[0].surround, low[0].surround)
    assert high[0].info["lower_dose"] == {"fraction": 0.25, "seed": 0, "exact": True}
    variance = [torch.stack([s.line_integrals() for s in scans]).var(0).mean() for scans in (high, low)]
    n = clean.counts.numel() * 23
    assert float(variance[0] / variance[1]) == pytest.approx(1.0, abs=4.5 * (4 / n) ** 0.5 + 0.002)
    mean = torch.stack([s.counts for s in high]).mean() / torch.stack([s.counts for s in low]).mean()
    assert float(mean) == pytest.approx(1.0, abs=4.5 * float(2 / low[0].counts.sum() / 24) ** 0.5)


def test_a_lower_dose_of_what_holds_no_photons_is_refused(clean):
    with pytest.raises(ValueError, match="with_noise"):
        clean.at_dose(0.5)
    noisy = clean.with_noise(1.0, 0)
    for fraction in (0.0, 1.5, float("nan")):
        with pytest.raises(ValueError, match="fraction must be"):
            noisy.at_dose(fraction)
    fan = FanBeam(full_turn(8), 600.0, 1000.0, 16, 1.0)
    lines = torch.rand(8, 16, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="photons="):
        Scan.from_line_integrals(lines, fan).at_dose(0.5)
    known = Scan.from_line_integrals(lines, fan, photons=1e5).at_dose(0.5)
    assert known.info["lower_dose"]["exact"] is False
    assert float((known.line_integrals() - lines).abs().max()) < 0.1


def test_a_lower_dose_keeps_dead_readings_dead():
    fan = FanBeam(full_turn(8), 600.0, 1000.0, 16, 1.0)
    counts = torch.full((8, 16), 1000.0)
    counts[:, 3] = float("nan")
    low = Scan.from_counts(counts, fan, air=2000.0).at_dose(0.1, 2)
    assert low.dead is not None
    assert low.dead[:, 3].all()
    assert int(low.dead.sum()) == 8


def test_scans_geometries_and_volumes_print_in_a_few_lines():
    """Hundreds of lines of angles once, of tensors besides."""
    geometry = ConeBeam(full_turn(720), 600.0, 1000.0, 888, 2, 1.0)
    scan = Scan.from_line_integrals(np.full(geometry.shape, 0.1), geometry, photons=1e4)
    volume = Volume(torch.zeros(2, 3, 4), VolumeGrid((2, 3, 4), 1.0), {"method": "fbp"})
    for printed in map(repr, (geometry, VectorGeometry.of(geometry), scan, volume)):
        assert len(printed) < 400
        assert printed.count("\n") <= 2
    assert "angles=720 views, 0° … 359.5°" in repr(geometry)
    assert "720 × 2 × 888 line integrals" in repr(scan)
    assert "0 … 0 HU, fbp" in repr(volume)
    assert set(torchpcct.__all__) <= set(dir(torchpcct))
