"""Absorbed dose: closed forms, conservation of energy, invariances, and Monte Carlo against the
exact primary map."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from torchpcct.dose import (
    air_fluence,
    ctdi_dose,
    mass_energy_absorption,
    monte_carlo_dose,
    primary_dose,
)
from torchpcct.dose.coefficients import MGY_PER_KEV_PER_G, fan_half_angle
from torchpcct.dose.ctdi import CtdiDose, disc_samples
from torchpcct.dose.scatter import _form_factor
from torchpcct.dose.transport_kernels import _compton, _rayleigh, _turned
from torchpcct.geometry import VolumeGrid
from torchpcct.scanner import Source, presets
from torchpcct.scanner.compton import recoil
from torchpcct.scene import Body, Ellipsoid, EllipticCylinder, Scene, SinusoidalMotion
from torchpcct.scene.materials import material
from torchpcct.scene.phantoms.quality import ctdi, water_cylinder

# NIST (Hubbell and Seltzer 1995), cm²/g at these energies in keV.
NIST_KEV = (15, 20, 30, 40, 50, 60, 80, 100, 150)
NIST = {
    "water": (1.374, 0.5503, 0.1557, 0.06947, 0.04223, 0.03190, 0.02597, 0.02546, 0.02764),
    "air": (1.334, 0.5389, 0.1537, 0.06833, 0.04098, 0.03041, 0.02407, 0.02325, 0.02496),
}


def mono(energy=60.0, bowtie="none", **options):
    """A scanner whose tube sends 1000 photons / mm² / mAs at 1 m, of one energy, without
    filters."""
    scanner = presets.pcct(rows=1, columns=2200, bowtie=bowtie, **options)
    return scanner.replace(source=Source.tabulated([energy], [1000.0]), filters=())


@pytest.fixture(scope="module")
def scanners():
    return {b: presets.pcct(rows=1, columns=2200, bowtie=b) for b in ("large", "large+roi")}


@pytest.mark.parametrize("name", sorted(NIST))
def test_energy_absorption_agrees_with_nist(name):
    ours = mass_energy_absorption(material(name), NIST_KEV) / 100.0
    np.testing.assert_allclose(ours, NIST[name], rtol=0.02)


def test_dose_at_the_centre_of_a_cylinder_has_a_closed_form():
    scanner, water = mono(), material("water")
    scene = water_cylinder(200.0)
    fluence = (
        1000.0 * (1000.0 / 626.0) ** 2 * 350.0 * math.exp(-float(water.attenuation(60.0)) * 100.0)
    )
    expected = fluence * 60.0 * mass_energy_absorption(water, 60.0)[0] * MGY_PER_KEV_PER_G
    for axial in ("plane", "contiguous"):
        dose = primary_dose(scene, scanner, np.zeros((1, 2)), 0.35, axial=axial)
        assert dose[0] == pytest.approx(expected, rel=1e-9)
    interacted = primary_dose(scene, scanner, np.zeros((1, 2)), 0.35, quantity="interacted")
    ratio = float(water.attenuation(60.0)) * 1000.0 / mass_energy_absorption(water, 60.0)[0]
    assert interacted[0] == pytest.approx(expected * ratio, rel=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.floats(0.0, 140.0), st.floats(0.0, 6.28))
def test_inverse_square_in_air(radius, phi):
    """The mean of 1 / d² over the orbit is 1 / (sod² − r²)."""
    scene = water_cylinder(1.0, position=(0.0, 0.0, 1e4), length=1.0)
    scanner = mono()
    points = np.array([[0.0, 0.0], [radius * math.cos(phi), radius * math.sin(phi)]])
    dose = primary_dose(scene, scanner, points, 1.0, medium="air")
    assert dose[1] / dose[0] == pytest.approx(626.0**2 / (626.0**2 - radius**2), rel=1e-9)


def test_interacting_energy_is_what_the_beam_loses():
    """One view, dose × density summed over the plane = energy in − energy out, per mm of beam at
    the isocentre."""
    scanner, scene = mono(50.0), water_cylinder(180.0)
    spacing = 0.5
    grid = VolumeGrid((380, 380), spacing)
    dose = primary_dose(
        scene, scanner, grid, 1.0, quantity="interacted", axial="contiguous", views=1
    )
    absorbed = dose.sum() * spacing**2 * 1e-3 / MGY_PER_KEV_PER_G
    gamma = (np.arange(20001) / 20000.0 * 2.0 - 1.0) * math.asin(90.0 / 626.0)
    chord = 2.0 * np.sqrt(np.maximum(90.0**2 - (626.0 * np.sin(gamma)) ** 2, 0.0))
    lost = -np.expm1(-float(material("water").attenuation(50.0)) * chord)
    expected = 1000.0 * 1e6 / 626.0 * 50.0 * np.trapezoid(lost, gamma) * 1000.0
    assert absorbed == pytest.approx(expected, rel=2e-3)


def test_dose_is_linear_in_exposure_and_follows_a_turn(scanners):
    scene = Scene(
        [
            Body("body", EllipticCylinder((150.0, 100.0)), "water"),
            Body(
                "bone", EllipticCylinder(15.0, position=(60.0, 30.0, 0.0)), "cortical_bone", "body"
            ),
        ]
    )
    turned = Scene(
        [
            Body("body", EllipticCylinder((100.0, 150.0)), "water"),
            Body(
                "bone", EllipticCylinder(15.0, position=(-30.0, 60.0, 0.0)), "cortical_bone", "body"
            ),
        ]
    )
    points = np.array([[80.0, 20.0], [-100.0, 5.0], [60.0, 30.0]])
    scanner = scanners["large"]
    dose = primary_dose(scene, scanner, points, 0.35)
    np.testing.assert_allclose(primary_dose(scene, scanner, points, 0.7), 2.0 * dose, rtol=1e-12)
    quarter = np.stack([-points[:, 1], points[:, 0]], axis=-1)
    np.testing.assert_allclose(primary_dose(turned, scanner, quarter, 0.35), dose, rtol=1e-9)


def test_map_and_points_agree_and_air_gets_none(scanners):
    scene, grid = water_cylinder(100.0), VolumeGrid((9, 13), 11.0, (3.0, -2.0))
    dose = primary_dose(scene, scanners["large"], grid, 0.35, views=60)
    y, x = np.meshgrid(*grid.axes, indexing="ij")
    np.testing.assert_array_equal(dose > 0, np.hypot(x, y) <= 50.0)
    points = np.stack([x, y], axis=-1)
    np.testing.assert_array_equal(
        primary_dose(scene, scanners["large"], points, 0.35, views=60), dose
    )


def test_the_slice_is_the_one_asked_for(scanners):
    scene = Scene([Body("ball", Ellipsoid(50.0, position=(0.0, 0.0, 20.0)), "water")])
    at = [
        primary_dose(scene, scanners["large"], np.zeros((1, 2)), 0.35, z_mm=z)[0]
        for z in (20.0, 60.0, 71.0)
    ]
    radius = np.array([50.0, 30.0])
    energies, photons = air_fluence(scanners["large"], [0.0])
    water = material("water")
    energy = photons[0] * energies * mass_energy_absorption(water, energies)
    expected = [(energy * np.exp(-water.attenuation(energies) * r)).sum() for r in radius]
    assert at[1] / at[0] == pytest.approx(expected[1] / expected[0], rel=3e-3)
    assert at[2] == 0.0


def test_energy_groups_and_views_are_fine_enough(scanners):
    scene, points = ctdi(), disc_samples((150.0, 0.0), 6.0, 12)
    dose = primary_dose(scene, scanners["large"], points, 0.35).mean()
    fine = primary_dose(scene, scanners["large"], points, 0.35, group_kev=0.0, views=1440).mean()
    assert dose == pytest.approx(fine, rel=5e-3)
    centre = [
        primary_dose(scene, scanners["large"], np.zeros((1, 2)), 0.35, group_kev=k)[0]
        for k in (3.0, 0.0)
    ]
    assert centre[0] == pytest.approx(centre[1], rel=5e-3)


def test_fluence_is_the_scanner_s_quanta(scanners):
    for scanner in scanners.values():
        g = scanner.geometry
        energies, photons = scanner.quanta()
        ours = air_fluence(scanner, g.fan_angles)
        np.testing.assert_allclose(ours[0], energies)
        area = g.pitch[0] * g.pitch[1] * (1000.0 / g.sdd) ** 2
        np.testing.assert_allclose(ours[1] * area, photons, rtol=1e-12)
        edge = fan_half_angle(scanner)
        assert air_fluence(scanner, [edge + 1e-6])[1].sum() == 0.0


def test_groups_keep_photons_and_energy(scanners):
    energies, photons = air_fluence(scanners["large"], [0.0])
    grouped, kept = air_fluence(scanners["large"], [0.0], group_kev=4.0)
    assert kept.sum() == pytest.approx(photons.sum(), rel=1e-12)
    assert kept[0] @ grouped == pytest.approx(photons[0] @ energies, rel=1e-9)


def test_ctdi_weighting_and_roi_bowtie(scanners):
    assert CtdiDose(1.0, 2.0, 0.5, 0.25).weighted == pytest.approx(1.5 / 3 + 2 * 2.25 / 3)
    large, roi = (ctdi_dose(s, 0.35) for s in scanners.values())
    assert roi.central / large.central == pytest.approx(1.0, abs=1e-3)
    assert 0.42 < roi.peripheral / large.peripheral < 0.54
    assert large.weighted == pytest.approx((large.central + 2 * large.peripheral) / 3)


def test_narrow_fans_shade_the_outside(scanners):
    narrow = presets.pcct(rows=1, columns=400)
    point = np.array([[150.0, 0.0]])
    scene = ctdi()
    assert (
        primary_dose(scene, narrow, point, 0.35)[0]
        < 0.8 * primary_dose(scene, scanners["large"], point, 0.35)[0]
    )


# -- Monte Carlo -----------------------------------------------------------------------------------


@pytest.mark.extended
def test_monte_carlo_primary_is_the_exact_primary(scanners):
    grid, scene = VolumeGrid((110, 110), 2.0), water_cylinder(200.0)
    for scanner in scanners.values():
        result = monte_carlo_dose(scene, scanner, grid, 0.35, histories=100_000, seed=3)
        exact = primary_dose(scene, scanner, grid, 0.35, axial="contiguous")
        y, x = np.meshgrid(*grid.axes, indexing="ij")
        radius = np.hypot(x, y)
        for low, high in ((0, 40), (40, 80), (80, 98)):
            ring = (radius >= low) & (radius < high)
            spread = result.batches[:, 0, ring].mean(-1).std(ddof=1) / 4.0
            assert (
                abs(result.primary[ring].mean() - exact[ring].mean())
                < 4.0 * spread + 5e-3 * exact[ring].mean()
            )


def test_monte_carlo_conserves_energy():
    """Bone stops soft photons and sends little back: what entered is absorbed, all but the
    backscatter."""
    scanner, bone = mono(30.0), material("cortical_bone")
    scene, grid = water_cylinder(300.0, material="cortical_bone"), VolumeGrid((310, 310), 1.0)
    result = monte_carlo_dose(
        scene, scanner, grid, 1.0, histories=60_000, scan_length_mm=400.0, phantom_length_mm=400.0
    )
    absorbed = (
        (result.primary + result.scattered).sum() * bone.density_g_cm3 * 1e-3 / MGY_PER_KEV_PER_G
    )
    incident = 1000.0 * 1e6 / 626.0 * 2.0 * math.asin(150.0 / 626.0) * 30.0 * 1000.0
    assert 0.94 * incident < absorbed < incident
    thin = monte_carlo_dose(
        water_cylinder(20.0), mono(), VolumeGrid((14, 14), 2.0), 1.0, histories=60_000
    )
    assert thin.scattered.sum() < 0.4 * thin.primary.sum()


@pytest.mark.parametrize("energy", [20.0, 60.0, 120.0])
def test_compton_samples_follow_klein_and_nishina(energy):
    state, photons = np.uint64(7), []
    for _ in range(20_000):
        state, scattered, cosine = _compton(energy, np.uint64(state))
        photons.append((scattered, cosine))
    scattered, cosine = np.array(photons).T
    np.testing.assert_allclose(
        scattered, energy / (1.0 + energy / 510.99895 * (1.0 - cosine)), rtol=1e-12
    )
    electron, probability = recoil([energy])
    mean, square = ((probability * electron**k).sum() for k in (1, 2))
    assert (energy - scattered).mean() == pytest.approx(
        mean, abs=4.0 * math.sqrt((square - mean**2) / 20_000)
    )
    assert ((energy - scattered) ** 2).mean() == pytest.approx(square, rel=0.03)


@given(st.floats(-1.0, 1.0), st.floats(0.0, 6.28), st.floats(-1.0, 1.0), st.floats(0.0, 6.28))
@settings(deadline=None)
def test_scattered_directions_keep_the_angle(dz, azimuth, cosine, phi):
    across = math.sqrt(1.0 - dz * dz)
    old = np.array([across * math.cos(azimuth), across * math.sin(azimuth), dz])
    new = np.array(_turned(*old, cosine, phi))
    assert np.linalg.norm(new) == pytest.approx(1.0, abs=1e-12)
    assert old @ new == pytest.approx(cosine, abs=2e-6)


def test_a_longer_scan_adds_scatter_only(scanners):
    grid, scene = VolumeGrid((60, 60), 4.0), water_cylinder(200.0)
    short, long = (
        monte_carlo_dose(
            scene, scanners["large"], grid, 0.35, histories=16_000, scan_length_mm=length
        )
        for length in (5.0, 100.0)
    )
    np.testing.assert_array_equal(short.primary, long.primary)
    assert short.scattered.sum() < 0.3 * long.scattered.sum()


@pytest.mark.parametrize("energy", [20.0, 80.0])
def test_rayleigh_samples_follow_the_form_factor(energy):
    squares, cumulative = _form_factor(material("water"))
    state, cosines = np.uint64(11), []
    for _ in range(20_000):
        state, cosine = _rayleigh(energy, squares, cumulative, np.uint64(state))
        cosines.append(cosine)
    c = np.linspace(-1.0, 1.0, 20_001)
    x2 = (energy / 12.398419843) ** 2 * (1.0 - c) / 2.0
    density = np.gradient(np.interp(x2, squares, cumulative), x2) * (1.0 + c * c)
    mean, square = ((density * c**k).sum() / density.sum() for k in (1, 2))
    assert np.mean(cosines) == pytest.approx(
        mean, abs=5.0 * math.sqrt((square - mean**2) / 20_000) + 1e-3
    )


def test_scatter_brings_the_centre_up(scanners):
    """A measured 32 cm phantom reads about twice at the periphery of what it reads at the
    centre, not ten times."""
    dose = ctdi_dose(scanners["large"], 0.35, histories=160_000)
    assert 1.6 < dose.total_peripheral / dose.total_central < 2.8
    assert dose.peripheral / dose.central > 8.0
    assert dose.weighted_error < 0.05 * dose.weighted


def test_monte_carlo_repeats_and_differs_by_seed(scanners):
    grid, scene = VolumeGrid((60, 60), 4.0), water_cylinder(200.0)
    run = [
        monte_carlo_dose(scene, scanners["large"], grid, 0.35, histories=3200, seed=s).scattered
        for s in (1, 1, 2)
    ]
    np.testing.assert_array_equal(run[0], run[1])
    assert not np.array_equal(run[0], run[2])


def test_form_factor_is_that_of_the_electrons():
    """Forward scatter sees all electrons: F² = Z² per atom."""
    x2, cumulative = _form_factor(material("aluminium"))
    assert (cumulative[1] / x2[1]) * 26.98 == pytest.approx(13.0**2, rel=0.01)
    assert (np.diff(cumulative) > 0).all()


def test_bad_input_is_refused(scanners):
    scanner, scene, grid, point = (
        scanners["large"],
        water_cylinder(),
        VolumeGrid((110, 110), 2.0),
        np.zeros((1, 2)),
    )
    moving = scene.with_motion(SinusoidalMotion("cylinder", 1.0))
    simulated = monte_carlo_dose(scene, scanner, grid, 0.35, histories=160)

    def drawn(grid=grid, scene=scene, **options):
        return monte_carlo_dose(scene, scanner, grid, options.pop("exposure_s", 0.35), **options)

    refused(
        ("quantity", lambda: primary_dose(scene, scanner, point, 0.35, quantity="kerma")),
        ("axial", lambda: primary_dose(scene, scanner, point, 0.35, axial="helical")),
        ("views", lambda: primary_dose(scene, scanner, point, 0.35, views=0)),
        ("group_kev", lambda: primary_dose(scene, scanner, point, 0.35, group_kev=-1.0)),
        ("kryptonite", lambda: primary_dose(scene, scanner, point, 0.35, medium="kryptonite")),
        ("exposure_s", lambda: primary_dose(scene, scanner, grid, 0.0)),
        ("exposure_s", lambda: primary_dose(scene, scanner, grid, math.nan)),
        ("exposure_s", lambda: drawn(exposure_s=0.0)),
        ("exposure_s", lambda: drawn(exposure_s=math.nan)),
        ("orbit", lambda: primary_dose(scene, scanner, np.array([[700.0, 0.0]]), 0.35)),
        ("2-D", lambda: primary_dose(scene, scanner, VolumeGrid((1, 3, 3), 1.0), 0.35)),
        ("shape", lambda: primary_dose(scene, scanner, np.zeros(3), 0.35)),
        ("moves", lambda: primary_dose(moving, scanner, grid, 0.35)),
        ("edge of the grid", lambda: drawn(VolumeGrid((50, 50), 2.0))),
        ("square", lambda: drawn(VolumeGrid((110, 110), (2.0, 2.5)))),
        ("scan_length", lambda: drawn(scan_length_mm=200.0)),
        ("histories", lambda: drawn(histories=3)),
        ("no body", lambda: drawn(scene=water_cylinder(100.0, length=10.0), z_mm=50.0)),
        ("contiguous", lambda: ctdi_dose(scanner, 0.35, axial="plane", histories=100)),
        ("mask", lambda: simulated.mean(np.zeros((3, 3), bool))),
    )
