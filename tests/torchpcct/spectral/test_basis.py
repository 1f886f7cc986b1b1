"""Basis materials: exact coefficients, the fit of tissues, errors."""

import numpy as np
import pytest

from torchpcct.scene.materials import MATERIALS, blend, material
from torchpcct.spectral import Basis, pe_pvc

ENERGIES = np.arange(40.0, 141.0)


def test_basis_materials_are_unit_vectors():
    basis = pe_pvc()
    assert basis.names == ("polyethylene", "pvc")
    np.testing.assert_allclose(basis.coefficients("polyethylene"), (1, 0), atol=1e-12)
    np.testing.assert_allclose(basis.coefficients("pvc"), (0, 1), atol=1e-12)
    half = material("pvc").with_density(0.685)
    np.testing.assert_allclose(basis.coefficients(half, ENERGIES, ENERGIES**-2), (0, 0.5), atol=1e-12)


def test_volume_mixtures_have_mixed_coefficients():
    basis = pe_pvc()
    mixed = blend("mixed", {material("polyethylene"): 0.3, material("pvc"): 0.7})
    np.testing.assert_allclose(basis.coefficients(mixed), (0.3, 0.7), atol=1e-9)


def test_attenuation_of_coefficients():
    basis = pe_pvc()
    exact = 0.4 * material("polyethylene").attenuation(ENERGIES) + 0.2 * material("pvc").attenuation(ENERGIES)
    np.testing.assert_allclose(basis.mu((0.4, 0.2), ENERGIES), exact, rtol=1e-14)
    images = np.ones((2, 3, 4))
    assert basis.mu(images, ENERGIES).shape == (ENERGIES.size, 3, 4)
    assert basis.mu(images, 60.0).shape == (3, 4)


@pytest.mark.parametrize(
    ("name", "largest_hu"),
    [("water", 0.4), ("pericoronary_fat", 0.2), ("necrotic_core", 0.4), ("fibrous_tissue", 0.4), ("blood_iodine", 60)],
)
def test_tissues_lie_in_the_basis(name, largest_hu):
    error = np.abs(pe_pvc().residual(name))
    assert error.max() < largest_hu
    assert error.max() > largest_hu / 4  # the limits above are not slack


def test_errors():
    basis = pe_pvc()
    with pytest.raises(TypeError, match="Material"):
        Basis("polyethylene", MATERIALS["pvc"])
    with pytest.raises(ValueError, match="attenuate alike"):
        Basis(MATERIALS["water"], MATERIALS["water"].with_density(2.0))
    with pytest.raises(ValueError, match="weights"):
        basis.coefficients("water", [60.0])
    with pytest.raises(ValueError, match="weights"):
        basis.coefficients("water", ENERGIES, -1.0)
    with pytest.raises(ValueError, match="2 entries"):
        basis.mu((1, 2, 3), 60.0)
    with pytest.raises(ValueError, match="unknown material"):
        basis.coefficients("unobtainium")
