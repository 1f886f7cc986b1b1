"""Few energies in place of a spectrum, and the exponential that their transmissions are made of."""

import numpy as np
import pytest
from numba import njit

from torchpcct.acquisition.acquire import acquire
from torchpcct.acquisition.bodies import Bodies
from torchpcct.acquisition.spectra import NODE_ERROR, energy_nodes, signal_spectra
from torchpcct.acquisition.transmission import _exp
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene
from torchpcct.scene.plaque.variants import plaque_variant

SYSTEMS = [presets.pcct(views=4), presets.pcct(views=4, mode="spectral"), presets.eid(views=4)]


@pytest.fixture(scope="module")
def scene():
    return plaque_scene()[0]


@pytest.mark.parametrize("system", SYSTEMS, ids=["counting", "spectral", "energy-integrating"])
def test_nodes_sum_a_spectrum_to_their_error(scene, system):
    """Every bin and column, on paths that the nodes were not made for."""
    energies, spectra, _ = signal_spectra(system)
    mu, longest = Bodies.of(scene, system.geometry, None, 1.0).attenuation(
        energies, system.geometry
    )
    nodes = energy_nodes(mu, longest, spectra)
    assert len(nodes.indices) <= len(energies) // 2
    assert 0 < nodes.error <= NODE_ERROR
    paths = np.random.default_rng(7).random((50, len(longest))) ** 2 * longest
    transmitted = np.exp(-paths @ mu)
    exact = np.einsum("bce,pe->bcp", spectra, transmitted)
    found = np.einsum("bce,pe->bcp", nodes.spectra, transmitted[:, nodes.indices])
    seen = spectra.sum(-1) > 0
    assert np.abs(found[seen] / exact[seen] - 1).max() < 2 * NODE_ERROR


def test_metal_keeps_every_energy_rather_than_an_error():
    system = SYSTEMS[0]
    energies, spectra, _ = signal_spectra(system)
    bodies = Bodies.of(plaque_variant("stent")[0], system.geometry, None, 1.0)
    nodes = energy_nodes(*bodies.attenuation(energies, system.geometry), spectra)
    assert nodes.error <= NODE_ERROR
    one = energy_nodes(np.ones((1, 1)), np.ones(1), np.ones((1, 3, 1)))
    assert len(one.indices) == 1
    assert one.error == 0.0
    dark = energy_nodes(np.ones((1, 9)), np.ones(1), np.zeros((1, 3, 9)))
    assert len(dark.indices) == 9


def test_a_scan_of_nodes_is_that_of_every_energy(scene):
    """The plan names the nodes and their cost; a tolerance of 0 sums the whole spectrum."""
    system = presets.pcct(views=4, rows=2)
    few, all_ = (acquire(scene, system, duty=0.02, sub_rays=1, tolerance_hu=t) for t in (1e3, 0.0))
    row = next(e for e in few.info["plan"]["effects"] if e["name"] == "every energy")
    assert not row["modelled"]
    assert 0 < row["cost_hu"] < 1e-3
    assert few.info["plan"]["energies"] < all_.info["plan"]["energies"] == 88
    coarse = acquire(scene, system, duty=0.02, sub_rays=1, tolerance_hu=1e-9)
    assert coarse.info["plan"]["energies"] == 88  # its error would be more
    error = few.counts.double() / coarse.counts.double() - 1
    assert error.abs().max() < 0.05  # the other effects were left out, too


def test_the_exponential_is_exact_to_the_last_digit():
    x = np.concatenate([np.linspace(-707, 700, 20011), np.linspace(-1, 1, 2001), [0.0]])
    values = njit(lambda v: _exp(v))  # as in a loop of a kernel
    found = np.array([values(v) for v in x])
    np.testing.assert_allclose(found, np.exp(x), rtol=4.5e-16)
    assert values(-1e4) < 1e-300
    assert values(0.0) == 1.0
