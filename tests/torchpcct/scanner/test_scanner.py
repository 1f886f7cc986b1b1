"""The scanner: published and assumed numbers, counts, CT numbers, water correction, validation."""

import dataclasses
import pickle

import numpy as np
import pytest
import torch

from torchpcct.geometry import ConeBeam
from torchpcct.scanner import Source, presets
from torchpcct.scene.materials import PLAQUE_MATERIALS, material


@pytest.fixture(scope="module")
def pcct():
    return presets.pcct()


@pytest.fixture(scope="module")
def eid():
    return presets.eid()


def test_published_geometry(pcct, eid):
    g = pcct.geometry
    assert (g.sod, g.sdd, g.columns, g.rows, g.views, g.detector) == (
        626.0,
        1098.0,
        1500,
        40,
        1968,
        "curved",
    )
    assert (g.pitch, pcct.source.focal_spot, pcct.source.kvp) == ((0.50, 0.35), (0.5, 0.5), 100.0)
    assert 2 * g.fov_radius == pytest.approx(296, abs=1)
    assert presets.pcct(quarter_offset=True).geometry.offset[1] == pytest.approx(0.35 / 4)
    g = eid.geometry
    assert (g.sod, g.sdd, g.columns, g.rows, g.views, g.detector) == (
        541.0,
        949.0,
        888,
        64,
        984,
        "curved",
    )
    assert (g.pitch, eid.source.focal_spot, eid.source.current_ma) == (
        (1.0988, 1.0239),
        (0.9, 0.7),
        1000.0,
    )
    assert g.offset == (0.0, pytest.approx(-1.25 * 1.0239))


def test_quanta_from_first_principles(pcct):
    """Central cell: fluence at 1 m × inverse square × cell area × filters, each by hand."""
    spectrum = pcct.source.spectrum()
    energies, quanta = pcct.quanta()
    aluminium = material("aluminium").attenuation(energies)
    column = 1000
    gamma = pcct.geometry.fan_angles[column]
    path = 3.0 / np.cos(gamma) + pcct.bowties[0].thickness(gamma)
    expected = spectrum.fluence * (1000 / 1098) ** 2 * 0.35 * 0.50 * np.exp(-aluminium * path)
    np.testing.assert_allclose(quanta[column], expected, rtol=1e-12)


def test_a_flat_detector_loses_by_the_cube_of_the_cosine(pcct):
    bare = pcct.replace(filters=(), bowties=())
    g = bare.geometry
    flat = bare.replace(geometry=ConeBeam((0.0,), g.sod, g.sdd, 501, 1, (0.5, 1.0)))
    quanta = flat.quanta()[1].sum(1)
    np.testing.assert_allclose(
        quanta / quanta[250], np.cos(flat.geometry.fan_angles) ** 3, rtol=1e-12
    )


def test_row_factor_is_inverse_square_times_obliquity(pcct):
    g = pcct.geometry
    assert pcct.row_factor.shape == (40,)
    z = g.row_positions[0]
    distance = np.hypot(g.sdd, z)
    assert pcct.row_factor[0] == pytest.approx(
        (g.sdd / distance) ** 2 * (g.sdd / distance), rel=1e-14
    )
    assert pcct.row_factor[0] == pcct.row_factor[-1] < pcct.row_factor[19] < 1


@pytest.mark.parametrize("make", [presets.pcct, presets.eid, lambda: presets.pcct(mode="spectral")])
def test_weights_are_quanta_times_response(make):
    scanner = make()
    energies, quanta = scanner.quanta()
    same, weights = scanner.weights()
    assert weights.shape == (scanner.detector.bins, scanner.geometry.columns, energies.size)
    np.testing.assert_array_equal(same, energies)
    response = scanner.detector.response(energies)
    np.testing.assert_allclose(weights, response[:, None] * quanta, rtol=1e-14)
    assert (weights.sum(-1) > 0).all()


def test_the_number_of_views_changes_the_load_only(pcct):
    few = pcct.with_views(123)
    assert few.geometry.views == 123
    assert few.weights()[1] is pcct.weights()[1]  # cached, whatever the views
    assert few.mas_per_view(1.0) * 123 == pytest.approx(pcct.mas_per_view(1.0) * 1968)
    assert few.geometry.angles[1] == pytest.approx(2 * np.pi / 123)


def test_arrays_are_read_only(pcct):
    with pytest.raises(ValueError, match="read-only"):
        pcct.weights()[1][0, 0, 0] = 1.0


@pytest.mark.parametrize(
    "make", [presets.pcct, presets.eid, lambda: presets.pcct(mode="spectral", columns=8)]
)
def test_water_reads_linear_from_0_to_380_mm(make):
    """Of the sum of all energy bins, where there are several."""
    scanner = make()
    energies, weights = scanner.weights()
    mu, w, lin = (
        material("water").attenuation(energies),
        weights.sum(0),
        scanner.water_linearisation(),
    )
    for t in (0.01, 1.0, 7.0, 33.0, 100.0, 171.0, 240.0, 333.0, 380.0):
        p = -np.log((w * np.exp(-mu * t)).sum(-1) / w.sum(-1))
        linear = lin.apply(torch.from_numpy(p)).numpy() / (lin.mu_ref * t)
        np.testing.assert_allclose(linear, 1.0, atol=2e-5, err_msg=f"{t} mm")


def test_a_reading_is_corrected_alike_whatever_stands_beside_it(pcct):
    lin = pcct.water_linearisation()
    p = torch.linspace(0.1, 4.0, 1500, dtype=torch.float64).expand(3, 1500).clone()
    alone = lin.apply(p)
    p[1, 7] = -0.3  # continued straight
    torch.testing.assert_close(lin.apply(p)[1, 8:], alone[1, 8:], rtol=1e-14, atol=0.0)
    p[1, 7] = float("nan")
    assert lin.apply(p)[1].isnan().nonzero().tolist() == [[7]]
    expected = lin.apply(p)
    assert lin.apply(p, overwrite=True).data_ptr() == p.data_ptr()
    torch.testing.assert_close(p, expected, equal_nan=True, rtol=0, atol=0)


def test_the_water_correction_is_tame_outside_its_range(pcct):
    lin = pcct.water_linearisation()
    p = torch.linspace(-0.5, 20.0, 801, dtype=torch.float64)[:, None].expand(-1, 1500)
    out = lin.apply(p)
    assert torch.isfinite(out).all()
    assert (torch.diff(out, dim=0) > 0).all()
    assert torch.equal(lin.apply(torch.zeros(1500)), torch.zeros(1500))
    slope = lin.slope(torch.full((1500,), -0.1, dtype=torch.float64))
    np.testing.assert_allclose(
        lin.apply(torch.full((1500,), -0.1, dtype=torch.float64)), -0.1 * slope, rtol=1e-12
    )


def test_coarser_energy_bins_change_little(pcct):
    coarse = presets.pcct(energy_bin_kev=2.0)
    fine_hu, hu = (
        [material(n).hu(s.quanta()[0], behind) for n in PLAQUE_MATERIALS]
        for s, behind in ((s, s.behind({material("water"): 200.0})[0, 750]) for s in (pcct, coarse))
    )
    np.testing.assert_allclose(hu, fine_hu, atol=3.0)
    assert coarse.weights()[1][0, 750].sum() == pytest.approx(
        pcct.weights()[1][0, 750].sum(), rel=0.01
    )


def test_scanners_are_values(pcct):
    assert presets.pcct() == pcct
    assert hash(presets.pcct()) == hash(pcct)
    assert pickle.loads(pickle.dumps(pcct)) == pcct
    assert pcct.replace(source=Source(kvp=120.0)) != pcct
    with pytest.raises(dataclasses.FrozenInstanceError):
        pcct.name = "x"
