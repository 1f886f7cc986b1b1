"""Simulated scans against oversampled exact references, and the invariances of acquisition."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refused

from torchpcct.acquisition.acquire import acquire, plan
from torchpcct.acquisition.transmission import SUB_RAY_COUNTS, compress, sub_rays
from torchpcct.geometry import ConeBeam, VolumeGrid, full_turn
from torchpcct.scanner import SiliconDetector, presets
from torchpcct.scene import (
    Body,
    Box,
    Ellipsoid,
    EllipticCylinder,
    Scene,
    SinusoidalMotion,
    chord_lengths,
)
from torchpcct.scene.phantoms.quality import water_cylinder
from torchpcct.scene.plaque import plaque_scene
from torchpcct.scene.plaque.variants import plaque_variant

INSET = VolumeGrid((57, 45, 45), 0.2, (0.0, -30.38, -29.63))
NOISY = {"exposure_s": 0.35, "seed": 4}


def scanner(views=24, rows=4, **changes):
    s = presets.pcct(views=views)
    return s.replace(geometry=replace(s.geometry, rows=rows, **changes))


@pytest.fixture(scope="module")
def plaque():
    return plaque_scene()


@pytest.fixture(scope="module")
def clean(plaque):
    return acquire(plaque[0], scanner(), region=INSET, duty=0.02)


def test_an_interrupted_scan_goes_on_with_what_was_kept(plaque):
    kept, computed = {}, []

    def keep(name, compute, most=2):
        if name not in kept:
            if len(computed) == most:
                raise KeyboardInterrupt
            computed.append(name)
            kept[name] = compute()
        return kept[name]

    def scan(**options):
        return acquire(plaque[0], scanner(200, 2), region=INSET, duty=0.02, sub_rays=1, **options)

    with pytest.raises(KeyboardInterrupt):
        scan(keep=keep)
    assert computed == ["views_0-64", "views_64-128"]
    computed.clear()
    again = scan(keep=keep)
    assert computed == ["views_128-192", "views_192-200"]
    assert torch.equal(again.counts, scan().counts)


def reference_line_integrals(scene, scan_system, cells, duty, count, rng):
    """Brute force: every sub-ray of a reading is a random beam sample, every energy is summed.
    ``cells`` (N, 3)."""
    g = scan_system.geometry
    energies, spectra = scan_system.weights()
    contrast = scene.contrast(energies)
    step = duty * 2 * np.pi / g.views
    focal = scan_system.source.focal_spot
    result = []
    for view, row, column in cells:
        # Stratified in the five beam coordinates by a shuffled (Latin hypercube) design.
        x = (
            np.stack([rng.permutation(count) for _ in range(5)], 1) + rng.random((count, 5))
        ) / count - 0.5
        beta = g.angles[view] + x[:, 4] * step
        er = np.stack([np.cos(beta), np.sin(beta), 0 * beta], 1)
        et = np.stack([-np.sin(beta), np.cos(beta), 0 * beta], 1)
        ez = np.array([0.0, 0.0, 1.0])
        centre = g.sod * er
        source = centre + (x[:, :1] * focal[0]) * et + x[:, 1:2] * focal[1] * ez
        gamma = (g.column_positions[column] + x[:, 2] * g.pitch[1]) / g.sdd
        cell = centre + g.sdd * (-np.cos(gamma)[:, None] * er + np.sin(gamma)[:, None] * et)
        cell = cell + (g.row_positions[row] + x[:, 3] * g.pitch[0])[:, None] * ez
        direction = cell - source
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        transmitted = np.exp(-(chord_lengths(scene, source, direction).T @ contrast)).mean(0)
        w = spectra[0, column]
        result.append(np.log(w.sum()) - np.log((w * transmitted).sum()))
    return np.array(result)


def compared(scene, scan, seen, cells, rays, seed):
    """Errors of ``cells`` readings whose inset adds more than a share ``seen`` of its peak;
    peaks of all and of it."""
    polychromatic = (scan._at_window(scan.air.log()) - scan.counts.log()).numpy()
    inset = polychromatic - scan._at_window(scan.air.log() - scan.exterior.log()).numpy()
    rng = np.random.default_rng(seed)
    chosen = np.argwhere(inset > seen * inset.max())
    chosen = chosen[rng.choice(len(chosen), cells, replace=False)]
    at = np.stack(
        [chosen[:, 0], chosen[:, 1], scan.window.first_column[chosen[:, 0]] + chosen[:, 2]], 1
    )
    exact = reference_line_integrals(scene, scanner(), at, 0.02, rays, rng)
    return polychromatic[tuple(chosen.T)] - exact, polychromatic.max(), inset.max()


def test_line_integrals_against_brute_force(plaque, clean):
    """Error at most 1e-3 of the line integral's peak, and rms 1e-3 of what the plaque alone adds
    to it."""
    error, peak, inset = compared(plaque[0], clean, 0.002, 60, 6000, 1)
    assert np.abs(error).max() < 1e-3 * peak
    assert np.sqrt(np.mean(error**2)) < 1e-3 * inset


def test_metal_edges_against_brute_force():
    """Thin metal covers a part of a cell: the line integral varies by more than 1 inside it at
    low energies."""
    scene, _ = plaque_variant("stent")
    scan = acquire(scene, scanner(), region=INSET, duty=0.02)
    assert torch.isfinite(scan.line_integrals()).all()
    error, _, inset = compared(scene, scan, 0.5, 20, 20000, 2)
    assert np.sqrt(np.mean(error**2)) < 0.03 * inset


PILED_UP = SiliconDetector("spectral", dead_time_ns=50.0)


@pytest.mark.parametrize(
    "system",
    [
        scanner(),
        presets.eid(views=12, rows=4),
        presets.pcct(views=6, mode="spectral", rows=2, detector=PILED_UP),
    ],
    ids=["counting", "energy-integrating", "pile-up"],
)
def test_region_is_the_crop_of_the_whole_scan(plaque, system):
    """Readings, air and noise: a region sees the pile-up, and draws the random numbers, of the
    whole."""
    part, whole = (
        acquire(plaque[0], system, region=region, duty=0.02, sub_rays=16)
        for region in (INSET, None)
    )
    w = part.window
    columns = torch.from_numpy(w.column_indices)[:, None].expand(-1, w.rows, -1)

    def crop(scan):
        counts = scan.counts[..., w.first_row : w.first_row + w.rows, :]
        return counts.gather(-1, columns.expand(*counts.shape[:-1], -1))

    torch.testing.assert_close(part.counts, crop(whole), rtol=1e-6, atol=0)
    torch.testing.assert_close(part.air, whole.air, rtol=1e-6, atol=0)
    # The same noise, up to readings whose expectation rounds differently.
    same = part.with_noise(0.35, 5).counts == crop(whole.with_noise(0.35, 5))
    assert same.float().mean() > 0.9999


@pytest.mark.parametrize("make", [presets.pcct, presets.eid])
def test_a_noisy_scan_is_the_clean_one_with_the_noise_of_its_seed(make):
    system = make(views=16, rows=2)
    clean, noisy = (
        acquire(water_cylinder(200.0), system, sub_rays=16, **how) for how in ({}, NOISY)
    )
    assert clean.counting == (make is presets.pcct)
    assert (noisy.exposure_s, noisy.seed) == (0.35, 4)
    assert torch.equal(noisy.counts, clean.with_noise(0.35, 4).counts)
    assert not torch.equal(noisy.counts, clean.with_noise(0.35, 5).counts)


def test_turning_the_object_turns_the_scan():
    """A scene turned by 30° about the axis, scanned from angles turned by 30°, gives the same
    readings."""

    def scan(turn):
        position = (40 * np.cos(turn), 40 * np.sin(turn), 1.0)
        scene = Scene(
            [
                Body("water", EllipticCylinder(100.0), "water"),
                Body(
                    "bone",
                    Ellipsoid((5.0, 3.0, 4.0), position=position, rotation=turn),
                    "cortical_bone",
                    "water",
                ),
            ]
        )
        system = scanner(12, 4)
        geometry = replace(system.geometry, angles=full_turn(12, turn))
        return acquire(scene, system.replace(geometry=geometry), duty=0.02, sub_rays=16)

    torch.testing.assert_close(scan(0.0).counts, scan(np.pi / 6).counts, rtol=2e-6, atol=0)


def test_motion_is_exact_in_every_view():
    """A moving body seen in one view reads as the same body standing where it is at that moment."""
    ball = Ellipsoid((4.0, 4.0, 4.0), position=(30.0, 0.0, 0.0))
    bodies = [
        Body("fat", EllipticCylinder(100.0), "pericoronary_fat"),
        Body("ball", ball, "water", "fat"),
    ]
    motion = SinusoidalMotion("ball", 2.0)
    system = scanner(16, 2)
    moving = acquire(
        Scene(bodies, motion), system, rotation_s=0.35, duty=1e-3, sub_rays=16, tolerance_hu=0
    )
    time = system.geometry.angles[5] / (2 * np.pi) * 0.35
    shift = motion.displacement([time])[0]
    assert abs(shift).max() > 0.5
    standing = Scene(
        [
            bodies[0],
            replace(bodies[1], shape=replace(ball, position=tuple(np.add(ball.position, shift)))),
        ]
    )
    still = acquire(standing, system, duty=1e-3, sub_rays=16, tolerance_hu=0)
    torch.testing.assert_close(moving.counts[5], still.counts[5], rtol=1e-5, atol=0)
    assert not torch.allclose(moving.counts[9], still.counts[9], rtol=1e-4)


def test_plan_models_only_what_the_scene_needs(plaque):
    full = plan(plaque[0], scanner(), region=INSET)
    modelled = {e.name for e in full.effects if e.modelled}
    assert {"polychromatic spectrum", "focal spot", "cell aperture"} <= modelled
    assert "motion" not in modelled
    assert "HU if omitted" in full.table()
    pulsed = plan(plaque[0], scanner(), region=INSET, duty=1e-4)
    assert "gantry turn during a view" not in {e.name for e in pulsed.effects if e.modelled}
    coarse = plan(plaque[0], scanner(), region=INSET, tolerance_hu=1e6)
    assert {e.name for e in coarse.effects if e.modelled} == {"polychromatic spectrum"}
    assert len(coarse.points) == 1


def test_the_plan_says_what_the_detector_does():
    """Pile-up and charge sharing are modelled exactly if the detector has them, and then the
    readings show it."""
    system = presets.pcct(views=2, rows=1, columns=100, energy_bin_kev=5.0)

    def scan(**changes):
        detector = replace(system.detector, **changes)
        scan = acquire(water_cylinder(200.0), system.replace(detector=detector), sub_rays=1)
        return {e["name"]: e["modelled"] for e in scan.info["plan"]["effects"]}, scan.air

    effects, ideal = scan()
    assert effects["pile-up, charge sharing"] is False
    for changes, expected in (
        ({"dead_time_ns": 50.0}, (True, False)),
        ({"charge_sharing": 0.1}, (False, True)),
    ):
        effects, air = scan(**changes)
        assert (effects["pile-up"], effects["charge sharing"]) == expected
        assert (air != ideal).all()


@pytest.mark.parametrize("make", [presets.pcct, presets.eid])
def test_the_plan_speaks_of_the_scanners_own_detector(make):
    """An energy-integrating scintillator is no counting silicon."""
    system = make(views=2, rows=1, columns=100, energy_bin_kev=5.0)
    scan = acquire(water_cylinder(200.0), system, sub_rays=1)
    notes = {e["name"]: e["note"] for e in scan.info["plan"]["effects"]}
    assert set(notes) >= {"scatter", "pile-up, charge sharing", "afterglow, readout cross-talk"}
    silicon = "counting silicon has no afterglow" in notes["afterglow, readout cross-talk"]
    assert silicon == ("count rate" in notes["pile-up, charge sharing"])
    assert silicon == (not system.detector.energy_integrating)


def test_a_scene_without_symmetric_bodies():
    """Nothing lies around the only body: rays that miss it read air."""
    ball = Ellipsoid(4.0, position=(30.0, 0.0, 0.0))
    region = VolumeGrid((24, 24, 24), 0.5, (0.0, 0.0, 30.0))
    scan = acquire(Scene([Body("ball", ball, "water")]), scanner(8, 2), region=region, sub_rays=16)
    torch.testing.assert_close(scan.exterior, scan.air, rtol=1e-6, atol=0)
    p = scan.line_integrals()
    assert p.max() == pytest.approx(8.0 * scan.linearisation.mu_ref, rel=0.02)
    assert p.amin(dim=-1).abs().max() < 1e-6


def test_sub_rays_do_not_shift_a_reading():
    for count in SUB_RAY_COUNTS:
        points = sub_rays(count)
        assert points.shape == (count, 5)
        assert np.abs(points.mean(0)).max() < 1e-12
        assert np.abs(points).max() <= 0.55
    assert np.abs(sub_rays(16, (True, False, True, False, False))[:, [1, 3, 4]]).max() == 0


def test_compression_of_the_contrast_is_exact_to_its_tolerance(plaque):
    energies, _ = scanner().weights()
    contrast = plaque[0].contrast(energies)
    coefficients, basis = compress(contrast)
    assert basis.shape[0] <= 5
    assert np.abs(coefficients @ basis - contrast).max() * 1000 <= 1e-9


def test_refusals_come_early(plaque):
    def scan(scene=plaque[0], **changes):
        return acquire(scene, scanner(8, 2), **{"region": INSET, **changes})

    refused(
        ("exposure_s", lambda: scan(exposure_s=0.0)),
        ("exposure_s", lambda: scan(exposure_s=float("nan"))),
        ("seed", lambda: scan(exposure_s=0.35, seed=-1)),
        ("duty", lambda: scan(duty=0.0)),
        ("sub-rays", lambda: scan(sub_rays=5)),
        ("sub-rays", lambda: sub_rays(7)),
        ("region", lambda: scan(region=VolumeGrid((4, 4, 4), 0.2, (0, 0, 60.0)))),
        ("three numbers", lambda: scan(region=VolumeGrid((45, 45), 0.2, INSET.center[1:]))),
        ("field of view|orbit", lambda: scan(region=VolumeGrid((4, 4, 4), 0.2, (0, 0, 500.0)))),
        ("rotation_s", lambda: scan(plaque_scene(motion_amplitude=2.0)[0])),
        (r"exposure_s must be at most 1e\+12 s", lambda: scan(exposure_s=1e300)),
        (r"'jar' reaches the tube, 626 mm from", lambda: scan(round_about(700.0), region=None)),
        (r"'jar' reaches the detector, 472 mm", lambda: scan(round_about(500.0), region=None)),
        (r"semi_axes\[0\] must lie in \[1e-09, 1e\+09\] mm", lambda: round_about(1e300)),
        (r"semi_axes\[0\] must lie in", lambda: Ellipsoid(1e-300)),
        (r"half_lengths\[1\] must lie in", lambda: Box((1.0, 1e300, 1.0))),
        (r"position\[2\] must lie in", lambda: Ellipsoid(1.0, position=(0.0, 0.0, 1e30))),
    )


def round_about(radius, material="water"):
    return Scene([Body("jar", EllipticCylinder(radius), material)])


def test_air_may_be_around_the_scanner():
    scan = acquire(round_about(2000.0, "air"), scanner(8, 2))
    assert bool((scan.line_integrals().abs() < 0.2).all())


SMALL = ConeBeam(full_turn(360), 626.0, 1098.0, 1500, 4, (0.5, 0.35), detector="curved")


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"sod": 500.0, "sdd": 900.0, "pitch": (0.5, 0.30)},
        {"pitch": (0.7, 0.49), "sdd": 1098.0 * 1.4},
        {"offset": (0.0, 0.35 / 4)},
        {"detector": "flat", "columns": 1700},
    ],
)
def test_water_reads_zero(changes):
    """0 ± 1 HU with the paper's geometry, ± 2 HU when sod, sdd, pitch or offset change; every
    kernel, off centre."""
    from recon.analytic.inset import InsetFbp

    system = presets.pcct(views=360).replace(geometry=replace(SMALL, **changes))
    scan = acquire(water_cylinder(200.0), system, duty=0.2, sub_rays=16)
    places = ((0.0, 0.0, 0.0), (0.0, 30.0, -25.0))
    grids = [VolumeGrid((1, 16, 16), voxel, place) for voxel in (0.1, 0.4) for place in places]
    limit = 1.0 if not changes else 2.0
    for volumes in InsetFbp(scan, grids, ("soft", "standard", "detail", "bone"))(scan):
        assert volumes.abs().max() < limit
