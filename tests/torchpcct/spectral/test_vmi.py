"""Virtual monochromatic images: water at 0 HU, noise, the optimum energy; basis materials and
their coefficients."""

import numpy as np
import pytest
import torch
from refusals import refused

from torchpcct.scanner import presets
from torchpcct.scene.materials import MATERIALS, blend, material
from torchpcct.spectral import (
    Basis,
    SpectralModel,
    cramer_rao,
    decompose,
    pe_pvc,
    vmi,
    vmi_curve,
    vmi_noise,
    vmi_weights,
)

ENERGIES = np.arange(40.0, 141.0, 5.0)


def image_of(name, shape=(2, 3)):
    c = pe_pvc().coefficients(name)
    return torch.from_numpy(c).reshape(2, 1, 1).expand(2, *shape).contiguous()


def test_water_is_zero_at_every_energy():
    hu = vmi(image_of("water"), pe_pvc(), ENERGIES)
    assert hu.shape == (ENERGIES.size, 2, 3)
    assert hu.abs().max() < 1e-9


def test_air_is_minus_thousand():
    # air itself is 1.2 HU above vacuum
    assert (vmi(torch.zeros(2, 4), pe_pvc(), ENERGIES) + 1000).abs().max() < 2
    assert (vmi(image_of("air"), pe_pvc(), ENERGIES) + 1000).abs().max() < 0.1


@pytest.mark.parametrize(
    ("name", "tolerance"), [("fibrous_tissue", 0.6), ("necrotic_core", 0.6), ("adipose", 0.8)]
)
def test_tissues_read_their_exact_hu(name, tolerance):
    hu = vmi(image_of(name), pe_pvc(), ENERGIES)[:, 0, 0].numpy()
    water, air = (material(n).attenuation(ENERGIES) for n in ("water", "air"))
    exact = 1000 * (material(name).attenuation(ENERGIES) - water) / (water - air)
    assert np.abs(hu - exact).max() < tolerance


def test_water_decomposed_from_its_counts_is_zero():
    # True water, with all that the basis cannot express, behind 5…35 cm: the whole chain, at every
    # energy.
    energies, weights = presets.pcct(mode="spectral").weights()
    model = SpectralModel(energies, weights[:, (750, 1300), :].swapaxes(0, 1))
    t = np.linspace(50.0, 350.0, 14)
    behind = np.exp(-np.outer(t, material("water").attenuation(energies)))
    counts = torch.from_numpy(np.einsum("bce,te->btc", weights[:, (750, 1300), :], behind))
    found = decompose(counts, model, bias_reduction=False, tolerance=1e-6).line_integrals
    hu = vmi(found / torch.from_numpy(t)[:, None], pe_pvc(), ENERGIES)
    assert hu.abs().max() < 1.0


def test_noise_follows_from_the_covariance():
    c = np.array([[4e-4, -1.9e-4], [-1.9e-4, 1.2e-4]])
    generator = np.random.default_rng(1)
    noise = generator.multivariate_normal([0, 0], c, 40000).T
    images = torch.from_numpy(pe_pvc().coefficients("water"))[:, None] + torch.from_numpy(noise)
    packed = np.array([c[0, 0], c[0, 1], c[1, 1]])
    exact = vmi_noise(packed, pe_pvc(), ENERGIES)
    assert exact.shape == (ENERGIES.size,)
    torch.testing.assert_close(vmi(images, pe_pvc(), ENERGIES).std(1), exact, rtol=0.02, atol=0)
    # The same from the propagated samples, exactly.
    propagated = vmi_noise(np.cov(images.numpy())[(0, 0, 1), (0, 1, 1)], pe_pvc(), ENERGIES)
    torch.testing.assert_close(
        propagated, vmi(images, pe_pvc(), ENERGIES).std(1), rtol=1e-9, atol=0
    )


def test_curve_and_its_optimum():
    basis = pe_pvc()
    core, fibrous = (basis.coefficients(n) for n in ("necrotic_core", "fibrous_tissue"))
    # Noise of the projections behind 24 cm of fat: the images' has the same shape.
    energies, weights = presets.pcct(mode="spectral").weights()
    model = SpectralModel(energies, weights[:, 750:751, :].swapaxes(0, 1))
    covariance = cramer_rao(torch.tensor([[231.7], [5.6]], dtype=torch.float64), model)[
        :, 0
    ].numpy()
    curve = vmi_curve(fibrous, core, covariance, basis, np.arange(40.0, 141.0))
    assert (curve.contrast > 0).all()
    assert (curve.cnr <= curve.limit * (1 + 1e-12)).all()
    assert curve.cnr.max() > 0.5 * curve.limit
    assert 40 < curve.optimum_kev < 75
    k = int(np.abs(curve.energies - curve.optimum_kev).argmin())
    assert curve.cnr[k] == curve.cnr.max()
    swapped = vmi_curve(core, fibrous, 4 * covariance, basis, np.arange(40.0, 141.0))
    np.testing.assert_allclose(swapped.contrast, -curve.contrast)
    np.testing.assert_allclose(swapped.cnr, curve.cnr / 2)


def test_optimum_of_a_known_curve():
    # Noise only along the combination that a VMI at 70 keV hardly sees.
    basis = pe_pvc()
    g = vmi_weights(basis, [70.0])[0][0]
    across = np.array([-g[1], g[0]]) / np.hypot(*g)
    along = g / np.hypot(*g)
    c = np.outer(across, across) + 1e-6 * np.outer(along, along)
    curve = vmi_curve((1.0, 0.1), (0.0, 0.0), (c[0, 0], c[0, 1], c[1, 1]), basis)
    assert curve.optimum_kev == pytest.approx(70, abs=0.5)


def test_dtype_and_gradient():
    images = torch.rand(2, 3, 4, dtype=torch.float32, requires_grad=True)
    hu = vmi(images, pe_pvc(), 52.0)
    assert hu.shape == (1, 3, 4)
    assert hu.dtype == torch.float32
    hu.sum().backward()
    g = vmi_weights(pe_pvc(), 52.0)[0][0]
    np.testing.assert_allclose(images.grad[:, 0, 0].numpy(), g, rtol=1e-6)


def test_errors():
    basis = pe_pvc()
    refused(
        ("2 entries", lambda: vmi(torch.zeros(3, 4), basis)),
        ("3 entries", lambda: vmi_noise((1.0, 1.0), basis)),
        ("negative", lambda: vmi_noise((-1.0, 0.0, 1.0), basis)),
        ("positive definite", lambda: vmi_curve((1, 0), (0, 1), (1.0, 2.0, 1.0), basis)),
        ("2 coefficients", lambda: vmi_curve((1, 0, 0), (0, 1), (1.0, 0.0, 1.0), basis)),
        ("keV", lambda: vmi(torch.zeros(2, 4), basis, [52000.0])),
    )


KEV = np.arange(40.0, 141.0)


def test_basis_materials_are_unit_vectors():
    basis = pe_pvc()
    assert basis.names == ("polyethylene", "pvc")
    np.testing.assert_allclose(basis.coefficients("polyethylene"), (1, 0), atol=1e-12)
    np.testing.assert_allclose(basis.coefficients("pvc"), (0, 1), atol=1e-12)
    half = material("pvc").with_density(0.685)
    np.testing.assert_allclose(basis.coefficients(half, KEV, KEV**-2), (0, 0.5), atol=1e-12)


def test_volume_mixtures_have_mixed_coefficients():
    basis = pe_pvc()
    mixed = blend("mixed", {material("polyethylene"): 0.3, material("pvc"): 0.7})
    np.testing.assert_allclose(basis.coefficients(mixed), (0.3, 0.7), atol=1e-9)


def test_attenuation_of_coefficients():
    basis = pe_pvc()
    exact = 0.4 * material("polyethylene").attenuation(KEV) + 0.2 * material("pvc").attenuation(KEV)
    np.testing.assert_allclose(basis.mu((0.4, 0.2), KEV), exact, rtol=1e-14)
    images = np.ones((2, 3, 4))
    assert basis.mu(images, KEV).shape == (KEV.size, 3, 4)
    assert basis.mu(images, 60.0).shape == (3, 4)


@pytest.mark.parametrize(
    ("name", "largest_hu"),
    [
        ("water", 0.4),
        ("pericoronary_fat", 0.2),
        ("necrotic_core", 0.4),
        ("fibrous_tissue", 0.4),
        ("blood_iodine", 60),
    ],
)
def test_tissues_lie_in_the_basis(name, largest_hu):
    error = np.abs(pe_pvc().residual(name))
    assert error.max() < largest_hu
    assert error.max() > largest_hu / 4  # the limits above are not slack


def test_errors_of_a_basis():
    basis = pe_pvc()
    refused(
        ("Material", lambda: Basis("polyethylene", MATERIALS["pvc"])),
        (
            "attenuate alike",
            lambda: Basis(MATERIALS["water"], MATERIALS["water"].with_density(2.0)),
        ),
        ("weights", lambda: basis.coefficients("water", [60.0])),
        ("weights", lambda: basis.coefficients("water", KEV, -1.0)),
        ("2 entries", lambda: basis.mu((1, 2, 3), 60.0)),
        ("unknown material", lambda: basis.coefficients("unobtainium")),
    )
