"""Noise of energy-integrating scans: compound Poisson with the transmitted spectrum, electronic
noise, files, FBP."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refused

from recon.analytic.exact_noise import line_integral_variance
from torchpcct import VolumeGrid, acquire
from torchpcct.counting_noise import compound_poisson, poisson
from torchpcct.scanner import Scintillator, presets
from torchpcct.scene.materials import material
from torchpcct.scene.phantoms.quality import water_cylinder
from torchpcct.scene.plaque import plaque_scene

# --- the random numbers ---------------------------------------------------------------------------


def test_a_unit_quantum_is_the_counting_noise_and_a_window_is_the_crop():
    mean = torch.rand(6, 50, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 200
    one = torch.ones_like(mean)
    index = np.arange(6) * 50
    assert torch.equal(
        compound_poisson(mean, one, index, seed=5, scale=0.3),
        poisson(mean, index, seed=5, scale=0.3),
    )
    full = compound_poisson(mean, 60 * one, index, seed=11, electronic=9.0)
    crop = compound_poisson(
        mean[2:5, 7:30], 60 * one[2:5, 7:30], index[2:5] + 7, seed=11, electronic=9.0
    )
    assert torch.equal(crop, full[2:5, 7:30])


def test_edge_values_and_refusals():
    mean = torch.tensor([[0.0, -1.0, float("nan"), 5.0]])
    for out in (
        compound_poisson(mean, torch.full_like(mean, 2.0), [0], seed=0),
        poisson(mean, [0], seed=0, scale=2.0),
    ):
        assert out.dtype == torch.float32
        assert out[0, 0] == 0
        assert torch.isnan(out[0, 1:3]).all()
    assert poisson(mean[:, 3:], [3], seed=0, scale=2.0)[0, 0] == out[0, 3]
    assert torch.isnan(compound_poisson(mean, torch.zeros_like(mean), [0], seed=0)).all()
    refused(
        ("quantum has shape", lambda: compound_poisson(mean, torch.ones(1, 3), [0], seed=0)),
        (
            "electronic",
            lambda: compound_poisson(mean, torch.ones_like(mean), [0], seed=0, electronic=-1.0),
        ),
    )


# --- scans ----------------------------------------------------------------------------------------

REGION = VolumeGrid((1, 1, 1), (6.4, 9.6, 9.6), (0.0, -30.38, -29.63))
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
    system = system.replace(
        geometry=replace(system.geometry, rows=1), source=replace(system.source, focal_spot=(0, 0))
    )
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
    """Independent oracle: Poisson numbers of photons per energy bin, absorbed or not, their
    energies added up."""
    detector = Scintillator(electronic_noise_kev=300.0)
    system = presets.eid(views=2, detector=detector, current_ma=1.0)
    system = system.replace(
        geometry=replace(system.geometry, rows=1), source=replace(system.source, focal_spot=(0, 0))
    )
    clean = acquire(water_cylinder(200.0), system, sub_rays=1)
    column, exposure = 445, 0.35
    energies, quanta = system.quanta()
    chord = 2 * np.sqrt(100.0**2 - (541.0 * np.sin(system.geometry.fan_angles[column])) ** 2)
    arriving = (
        quanta[column]
        * system.mas_per_view(exposure)
        * np.exp(-material("water").attenuation(energies) * chord)
    )
    rng, n = np.random.default_rng(2), 20_000
    direct = rng.poisson(arriving * detector.absorbed(energies), (n, energies.size)) @ energies
    direct += rng.normal(0, 300.0, n)
    share = float(clean.relative_variance(exposure)[0, 0, column])
    signal = float(clean.counts[0, 0, column]) * exposure
    assert direct.mean() == pytest.approx(signal, abs=4.5 * direct.std() / np.sqrt(n))
    assert direct.var() == pytest.approx(share * signal**2, rel=4.5 * np.sqrt(2 / n))
    one = clean.counts[:1, :, column : column + 1].expand(1, 1, n)
    drawn = compound_poisson(
        one,
        clean.quantum[:1, :, column : column + 1].expand(1, 1, n),
        [0],
        8,
        exposure,
        clean.electronic_noise,
    ).double()
    assert float(drawn.mean()) == pytest.approx(direct.mean(), abs=6 * direct.std() / np.sqrt(n))
    assert float(drawn.var()) == pytest.approx(direct.var(), rel=6 * np.sqrt(2 / n))


def test_a_signal_of_unknown_quanta_stays_noise_free(clean):
    unknown = replace(clean, quantum=None)
    assert torch.isfinite(unknown.line_integrals()).all()
    refused(
        ("energy of its quanta", lambda: unknown.with_noise(0.35, 0)),
        ("energy of its quanta", lambda: line_integral_variance(unknown, 0.35)),
        ("energy of its quanta", lambda: replace(unknown, exposure_s=1.0, seed=0).line_integrals()),
    )


def test_bad_scans_are_refused(clean):
    refused(
        ("quantum has shape", lambda: replace(clean, quantum=clean.quantum[1:])),
        ("quantum must be finite and greater", lambda: replace(clean, quantum=clean.quantum * 0)),
        ("quantum belongs", lambda: replace(clean, counting=True)),
        ("electronic_noise", lambda: replace(clean, electronic_noise=-1.0)),
        ("negative", lambda: replace(clean, counts=-clean.counts)),
        (
            "negative",
            lambda: replace(clean, counts=-clean.counts, exposure_s=1.0, electronic_noise=0.0),
        ),
    )
