"""Scans: files, logarithms, refusals."""

import copy
import math
import pickle
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from refusals import refused

import torchpcct
import torchpcct.spectral  # a submodule that no other import here need load
from recon import reconstruct
from recon.analytic.inset import InsetFbp
from torchpcct import (
    ConeBeam,
    FanBeam,
    ParallelBeam,
    Scan,
    VectorGeometry,
    Volume,
    VolumeGrid,
    acquire,
    full_turn,
)
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


def same_scan(a, b):
    tensors = ("counts", "air", "exterior", "quantum", "dead")
    plain = (
        "geometry",
        "window",
        "exposure_s",
        "seed",
        "counting",
        "logged",
        "unit",
        "info",
        "electronic_noise",
    )
    return (
        all(
            (x is None) == (y is None) and (x is None or (x.dtype == y.dtype and torch.equal(x, y)))
            for x, y in ((getattr(a, n), getattr(b, n)) for n in tensors)
        )
        and [getattr(a, n) for n in plain] == [getattr(b, n) for n in plain]
        and np.array_equal(a.linearisation.coefficients, b.linearisation.coefficients)
        and np.array_equal(a.linearisation.scale, b.linearisation.scale)
        and a.linearisation.mu_ref == b.linearisation.mu_ref
        and torch.equal(a.line_integrals(), b.line_integrals())
    )


CONE = ConeBeam(full_turn(12), 150.0, 250.0, 14, 6, 1.3)
FAN = FanBeam(full_turn(8), 150.0, 250.0, 12, 2.0)
SCANS = {
    "windowed": lambda clean: clean,
    "noisy": lambda clean: clean.with_noise(0.35, 7),
    "whole": lambda clean: acquire(SCENE, presets.pcct(views=4, rows=2), duty=0.03, sub_rays=16),
    "energy-integrating": lambda clean: acquire(
        SCENE, presets.eid(views=4, rows=2), exposure_s=0.35, sub_rays=16
    ),
    "line integrals": lambda clean: Scan.from_line_integrals(
        np.full(FAN.shape, 0.3), FAN, photons=1e5, mu_water=0.02
    ),
    "view by view": lambda clean: Scan.from_counts(
        np.full(CONE.shape, 7.0),
        VectorGeometry.of(CONE).turned(0.05, 0.07).shifted(0.25, 0.5),
        air=9.0,
        dead=np.arange(14) == 3,
    ),
    "a plane view by view": lambda clean: Scan.from_line_integrals(
        np.full(FAN.shape, 0.3), VectorGeometry.of(FAN)
    ),
}


@pytest.mark.parametrize("kind", SCANS)
def test_files_keep_every_scan(tmp_path, clean, kind):
    """What was saved comes back to the bit, and so does what is made of it; files are plain HDF5
    for others."""
    scan = SCANS[kind](clean)
    scan.save(tmp_path / "scan.h5")
    back = Scan.load(tmp_path / "scan.h5")
    assert same_scan(back, scan)
    if scan.exposure_s is None and scan.exterior is not None:
        assert torch.equal(back.with_noise(0.7, 1).counts, scan.with_noise(0.7, 1).counts)
    with h5py.File(tmp_path / "scan.h5", "r") as file:
        assert file["counts"].shape == scan.counts.shape


def test_earlier_foreign_and_newer_files(tmp_path, clean):
    """Files of earlier versions are plain HDF5 from the first byte, without a checksum."""
    clean.save(tmp_path / "scan.h5")
    (tmp_path / "old.h5").write_bytes((tmp_path / "scan.h5").read_bytes()[512:])
    with h5py.File(tmp_path / "old.h5", "a") as file:
        file.attrs["version"] = 1
    assert same_scan(Scan.load(tmp_path / "old.h5"), clean)
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


def test_a_file_of_version_5_holds_the_exterior_under_its_former_name(tmp_path, clean):
    clean.save(tmp_path / "scan.h5")
    with h5py.File(tmp_path / "scan.h5", "a") as file:
        assert set(file["window"]) == {"exterior", "first_column"}
        assert file.attrs["version"] == 6
        file.move("window/exterior", "window/surround")
        file.attrs["version"] = 5
    seal(tmp_path / "scan.h5")
    assert same_scan(Scan.load(tmp_path / "scan.h5"), clean)


def test_former_names_are_refused_with_the_ones_of_now(clean):
    for error, former in (
        (TypeError, lambda: replace(clean, surround=None)),
        (AttributeError, lambda: clean.surround),
        (AttributeError, lambda: clean.surround_line_integrals()),
        (AttributeError, lambda: clean.surround_weights()),
        (TypeError, lambda: InsetFbp(clean, [], [], surround=None)),
        (ImportError, lambda: torchpcct.spectral.decompose_surround),
    ):
        with pytest.raises(error, match=r"is now called (decompose_)?exterior"):
            former()
    with pytest.raises(ImportError, match="is now called decompose_exterior"):
        from torchpcct.spectral import decompose_surround  # noqa: F401
    # What never was a name has Python's own error.
    with pytest.raises(AttributeError, match="'Scan' object has no attribute 'none'"):
        clean.none  # noqa: B018
    with pytest.raises(TypeError, match=r"unexpected keyword argument 'none'"):
        replace(clean, none=None)
    assert same_scan(pickle.loads(pickle.dumps(clean)), clean)
    assert same_scan(copy.deepcopy(clean), clean)


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
    standard_error = float(measured.sub(noisy._at_window(noisy.air.log())).std()) / np.sqrt(
        measured.numel()
    )
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
    """Noise is drawn around the inset's footprint only: the inset's noise is the same to a few
    per mille."""
    noise_a = (
        InsetFbp(clean, [INSET], ["soft"])(clean.with_noise(2.0, 3))[0]
        - InsetFbp(clean, [INSET], ["soft"])(clean)[0]
    )
    noise_b = (
        InsetFbp(whole, [INSET], ["soft"])(whole.with_noise(2.0, 3))[0]
        - InsetFbp(whole, [INSET], ["soft"])(whole)[0]
    )
    assert float((noise_a - noise_b).square().mean() / noise_b.square().mean()) < 2e-3


def test_refusals_of_reconstruct(clean):
    refused(
        ("kernel", lambda: reconstruct(clean, INSET, "fbp", kernel="hard")),
        (
            r"field of view|region",
            lambda: reconstruct(clean, VolumeGrid((4, 4, 4), 0.2, (0, 0, 400.0)), "fbp"),
        ),
        ("region", lambda: reconstruct(clean, VolumeGrid((4, 4, 4), 0.2, (0, 0, 60.0)), "fbp")),
        ("too few photons", lambda: reconstruct(clean.with_noise(1e-5, 0), INSET, "fbp")),
    )


def test_a_lower_dose_of_a_measured_scan(clean):
    """As noisy as a scan that was simulated at that dose, cell by cell of many realisations; all
    bins by themselves."""
    high = [clean.with_noise(2.0, k).at_dose(0.25, k) for k in range(24)]
    low = [clean.with_noise(0.5, 100 + k) for k in range(24)]
    assert high[0].exposure_s == pytest.approx(0.5)
    torch.testing.assert_close(high[0].air, low[0].air)
    torch.testing.assert_close(high[0].exterior, low[0].exterior)
    assert high[0].info["lower_dose"] == {"fraction": 0.25, "seed": 0, "exact": True}
    variance = [
        torch.stack([s.line_integrals() for s in scans]).var(0).mean() for scans in (high, low)
    ]
    n = clean.counts.numel() * 23
    assert float(variance[0] / variance[1]) == pytest.approx(1.0, abs=4.5 * (4 / n) ** 0.5 + 0.002)
    mean = (
        torch.stack([s.counts for s in high]).mean() / torch.stack([s.counts for s in low]).mean()
    )
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


@pytest.mark.parametrize("photons", [3.0, 10.0, 40.0, 150.0])
def test_weights_of_few_photons_do_not_follow_the_noise_of_their_readings(photons):
    """A weighted mean of line integrals is theirs: bright readings weighed more, which lowered it
    by a fifth of a photon."""
    geometry = ParallelBeam(full_turn(400), 400, 1.0)
    counts = np.random.default_rng(0).poisson(photons, geometry.shape).astype(float)
    scan = Scan.from_counts(counts, geometry, air=4.0 * photons)
    weights, lines = scan.weights().double(), scan.line_integrals().double()
    error = float((weights * lines).sum() / weights.sum()) - math.log(4.0)
    assert abs(error) < 0.02 / photons + 4.0 / math.sqrt(photons * counts.size)
    changed = counts.copy()
    changed[200, 200] += 5.0
    other = Scan.from_counts(changed, geometry, air=4.0 * photons).weights()
    assert other[200, 200] == scan.weights()[200, 200]
    assert other[200, 201] > scan.weights()[200, 201]
