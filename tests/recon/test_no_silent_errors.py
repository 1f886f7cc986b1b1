"""What once gave a wrong volume without a word: each is refused, warned of, or right
(reconstruction)."""

import logging
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import Ellipsoid, line_integrals
from small_scan import CENTER, GRID, SCENE, scanner

from recon import fbp, reconstruct
from recon.analytic.angular_weights import angular_weights
from recon.analytic.coverage import check_rows, consistency_warnings, sampling_warnings
from recon.analytic.fbp import interleave
from recon.metal import metal_warnings
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Scan, VolumeGrid, acquire, full_turn
from torchpcct.scene import Body, EllipticCylinder, Scene


@pytest.mark.parametrize("method", ["fbp", "pwls"])
@pytest.mark.parametrize("z", [500.0, -60.0])
def test_a_grid_above_or_below_the_rows_is_refused(clean, method, z):
    with pytest.raises(ValueError, match=r"above or below all|seen in no view"):
        reconstruct(clean, VolumeGrid(GRID.shape, GRID.spacing, (z, *CENTER[1:])), method)


def test_slices_that_the_rows_do_not_see_are_named(clean, caplog):
    tall = VolumeGrid((60, 4, 4), 0.4, CENTER)
    report = reconstruct(clean, tall, "fbp").report
    assert any("are seen in no view" in text for text in report["warnings"])
    assert "are seen in no view" in caplog.text
    # 12 rows of 0.5 mm at the axis; at the plaque, 42 mm from it, between (626 − 42) / 626 and (626
    # + 42) / 626 of it.
    g = clean.geometry
    edge = 6 * g.pitch[0] / g.magnification * (g.sod - math.hypot(*CENTER[1:])) / g.sod
    inside = VolumeGrid((1, 1, 1), 0.01, (0.98 * edge, *CENTER[1:]))
    outside = VolumeGrid((1, 1, 1), 0.01, (1.02 * edge, *CENTER[1:]))
    assert check_rows(g, inside) == []
    assert len(check_rows(g, outside)) == 1
    assert "not seen in every view" in check_rows(g, outside)[0]


def test_fbp_of_a_tensor_refuses_a_grid_beyond_the_rows():
    g = ConeBeam(full_turn(8), 500.0, 1000.0, 64, 16, 1.0)
    with pytest.raises(ValueError, match="seen in no view"):
        fbp(torch.zeros(g.shape), g, VolumeGrid((4, 4, 4), 0.5, (50.0, 0.0, 0.0)))


@pytest.mark.parametrize("views", [1, 2, 3, 4])
def test_a_handful_of_views_is_refused(views):
    for g in (
        FanBeam(full_turn(views), 500.0, 1000.0, 64, 1.0),
        ConeBeam(full_turn(views), 500.0, 1000.0, 64, 4, 1.0),
    ):
        with pytest.raises(ValueError, match="too few"):
            angular_weights(g)
    if views < 3:
        with pytest.raises(ValueError, match="too few"):
            angular_weights(ParallelBeam(full_turn(views) / 2, 64, 1.0))


def test_views_that_are_all_equal_are_refused():
    with pytest.raises(ValueError, match=r"1 distinct view .* too few"):
        angular_weights(FanBeam(np.full(100, 0.7), 500.0, 1000.0, 64, 1.0))


def test_views_that_lack_inside_of_the_scan_are_refused_or_named(caplog):
    """One gap is the end of the scan. A second one was filled in silently, 113 HU off."""
    angles = full_turn(360)

    def lacking(*gaps):
        kept = np.ones(360, bool)
        for first, count in gaps:
            kept[first : first + count] = False
        return FanBeam(angles[kept], 500.0, 1000.0, 64, 1.0)

    angular_weights(lacking((100, 20)))  # an over-scan of 340°
    assert caplog.text == ""
    with pytest.raises(ValueError, match=r"gap of 11\.00°"):
        angular_weights(lacking((100, 20), (200, 10)))
    angular_weights(lacking((100, 20), (200, 3)))
    assert "gap of 4.00°" in caplog.text
    jitter = np.random.default_rng(0).uniform(-0.4, 0.4, 360) * math.radians(1)
    caplog.clear()
    angular_weights(FanBeam(angles + jitter, 500.0, 1000.0, 64, 1.0))
    assert caplog.text == ""


@pytest.mark.parametrize(
    ("kind", "radius", "degrees", "lacking"),
    [
        ("fan", 110.0, (0, 360), None),
        ("fan", 110.0, (0, 213), None),  # half a turn and the fan of the object
        ("fan", 110.0, (0, 180), 24),  # 2 asin(110 / 500) less what a rim of 5 % leaves
        ("fan", 40.0, (0, 190), None),  # this one's fan is 9°
        ("parallel", 110.0, (0, 180), None),
        ("parallel", 110.0, (0, 160), 20),
    ],
)
def test_lines_that_no_view_measured_are_named(kind, radius, degrees, lacking):
    """A fan over half a turn: PWLS and MBIR were 60 HU off without a word."""
    angles = np.deg2rad(np.arange(*degrees, 2.0))
    g = FanBeam(angles, 500.0, 900.0, 256, 1.8) if kind == "fan" else ParallelBeam(angles, 256, 1.0)
    lines = line_integrals(g, [Ellipsoid((0.0, 0.0), (radius, 0.9 * radius), value=0.02)], sub=1)
    lines += 0.002 * np.random.default_rng(0).standard_normal(lines.shape)
    scan = Scan.from_line_integrals(lines.astype(np.float32), g, mu_water=0.02)
    found = [
        t for t in consistency_warnings(scan, VolumeGrid((50, 50), 5.0)) if "no view measured" in t
    ]
    assert len(found) == (lacking is not None), found
    if lacking is not None:
        assert float(found[0].split(" in ")[1].split("°")[0]) == pytest.approx(lacking, abs=2.0)


def test_a_gap_that_conjugate_views_fill_is_none():
    def told(views):
        g = FanBeam(np.deg2rad(views), 500.0, 900.0, 256, 1.8)
        lines = line_integrals(g, [Ellipsoid((0.0, 0.0), (110.0, 90.0), value=0.02)], sub=1)
        scan = Scan.from_line_integrals(lines.astype(np.float32), g, mu_water=0.02)
        return any(
            "no view measured" in t for t in consistency_warnings(scan, VolumeGrid((50, 50), 5.0))
        )

    turn = np.arange(0, 360, 2.0)
    assert not told(turn[(turn < 100) | (turn >= 140)])
    assert told(turn[(turn < 100) | ((turn >= 140) & (turn < 220))])


def test_few_views_are_named(clean):
    assert "120 views are few" in sampling_warnings(clean.geometry)[0]
    assert sampling_warnings(clean.geometry.select(slice(None))) == sampling_warnings(
        clean.geometry
    )
    assert sampling_warnings(replace(clean.geometry, angles=full_turn(1968))) == []
    assert any(
        "120 views are few" in text for text in reconstruct(clean, GRID, "fbp").report["warnings"]
    )


@pytest.mark.parametrize("method", ["fbp", "pwls"])
def test_scans_of_other_objects_are_not_reconstructed_with_the_first_ones_exterior(clean, method):
    """A slightly larger patient: with the first patient's exterior it was 35 HU off."""
    large = Scene([Body("patient", EllipticCylinder(124.0), "pericoronary_fat"), *SCENE.bodies[1:]])
    other = acquire(large, scanner(), region=GRID, duty=0.06, sub_rays=16)
    with pytest.raises(ValueError, match="another exterior"):
        reconstruct([clean, other], GRID, method)
    reconstruct([clean.with_noise(2.0, 0), clean.with_noise(2.0, 1)], GRID, "fbp")


def test_interleave_needs_a_quarter_column_conjugate_rays_and_many_views(caplog):
    full = FanBeam(full_turn(2000), 500.0, 1000.0, 64, 1.0, 0.25)
    interleave(torch.zeros(full.shape), full)
    odd = replace(full, columns=63, offset=-0.25)
    interleave(torch.zeros(odd.shape), odd)
    assert caplog.text == ""
    for bad in (replace(full, offset=0.0), replace(full, offset=0.5)):
        with pytest.raises(ValueError, match="quarter"):
            interleave(torch.zeros(bad.shape), bad)
    short = full.select(slice(1300))
    with pytest.raises(ValueError, match="conjugate of every ray"):
        interleave(torch.zeros(short.shape), short)
    few = replace(full, angles=full_turn(90))
    with caplog.at_level(logging.WARNING):
        interleave(torch.zeros(few.shape), few)
    # pitch at the axis 0.5 mm, 2π / 90 a view
    assert f"only within {0.25 / (2 * math.pi / 90):.1f} mm" in caplog.text


def test_pwls_says_when_its_volume_does_not_explain_the_data(clean, caplog):
    """One scan at 2 s: a quarter of a column, 1 % of gain and a body beyond the grid are each
    found; noise is not."""
    scan = clean.with_noise(2.0, 2)
    report = reconstruct(scan, GRID, "pwls").report
    assert report["warnings"] == []
    assert caplog.text == ""
    # The fit takes up part of the noise, at most a value per voxel.
    assert 1 - GRID.voxels / scan.counts.numel() - 0.03 < report["chi2"] < 1.03

    g = scan.geometry
    moved = replace(scan, geometry=replace(g, offset=(g.offset[0], g.offset[1] + 0.4 * g.pitch[1])))
    assert any(
        "rotation centre" in text for text in reconstruct(moved, GRID, "pwls").report["warnings"]
    )
    assert "rotation centre" in caplog.text

    drift = 1 + 0.01 * torch.linspace(0, 1, g.views)[:, None, None]
    drifted = replace(scan, counts=scan.counts * drift)
    assert any(
        "gain changed" in text for text in reconstruct(drifted, GRID, "pwls").report["warnings"]
    )

    metal = scan.counts.clone()
    metal[:, 4:8, 138:146] *= 0.02  # 8113 HU once, without a word
    found = reconstruct(replace(scan, counts=metal), GRID, "pwls").report
    assert any("stated noise variance" in text for text in found["warnings"])
    assert found["chi2"] > 2


@pytest.mark.parametrize("method", ["fbp", "pwls"])
def test_a_dead_column_and_a_dead_view_are_repaired_and_named(clean, method):
    """FBP's error was 1400 to 3750 HU, without a word."""
    scan = clean.with_noise(2.0, 0)
    broken = scan.counts.clone()
    column = int(scan.window.first_column[30]) + 140
    for v, first in enumerate(scan.window.first_column):
        if first <= column < first + scan.window.columns:
            broken[v, :, column - first] = 0
    broken[70] = 0
    good = reconstruct(scan, GRID, method)
    repaired = reconstruct(replace(scan, counts=broken), GRID, method)
    assert "dead detector cells, 1 view without signal" in repaired.report["warnings"][0]
    # The noise of a good scan at this dose is the measure.
    noise = float((good.data - reconstruct(clean, GRID, method).data).std())
    assert float((repaired.data - good.data).square().mean().sqrt()) < noise


BODIES = [
    Ellipsoid((y, x), (b, a), value=mu)
    for a, b, x, y, mu in ((90, 60, 8, -5, 0.02), (12, 9, 50, 10, 0.03), (20, 15, -30, 8, -0.015))
]


def _ellipse_scan(views, columns):
    """A fan-beam scan of an ellipse with a bone and a hole in it, 1e5 photons."""
    g = FanBeam(full_turn(views), 500.0, 900.0, columns, 480.0 / columns)
    shone = np.exp(-line_integrals(g, BODIES, sub=1))
    return g, np.random.default_rng(0).poisson(1e5 * shone).astype(np.float32)


def _warnings_of(readings, geometry, method):
    scan = Scan.from_counts(readings, geometry, air=1e5, mu_water=0.02)
    return " ".join(reconstruct(scan, VolumeGrid((24, 32), 6.8), method).report["warnings"])


def test_wrong_descriptions_and_readings_are_named():
    """Each was wrong without a warning; a sound scan says nothing."""
    g, counts = _ellipse_scan(180, 200)
    words = {
        "steps between the views": (counts, replace(g, angles=0.98 * g.angles)),
        "(sdd)": (counts, replace(g, sdd=1.03 * g.sdd)),
        "counted the other way": (counts[:, ::-1].copy(), g),
        "first and the last column": (counts[:, 60:140], replace(g, columns=80)),
        "the sum of a view's line integrals": (counts * np.exp(0.1 - 0.1e-5 * counts), g),
        "no row ends in air": (counts / 2, g),
        "column 70 reads 1.6 ±": (counts * np.where(np.arange(200) == 70, 1.6, 1.0), g),
    }
    assert _warnings_of(counts, g, "fbp") == ""
    for text, wrong in words.items():
        assert text in _warnings_of(*wrong, "fbp")


@pytest.mark.parametrize("method", ["pwls", "mbir"])
def test_iterative_methods_name_what_is_cut_off(method):
    """Both take what the detector does not show for free: values were -28 to 22 HU off by MBIR,
    without a word."""
    g, counts = _ellipse_scan(90, 60)
    assert "first and the last column" in _warnings_of(
        counts[:, 15:45], replace(g, columns=30), method
    )


def test_fbp_of_a_wrong_rotation_centre_is_named(clean):
    """Half a column was 50 HU rms without a word; a right centre says nothing."""
    noisy = clean.with_noise(20.0, 0)
    assert consistency_warnings(noisy, GRID) == []
    g = noisy.geometry
    wrong = replace(noisy, geometry=replace(g, offset=(g.offset[0], g.offset[1] + g.pitch[1] / 2)))
    found = reconstruct(wrong, GRID, "fbp").report["warnings"]
    assert any("conjugate rays disagree" in text and "too high" in text for text in found)


@pytest.mark.parametrize(
    ("change", "expected_text"),
    [
        (
            lambda n, air, gain: n * torch.exp(0.1 - 0.1 * n / air),
            "above those of the known exterior",
        ),
        (lambda n, air, gain: n + 0.001 * air, "above those of the known exterior"),
        (lambda n, air, gain: n.clamp(max=float(n.mean())), "below those of the known exterior"),
        (lambda n, air, gain: n * gain, "gains that the calibration in air did not see"),
        (lambda n, air, gain: n, ""),
    ],
    ids=["pile-up", "dark signal", "saturation", "gains", "sound"],
)
def test_a_window_that_does_not_read_its_exterior_is_named(clean, change, expected_text):
    """FBP of an inset took them for the inset's own, 30 to 120 HU off; PWLS and MBIR see them in
    their residual."""
    air = clean._at_window(clean.air)
    gain = clean.window.take(
        1 + 0.01 * torch.randn(clean.air.shape, generator=torch.Generator().manual_seed(0))
    )
    changed = replace(clean, counts=change(clean.counts, air, gain))
    for seed in range(3):
        found = [
            t
            for t in consistency_warnings(changed.with_noise(4.0, seed), GRID)
            if "exterior" in t or "gains" in t
        ]
        assert len(found) == bool(expected_text)
        assert not expected_text or expected_text in found[0]


def test_few_counts_and_lost_readings_do_not_speak_against_the_exterior(clean):
    few, scan = clean.with_noise(0.02, 0), clean.with_noise(4.0, 0)
    lost = torch.rand(few.counts.shape, generator=torch.Generator().manual_seed(1)) < 0.1
    for given in (few, replace(scan, counts=scan.counts.masked_fill(lost, 0.0))):
        assert not [t for t in consistency_warnings(given, GRID) if "exterior" in t]


def _noise(sd):
    return sd * torch.randn((16, 24, 24), generator=torch.Generator().manual_seed(0))


def test_noise_and_bone_are_no_metal():
    assert metal_warnings(_noise(900.0)) == []  # its largest value is 3500 HU
    assert float(_noise(900.0).max()) > 3000
    bone = _noise(50.0)
    bone[4:8, 4:8, 4:8] += 2200
    assert metal_warnings(bone) == []


def test_a_rod_of_titanium_is_metal_whatever_the_noise():
    for sd in (0.0, 50.0, 900.0):
        volume = _noise(sd)
        volume[:, 10:13, 10:13] += 16000.0
        (text,) = metal_warnings(volume)
        assert "metal" in text


def test_what_rings_is_no_metal_and_hides_none():
    """An iteration that has not ended rings where few views look: 14 000 HU beside −13 000."""
    x = torch.arange(24.0)
    ringing = _noise(20.0)
    ringing[0, :, 18:] -= 14_000.0 * torch.cos(torch.pi * x[18:]) * torch.exp((x[18:] - 23.0) / 4)
    assert float(ringing.max()) > 12_000.0
    assert metal_warnings(ringing) == []
    ringing[5, 4:7, 4:7] += 8_000.0  # a screw
    (text,) = metal_warnings(ringing)
    assert 8_000 <= int(text.split("reaches ")[1].split(" HU")[0]) < 8_100
    # Edges undershoot, streaks are dark.
    screw = _noise(20.0)[5] - 1000.0
    screw[10:13, 10:13] += 9_000.0
    screw[9:14, [9, 13]] -= 1_800.0
    screw[11, 13:] -= 1_500.0
    assert len(metal_warnings(screw)) == len(metal_warnings(screw.flatten())) == 1


def test_fbp_names_metal_in_hu_and_knows_nothing_of_it_in_other_units():
    columns = (np.arange(64) - 31.5) * 0.5
    geometry = ParallelBeam(np.arange(90) * np.pi / 90, 64, 0.5)

    def disc(radius):
        return 2 * np.sqrt(np.clip(radius**2 - columns**2, 0, None))

    grid = VolumeGrid((40, 40), 0.5)
    for pin, unit, warned in (
        (0.0, {"mu_water": 0.02}, False),
        (0.4, {"mu_water": 0.02}, True),
        (1.5, {}, False),  # read against the scan's own unit it would be metal
    ):
        lines = np.broadcast_to(0.02 * disc(12) + pin * disc(1.5), geometry.shape)
        volume = reconstruct(
            Scan.from_line_integrals(lines, geometry, photons=1e5, **unit), grid, "fbp"
        )
        assert any("metal" in text for text in volume.report["warnings"]) is warned
