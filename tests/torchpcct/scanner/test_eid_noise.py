"""Noise of energy-integrating scans: compound Poisson with the transmitted spectrum, electronic noise, files, FBP."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.analytic.exact_noise import line_integral_variance, roi_covariance
from recon.analytic.inset import InsetFbp
from torchpcct import Scan, VolumeGrid, acquire
from torchpcct.counting_noise import compound_poisson, normal, poisson
from torchpcct.metrics.roi import RoiMean, axial_grid
from torchpcct.scanner import Scintillator, presets
from torchpcct.scene.materials import material
from torchpcct.scene.phantoms.quality import water_cylinder
from torchpcct.scene.plaque import plaque_scene

ENERGIES = np.array([30.0, 60.0, 95.0])
QUANTA = np.array([3.0, 5.0, 2.0])


# --- the random numbers -------------------------------------------------------------------------------------------


def test_mean_and_variance_of_the_compound_law():
    """Against the moments of Σ E N(E), N Poisson, and a direct simulation of the same law for the third cumulant."""
    n = 400_000
    mean, second, third = (float(QUANTA @ ENERGIES**k) for k in (1, 2, 3))
    q = torch.full((1, n), second / mean, dtype=torch.float64)
    out = compound_poisson(torch.full((1, n), mean, dtype=torch.float64), q, [0], seed=1).numpy().ravel()
    assert abs(out.mean() - mean) < 4.5 * np.sqrt(second / n)
    fourth = float(QUANTA @ ENERGIES**4) + 3 * second**2
    assert abs(out.var() - second) < 4.5 * np.sqrt((fourth - second**2) / n)
    assert out.min() >= 0
    skew = ((out - out.mean()) ** 3).mean()
    assert skew == pytest.approx(second**2 / mean, rel=0.05)
    direct = np.random.default_rng(0).poisson(QUANTA, (n, 3)) @ ENERGIES
    true = ((direct - direct.mean()) ** 3).mean()
    assert true == pytest.approx(third, rel=0.05)
    assert skew < third  # what the docstring says of the third cumulant


def test_electronic_noise_adds_its_variance_and_is_independent_of_the_quanta():
    n = 400_000
    mean = torch.full((1, n), 500.0, dtype=torch.float64)
    q = torch.full_like(mean, 50.0)
    quiet = compound_poisson(mean, q, [0], seed=3).numpy().ravel()
    loud = compound_poisson(mean, q, [0], seed=3, electronic=200.0).numpy().ravel()
    added = (loud - quiet) / 200.0
    assert added.std() == pytest.approx(1.0, abs=4.5 / np.sqrt(2 * n))
    assert abs(added.mean()) < 4.5 / np.sqrt(n)
    assert abs(np.corrcoef(added, quiet)[0, 1]) < 4.5 / np.sqrt(n)
    other = normal((1, n), [0], seed=3, dtype=torch.float64).numpy().ravel()
    assert abs(np.corrcoef(added, other)[0, 1]) < 4.5 / np.sqrt(n)


def test_a_unit_quantum_is_the_counting_noise_and_a_window_is_the_crop():
    mean = torch.rand(6, 50, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 200
    one = torch.ones_like(mean)
    index = np.arange(6) * 50
    assert torch.equal(compound_poisson(mean, one, index, seed=5, scale=0.3), poisson(mean, index, seed=5, scale=0.3))
    full = compound_poisson(mean, 60 * one, index, seed=11, electronic=9.0)
    crop = compound_poisson(mean[2:5, 7:30], 60 * one[2:5, 7:30], index[2:5] + 7, seed=11, electronic=9.0)
    assert torch.equal(crop, full[2:5, 7:30])


def test_edge_values_and_refusals():
    mean = torch.tensor([[0.0, -1.0, float("nan"), 5.0]])
    out = compound_poisson(mean, torch.full_like(mean, 2.0), [0], seed=0)
    assert out.dtype == torch.float32
    assert out[0, 0] == 0
    assert torch.isnan(out[0, 1:3]).all()
    assert torch.isnan(compound_poisson(mean, torch.zeros_like(mean), [0], seed=0)).all()
    with pytest.raises(ValueError, match="quantum has shape"):
        compound_poisson(mean, torch.ones(1, 3), [0], seed=0)
    with pytest.raises(ValueError, match="electronic"):
        compound_poisson(mean, torch.ones_like(mean), [0], seed=0, electronic=-1.0)


# --- scans --------------------------------------------------------------------------------------------------------

INSET = VolumeGrid((6, 24, 24), 0.4, (0.0, -30.38, -29.63))
REGION = VolumeGrid((1, 1, 1), (6.4, 9.6, 9.6), INSET.center)
SCENE, _ = plaque_scene(vessel_length=6.2)


def scanner(views=60, **changes):
    s = presets.eid(views=views, **changes)
    return s.replace(geometry=replace(s.geometry, rows=8))


@pytest.fixture(scope="module")
def clean():
    return acquire(SCENE, scanner(), region=REGION, duty=0.06, sub_rays=16)


@pytest.mark.parametrize("name", ["pericoronary_fat", "water", "aluminium"])
def test_the_second_moment_is_the_polychromatic_sum(name):
    """``quantum`` of the central ray through a cylinder: Σ w₂ T / Σ w T, whatever the material."""
    system = presets.eid(views=4)
    system = system.replace(geometry=replace(system.geometry, rows=1), source=replace(system.source, focal_spot=(0, 0)))
    diameter = 40.0 if name == "aluminium" else 200.0
    scan = acquire(water_cylinder(diameter, material=name), system, sub_rays=1)
    column = 445
    gamma = system.geometry.fan_angles[column]
    chord = 2 * np.sqrt((diameter / 2) ** 2 - (541.0 * np.sin(gamma)) ** 2)
    energies, weights = system.weights()
    t = np.exp(-material(name).attenuation(energies) * chord)
    expected = (system.noise_weights()[1][0, column] @ t) / (weights[0, column] @ t)
    assert float(scan.quantum[0, 0, column]) == pytest.approx(expected, rel=1e-5)
    air = (system.noise_weights()[1][0, 5]).sum() / weights[0, 5].sum()
    assert float(scan.quantum[0, 0, 5]) == pytest.approx(air, rel=1e-5)


def test_variance_of_the_readings_against_quanta_drawn_energy_by_energy():
    """Independent oracle: Poisson numbers of photons per energy bin, absorbed or not, their energies added up."""
    detector = Scintillator(electronic_noise_kev=300.0)
    system = presets.eid(views=2, detector=detector, current_ma=1.0)
    system = system.replace(geometry=replace(system.geometry, rows=1), source=replace(system.source, focal_spot=(0, 0)))
    clean = acquire(water_cylinder(200.0), system, sub_rays=1)
    column, exposure = 445, 0.35
    energies, quanta = system.quanta()
    chord = 2 * np.sqrt(100.0**2 - (541.0 * np.sin(system.geometry.fan_angles[column])) ** 2)
    arriving = quanta[column] * system.mas_per_view(exposure) * np.exp(-material("water").attenuation(energies) * chord)
    rng, n = np.random.default_rng(2), 20_000
    direct = rng.poisson(arriving * detector.absorbed(energies), (n, energies.size)) @ energies
    direct += rng.normal(0, 300.0, n)
    share = float(clean.relative_variance(exposure)[0, 0, column])
    signal = float(clean.counts[0, 0, column]) * exposure
    assert direct.mean() == pytest.approx(signal, abs=4.5 * direct.std() / np.sqrt(n))
    assert direct.var() == pytest.approx(share * signal**2, rel=4.5 * np.sqrt(2 / n))
    one = clean.counts[:1, :, column : column + 1].expand(1, 1, n)
    drawn = compound_poisson(
        one, clean.quantum[:1, :, column : column + 1].expand(1, 1, n), [0], 8, exposure, clean.electronic_noise
    ).double()
    assert float(drawn.mean()) == pytest.approx(direct.mean(), abs=6 * direct.std() / np.sqrt(n))
    assert float(drawn.var()) == pytest.approx(direct.var(), rel=6 * np.sqrt(2 / n))


def test_a_windowed_scan_carries_the_noise_of_the_whole(clean):
    whole = acquire(SCENE, scanner(), duty=0.06, sub_rays=16)
    noisy, noisy_whole = clean.with_noise(0.35, 9), whole.with_noise(0.35, 9)
    v, w = 13, clean.window
    cut = noisy_whole.counts[v, :, w.first_column[v] : w.first_column[v] + w.columns]
    assert torch.equal(clean.counts[v], whole.counts[v, :, w.first_column[v] : w.first_column[v] + w.columns])
    assert torch.equal(noisy.counts[v], cut)
    assert torch.equal(noisy.counts, clean.with_noise(0.35, 9).counts)
    assert not torch.equal(noisy.counts, clean.with_noise(0.35, 10).counts)


@pytest.mark.parametrize("noisy", [False, True])
def test_round_trip(tmp_path, clean, noisy):
    scan = clean.with_noise(0.35, 7) if noisy else clean
    scan.save(tmp_path / "scan.h5")
    back = Scan.load(tmp_path / "scan.h5")
    assert torch.equal(back.counts, scan.counts)
    assert torch.equal(back.quantum, scan.quantum)
    assert (back.electronic_noise, back.counting, back.exposure_s) == (206.0, False, scan.exposure_s)
    assert torch.equal(back.line_integrals(), scan.line_integrals())
    if not noisy:
        assert torch.equal(back.with_noise(0.7, 1).counts, scan.with_noise(0.7, 1).counts)


def test_a_signal_of_unknown_quanta_stays_noise_free(clean):
    unknown = replace(clean, quantum=None)
    assert torch.isfinite(unknown.line_integrals()).all()
    with pytest.raises(ValueError, match="energy of its quanta"):
        unknown.with_noise(0.35, 0)
    with pytest.raises(ValueError, match="energy of its quanta"):
        line_integral_variance(unknown, 0.35)
    with pytest.raises(ValueError, match="energy of its quanta"):
        replace(unknown, exposure_s=1.0, seed=0).line_integrals()


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda s: {"quantum": s.quantum[1:]}, "quantum has shape"),
        (lambda s: {"quantum": s.quantum * 0}, "quantum must be finite and greater"),
        (lambda s: {"counting": True}, "quantum belongs"),
        (lambda s: {"electronic_noise": -1.0}, "electronic_noise"),
        (lambda s: {"counts": -s.counts}, "negative"),
        (lambda s: {"counts": -s.counts, "exposure_s": 1.0, "electronic_noise": 0.0}, "negative"),
    ],
)
def test_bad_scans_are_refused(clean, change, match):
    with pytest.raises(ValueError, match=match):
        replace(clean, **change(clean))


def test_the_logarithm_is_finite_and_nearly_unbiased(clean):
    """20 quanta of 65 keV and 206 keV of electronics: E[ln] is off by no more than the third-order terms."""
    flat = replace(
        clean,
        counts=torch.full_like(clean.counts, 20 * 65.0),
        quantum=torch.full_like(clean.counts, 65.0),
        linearisation=replace(
            clean.linearisation,
            coefficients=np.ones((clean.geometry.columns, 1)),
            scale=np.full(clean.geometry.columns, 20.0),
        ),
    )
    noisy = flat.with_noise(1.0, 0)
    measured = noisy.line_integrals().double()
    truth = flat.line_integrals().double()
    error = float((measured - truth).mean())
    spread = float((measured - truth).std()) / np.sqrt(measured.numel())
    relative = float(flat.relative_variance(1.0)[0, 0, 0])
    assert relative == pytest.approx(1 / 20 + (206 / 1300) ** 2, rel=1e-6)
    # Without the shift the logarithm is off by relative / 2 = 0.038.
    assert abs(error) < 2.0 * relative**2 + 4 * spread
    assert abs(error) < 0.2 * relative / 2
    starved = flat.with_noise(1e-3, 0)
    assert float(starved.counts.min()) < 0
    assert starved.zero_fraction > 0.3
    assert torch.isfinite(starved.line_integrals()).all()


def test_exact_roi_covariance_matches_monte_carlo(clean):
    fbp = InsetFbp(clean, [INSET], ["standard"])
    image = axial_grid(INSET.center)
    y, x = np.meshgrid(image.axes[1] - INSET.center[1], image.axes[2] - INSET.center[2], indexing="ij")
    rois = [RoiMean(INSET, image, np.hypot(y, x - c) < 0.7) for c in (1.5, 0.0)]
    exact = roi_covariance(clean, fbp, [rois], 0.35)[0][0]
    runs = np.array([[float(r(fbp(clean.with_noise(0.35, s))[0][0])) for r in rois] for s in range(60)])
    expected = np.array([float(r(fbp(clean)[0][0])) for r in rois])
    sd = np.sqrt(np.diag(exact))
    assert (np.abs(runs.mean(0) - expected) < 4 * sd / np.sqrt(60)).all()
    # Taking keV for counts would give an SD 8 times too small.
    np.testing.assert_allclose(runs.std(0, ddof=1), sd, rtol=4 / np.sqrt(120))


def test_electronic_noise_matters_where_the_signal_is_low():
    """The exact variance falls faster than 1 / exposure as long as electronic noise has a share in it."""
    loud = scanner(24, detector=Scintillator(electronic_noise_kev=3e4))
    clean = acquire(SCENE, loud, region=REGION, duty=0.02, sub_rays=16)
    ratio = clean.relative_variance(0.35) / clean.relative_variance(3.5)
    q, s = clean.quantum.double(), clean.counts.double()
    expected = 10 * (q + 3e4**2 / (0.35 * s)) / (q + 3e4**2 / (3.5 * s))
    torch.testing.assert_close(ratio.double(), expected, rtol=1e-5, atol=0)
    assert float(ratio.max()) > 12
