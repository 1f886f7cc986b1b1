"""Readers of foreign scans: files that h5py, pydicom, tifffile and numpy wrote, and damaged
ones."""

import math
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import torch
import yaml
from analytic import Ellipsoid, line_integrals
from foreign_files import ct_pd, data_exchange

from recon import reconstruct
from recon.cli import main
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Scan, VolumeGrid, full_turn
from torchpcct.acquisition.config import read_config
from torchpcct.checks.rotation_axis import axis_column
from torchpcct.formats.damage import read_yaml
from torchpcct.formats.dicom_ct_pd import read_dicom_ct_pd
from torchpcct.formats.geometry_yaml import geometry_of, geometry_values
from torchpcct.formats.preprocess import cleaned
from torchpcct.formats.rtk import read_rtk
from torchpcct.formats.scans import open_scan
from torchpcct.vector_geometry import VectorGeometry
from torchpcct.volume import Volume

MU = 0.02
BODY = [Ellipsoid((2.0, -3.0), (14.0, 18.0), value=MU), Ellipsoid((6.0, 5.0), 3.0, value=MU)]
PARALLEL = ParallelBeam(np.arange(91) * math.pi / 90, 64, 1.0, -1.75)
CONE = ConeBeam(full_turn(40), 300.0, 500.0, 64, 3, (1.5, 1.7))
CURVED = ConeBeam(full_turn(72, 0.3), 300.0, 500.0, 64, 4, (1.5, 1.7), (0.25, 0.6), "curved")


def tooth(path: Path):
    """Four slices, the second half as dense, of cells that are not alike."""
    rng, lines = np.random.default_rng(0), line_integrals(PARALLEL, BODY, sub=1)
    dark, white = 100 + rng.integers(0, 5, (4, 64)), 40000 + rng.integers(-2000, 2000, (4, 64))
    data = dark + (white - dark) * np.exp(-np.stack([lines, 0.5 * lines, lines, lines], 1))
    return data_exchange(path, data, [white] * 3, PARALLEL.angles, [dark] * 2, 1000.0)


def test_tooth(tmp_path):
    path = tooth(tmp_path / "tooth.h5")
    scan = open_scan(path, axis=31.5 + 1.75, mu_water=MU, slices=slice(1, 3))
    np.testing.assert_allclose(scan.geometry.angles, PARALLEL.angles, atol=1e-12)
    assert (scan.geometry.pitch, scan.geometry.offset) == pytest.approx((1.0, -1.75))
    lines = line_integrals(PARALLEL, BODY, sub=1)
    np.testing.assert_allclose(scan.line_integrals()[1].numpy(), lines, atol=2e-3)
    volume = reconstruct(scan, VolumeGrid((2, 32, 32), 1.0), "fbp").data
    assert float(volume[1, 12:16, 10:14].abs().max()) < 60
    with h5py.File(tmp_path / "tooth.h5", "a") as file:
        del file["exchange/theta"]
    with pytest.raises(
        ValueError, match=r"tooth\.h5 cannot be read as a Data Exchange file: it has no angles"
    ):
        open_scan(path)


@pytest.mark.parametrize(("size", "unit"), [(None, ""), (0.0, "um"), (3.0, "furlong")])
def test_without_a_pixel_size_lengths_are_in_pixels(tmp_path, size, unit):
    """The best known file of the format has none."""
    path = tooth(tmp_path / "tooth.h5")
    with h5py.File(path, "a") as file:
        del file["measurement"]
        if size is not None:
            file["measurement/instrument/detector/pixel_size"] = size
            file["measurement/instrument/detector/pixel_size"].attrs["units"] = np.array(
                [unit.encode()]
            )
    scan, known = open_scan(path), open_scan(path, pitch=0.5, mu_water=0.04)
    assert (scan.unit, scan.geometry.pitch, known.unit) == ("pixel^-1", 1.0, "HU")
    grids = [VolumeGrid((4, 32, 32), pitch) for pitch in (1.0, 0.5)]
    pixels, hu = (reconstruct(s, g, "fbp") for s, g in zip((scan, known), grids, strict=True))
    torch.testing.assert_close(pixels.data, 0.5 * 0.04 * (1 + hu.data / 1000), atol=1e-6, rtol=1e-4)
    pixels.save(tmp_path / "v.nii.gz")
    assert (pixels.unit, Volume.load(tmp_path / "v.nii.gz").unit) == ("pixel^-1", "pixel^-1")
    with pytest.raises(ValueError, match="the size of its pixels is unknown: give pitch=, too"):
        open_scan(path, mu_water=0.04)


def test_vectors_say_the_size_that_a_file_does_not_know(tmp_path):
    """In mm, but for parallel rays on cells of width 1, as a calibration in pixels writes them:
    there a pitch scales them."""
    path = tooth(tmp_path / "tooth.h5")
    with h5py.File(path, "a") as file:
        del file["measurement"]
    pixels = open_scan(path).geometry
    one = VectorGeometry.of(replace(pixels, offset=3.0))
    half = VectorGeometry.of(replace(pixels, pitch=0.5, offset=1.5))
    assert open_scan(path, one).unit == "pixel^-1"
    scaled = open_scan(path, one, pitch=0.5, mu_water=0.04)
    given = open_scan(path, half, mu_water=0.04)
    assert (scaled.unit, given.unit, open_scan(path, half).unit) == ("HU", "HU", "mm^-1")
    grid = VolumeGrid((4, 32, 32), 0.5)
    volumes = [reconstruct(s, grid, "fbp").data for s in (scaled, given)]
    torch.testing.assert_close(*volumes, atol=1e-2, rtol=0)
    with pytest.raises(ValueError, match="whose geometry has it: leave it out"):
        open_scan(path, half, pitch=0.5)
    fan = VectorGeometry.of(FanBeam(pixels.angles, 40.0, 80.0, pixels.columns, 1.0))
    assert open_scan(path, fan).unit == "mm^-1"


@pytest.mark.parametrize(
    ("size", "unit", "pitch"),
    [(5e-4, "mm^-1", 0.5), (0.65, "pixel^-1", 1.0), (1.3, "pixel^-1", 1.0)],
)
def test_a_pixel_size_without_a_unit_is_in_metres_or_unknown(tmp_path, size, unit, pitch):
    """Beamlines write µm or mm without saying so: 650 mm wide pixels are none."""
    path = tooth(tmp_path / "tooth.h5")
    with h5py.File(path, "a") as file:
        del file["measurement"]
        file["measurement/instrument/detector/pixel_size"] = size
    scan = open_scan(path)
    assert (scan.unit, scan.geometry.pitch) == (unit, pytest.approx(pitch))


@pytest.mark.parametrize(("white", "dark"), [(0.0, 0.0), (100.0, 300.0)])
def test_frames_of_dark_in_the_place_of_white_are_named(tmp_path, white, dark):
    path = tooth(tmp_path / "tooth.h5")
    with h5py.File(path, "a") as file:
        shape = file["exchange/data"].shape[1:]
        for name, value in (("data_white", white), ("data_dark", dark)):
            file.pop(f"exchange/{name}", None)
            file[f"exchange/{name}"] = np.full((5, *shape), value)
    with pytest.raises(ValueError, match="air is not brighter than dark: are the two exchanged"):
        open_scan(path)


def test_pixel_sizes_in_every_unit(tmp_path):
    path = tooth(tmp_path / "tooth.h5")
    for mm, units in (
        (1e3, "m meter meters metre metres"),
        (10.0, "cm"),
        (1.0, "mm millimeter millimeters millimetre millimetres"),
        (1e-3, "um µm μm micron microns micrometer micrometers micrometre"),
        (1e-6, "nm"),
    ):
        for unit in units.split():
            with h5py.File(path, "a") as file:
                file["measurement/instrument/detector/pixel_size"].attrs["units"] = unit
                file["measurement/instrument/detector/pixel_size"][()] = 0.7 / mm
            assert open_scan(path).geometry.pitch == pytest.approx(0.7), unit


def test_angles_start_where_they_are_said_to(tmp_path):
    """In a geometry and in a stack's description: 30°, 32°, …"""
    written = {
        "kind": "parallel",
        "angles_deg": {"start": 30, "step": 2, "count": 4},
        "columns": 5,
        "pitch": 1.0,
    }
    np.save(tmp_path / "lines.npy", np.zeros((4, 5)))
    text = {"readings": "lines.npy", "kind": "line_integrals", "geometry": written}
    (tmp_path / "stack.yaml").write_text(yaml.safe_dump(text), encoding="utf-8")
    for geometry in (geometry_of(written), open_scan(tmp_path / "stack.yaml").geometry):
        assert np.rad2deg(geometry.angles) == pytest.approx([30, 32, 34, 36])
    written["angles_deg"]["count"] = 10**12
    with pytest.raises(ValueError, match=r"angles_deg\.count must be at most 10000000"):
        geometry_of(written)


@pytest.mark.parametrize("frames", ["constant", "one", "averaged"])
def test_white_frames_that_do_not_differ(tmp_path, frames):
    """Averages that were stored, several times or once: the photons come from the noise of the
    readings."""
    rng, lines = np.random.default_rng(1), line_integrals(PARALLEL, BODY, sub=1)
    white = np.full((2, 64), 3200.0)
    data = 8 * rng.poisson(400 * np.exp(-np.stack([lines, lines], 1)))
    whites = {"constant": np.stack([white] * 9), "one": white[None], "averaged": white}[frames]
    data_exchange(tmp_path / "a.h5", data, whites, PARALLEL.angles)
    scan = open_scan(tmp_path / "a.h5", pitch=1.0)
    assert scan.info["signal_of_one_photon"] == pytest.approx(8.0, rel=0.15)
    assert float((scan.line_integrals().numpy() - lines).std()) < 0.1
    assert open_scan(tmp_path / "a.h5", gain=8.0).info["signal_of_one_photon"] == 8.0


def test_options_fit_every_format_or_are_refused_by_name(tmp_path):
    lines = line_integrals(PARALLEL, BODY, sub=1)
    np.save(tmp_path / "lines.npy", np.stack([lines] * 3))
    text = {
        "readings": "lines.npy",
        "kind": "line_integrals",
        "geometry": geometry_values(PARALLEL),
    }
    (tmp_path / "stack.yaml").write_text(yaml.safe_dump(text), encoding="utf-8")
    Scan.from_counts(np.full(CONE.shape, 50.0), CONE, air=100.0).save(tmp_path / "own.h5")
    lines.astype("<f4").tofile(tmp_path / "a.prep")
    files = {"stack.yaml": {}, "own.h5": {}, "a.prep": {"geometry": PARALLEL}}
    tooth(tmp_path / "tooth.h5")
    options = {"axis": 30.0, "pitch": 2.0, "slices": slice(1, 2), "mu_water": 0.03, "photons": 1e4}
    refused = set()
    for name in (*files, "tooth.h5"):
        for option, value in options.items():
            try:
                scan = open_scan(tmp_path / name, **files.get(name, {}), **{option: value})
            except ValueError as error:
                refused.add((name, option, str(error).split()[0]))
            else:
                g = scan.geometry
                kept = scan.counts.shape[1 if g.has_rows else 0]  # of a cone beam its rows
                seen = {
                    "axis": axis_column(g),
                    "pitch": g.pitch,
                    "slices": slice(1, 1 + kept),
                    "mu_water": scan.linearisation.mu_ref,
                    "photons": float(scan.air.max()),
                }
                assert seen[option] == (pytest.approx(value) if option != "slices" else value), (
                    name,
                    option,
                )
        with pytest.raises(TypeError, match=r"gian: no option of .*, which takes .*axis, "):
            open_scan(tmp_path / name, gian=3.0)
    expected = {("tooth.h5", "photons"), ("a.prep", "slices")}
    expected |= {("own.h5", option) for option in ("pitch", "photons")}
    assert refused == {(name, option, f"{option}=") for name, option in expected}


def test_stripes_of_a_part_of_the_turn_go_and_the_rest_stays():
    """Cells whose gain is off for 60 to 120 of 240 views, or that read nothing; the object
    hardly changes."""
    g = ParallelBeam(np.arange(240) * math.pi / 240, 128, 1.0)
    bodies = [
        Ellipsoid((3.0, -4.0), (45.0, 55.0), value=0.02),
        Ellipsoid((20.0, 15.0), (9.0, 6.0), value=0.03),
        Ellipsoid((-18.0, -25.0), (7.0, 12.0), value=-0.015),
    ]
    p = line_integrals(g, bodies, sub=2)
    n = np.random.default_rng(0).poisson(3e4 * np.exp(-p)).astype(float)
    gain, zero = np.ones(n.shape), np.zeros(n.shape, bool)
    gain[30:150, 40], gain[100:220, 71:73], gain[:60, 76] = 0.93, 1.08, 0.94
    zero[50:90, 60] = zero[120:140, 84:86] = True
    scans = [Scan.from_counts(v, g, air=3e4) for v in (n, np.where(zero, 0.0, np.rint(n * gain)))]
    sound, striped = (cleaned(s).line_integrals().numpy() for s in scans)
    noise = float((scans[0].line_integrals().numpy() - p).std())
    assert float((sound - p).std()) < 1.02 * noise
    for views, columns in (
        (slice(35, 145), 40),
        (slice(105, 215), slice(71, 73)),
        (slice(0, 55), 76),
    ):
        assert abs(float((striped - sound)[views, columns].mean())) < 0.035  # 0.06 to 0.08
    assert np.abs((striped - sound)[zero]).max() < 0.5  # 9
    assert float((striped - p).std()) < 1.1 * noise
    assert cleaned(scans[1]).info["dead_readings"] == 80


def test_cleaned_keeps_the_scan_and_its_weights(tmp_path):
    """A cell that changed its gain, a stray gamma; a cell without signal is dead though its mean
    is not quite 0."""
    path = tooth(tmp_path / "tooth.h5")
    clean = open_scan(path, slices=slice(0, 2))
    with h5py.File(path, "a") as file:
        data, white = file["exchange/data"][:], file["exchange/data_white"][:]
        data[:, 0, 40] = np.rint(0.97 * data[:, 0, 40])
        data[50, 0, 20] = 65535
        data[:, 1, 33], white[:, 1, 33] = 103, 105  # dark: 100 … 104
        file["exchange/data"][:], file["exchange/data_white"][:] = data, white
    raw = open_scan(path, slices=slice(0, 2))
    assert raw.dead is not None
    assert bool(raw.dead[1, :, 33].all())
    found = cleaned(raw)
    wrong = [
        float((s.line_integrals()[0] - clean.line_integrals()[0])[:, [20, 40]].abs().max())
        for s in (raw, found)
    ]
    assert wrong[0] > 0.5
    assert wrong[1] < 0.1
    live = found.weights()[0][:, :30]
    torch.testing.assert_close(live, clean.weights()[0][:, :30], rtol=0.25, atol=0)
    with pytest.raises(ValueError, match="stripes are taken from sinograms"):
        cleaned(Scan.from_line_integrals(np.zeros(CONE.shape) + 0.1, CONE, photons=1e5))


@pytest.mark.parametrize("form", ["tif", "stack.tif", "npy"])
def test_stacks_with_a_description(tmp_path, form):
    lines = line_integrals(CONE, [Ellipsoid((2.0, -3.0), 15.0, value=MU)], sub=1)
    counts = (5e4 * np.exp(-lines)).astype(np.float32)
    (tmp_path / "p").mkdir()
    if form == "tif":
        for k, view in enumerate(counts):
            tifffile.imwrite(tmp_path / "p" / f"{k:03d}.tif", view)
        name = "p/*.tif"
    elif form == "stack.tif":
        tifffile.imwrite(tmp_path / "p" / "all.tif", counts)
        name = "p/all.tif"
    else:
        np.save(tmp_path / "p" / "all.npy", counts)
        name = "p/all.npy"
    np.save(tmp_path / "dead.npy", np.zeros((3, 64), np.uint8))
    text = {
        "readings": name,
        "kind": "counts",
        "air": 5e4,
        "dead": "dead.npy",
        "mu_water": MU,
        "geometry": geometry_values(CONE),
    }
    path = tmp_path / "scan.yaml"
    path.write_text(yaml.safe_dump(text), encoding="utf-8")
    scan = open_scan(path)
    np.testing.assert_allclose(scan.geometry.angles, CONE.angles, atol=1e-12)
    np.testing.assert_allclose(scan.line_integrals().numpy(), lines, atol=1e-4)
    path.write_text(yaml.safe_dump(text | {"gian": 3}), encoding="utf-8")
    with pytest.raises(ValueError, match="unknown in a scan of counts: gian"):
        open_scan(path)


@pytest.mark.parametrize(
    "geometry", [PARALLEL, FanBeam(full_turn(7), 50.0, 90.0, 9, 1.0, 0.2, "curved"), CONE]
)
def test_geometries_as_yaml(geometry, tmp_path):
    back = geometry_of(yaml.safe_load(yaml.safe_dump(geometry_values(geometry))))
    np.testing.assert_allclose(back.angles, geometry.angles, atol=1e-12)
    assert geometry_values(back).keys() == geometry_values(geometry).keys()
    (tmp_path / "a.txt").write_text(
        "\n".join(map(str, np.rad2deg(geometry.angles))), encoding="utf-8"
    )
    values = geometry_values(geometry) | {"angles_deg": "a.txt"}
    np.testing.assert_allclose(geometry_of(values, tmp_path).angles, geometry.angles, atol=1e-12)
    with pytest.raises(ValueError, match=r"unknown in a .* geometry: sdds"):
        geometry_of(values | {"sdds": 3}, tmp_path)
    with pytest.raises(ValueError, match="geometry needs columns"):
        geometry_of({"kind": "parallel", "angles_deg": [0, 1], "pitch": 1.0})


def test_catsim(tmp_path):
    lines = line_integrals(CONE, [Ellipsoid((2.0, -3.0), 15.0, value=MU)], sub=1)
    lines.astype("<f4").tofile(tmp_path / "a.prep")
    scan = open_scan(tmp_path / "a.prep", CONE, mu_water=MU, photons=1e5)
    np.testing.assert_allclose(scan.line_integrals().numpy(), lines, atol=1e-5)
    air, dark = np.full(CONE.shape[1:], 1e4), np.full(CONE.shape[1:], 50.0)
    for end, values in (
        ("scan", dark + (air - dark) * np.exp(-lines)),
        ("air", air),
        ("offset", dark),
    ):
        values.astype("<f4").tofile(tmp_path / f"b.{end}")
    scan = open_scan(tmp_path / "b.scan", CONE, mu_water=MU)
    np.testing.assert_allclose(scan.line_integrals().numpy(), lines, atol=2e-3)
    with pytest.raises(ValueError, match="do not hold the geometry"):
        open_scan(tmp_path / "a.prep")
    (tmp_path / "a.prep").write_bytes(b"1234")
    with pytest.raises(ValueError, match=r"a\.prep cannot be read.*it has 4 bytes"):
        open_scan(tmp_path / "a.prep", CONE)


def test_dicom_ct_pd(tmp_path):
    lines = line_integrals(CURVED, BODY, sub=1)
    folder = ct_pd(tmp_path / "axial", lines, CURVED)
    scan = open_scan(folder)
    np.testing.assert_allclose(scan.geometry.angles, CURVED.angles, atol=1e-6)
    assert (scan.geometry.sod, scan.geometry.detector) == (300.0, "curved")
    np.testing.assert_allclose(scan.geometry.offset, CURVED.offset, atol=1e-5)
    np.testing.assert_allclose(scan.line_integrals().numpy(), lines, atol=1e-4)
    inside = reconstruct(scan, VolumeGrid((1, 6, 6), 1.0, (0.0, -2.0, -6.0)), "fbp").data
    assert float(inside.mean().abs()) < 15
    sorted(folder.iterdir())[3].unlink()
    with pytest.raises(ValueError, match="instance numbers have gaps"):
        read_dicom_ct_pd(folder)


def test_dicom_ct_pd_with_a_modulated_tube_current(tmp_path):
    lines = line_integrals(CURVED, BODY, sub=1)
    flux = 1.0 + 0.5 * np.cos(2 * CURVED.angles)
    columns = 1e4 * (1.0 + np.arange(CURVED.columns) / CURVED.columns)
    photons = flux[:, None] * columns
    scan = open_scan(ct_pd(tmp_path / "modulated", lines, CURVED, photons=photons))
    np.testing.assert_allclose(scan.flux.numpy(), flux / flux.mean(), rtol=1e-5)
    expected = photons[:, None] * np.exp(-lines)
    np.testing.assert_allclose(scan.counts.numpy(), expected, rtol=1e-3)
    np.testing.assert_allclose(scan.line_integrals().numpy(), lines, atol=1e-4)
    steady = open_scan(ct_pd(tmp_path / "steady", lines, CURVED, photons=0 * photons + columns))
    assert steady.flux is None
    np.testing.assert_allclose(steady.air.numpy(), np.tile(columns, (CURVED.rows, 1)), rtol=1e-6)
    photons[3, 5] = 0.0  # no table
    few = open_scan(ct_pd(tmp_path / "few", lines, CURVED, photons=photons))
    assert few.flux is None
    assert few.info["photons"].startswith("estimated")


def test_helical_and_flying_spots_are_refused(tmp_path):
    part = CURVED.select(slice(0, 8))
    lines = line_integrals(part, BODY, sub=1)
    helix = read_dicom_ct_pd(ct_pd(tmp_path / "helix", lines, part, climb=0.5))
    np.testing.assert_allclose(helix.motion[:, 0], -0.5 * np.arange(8), atol=1e-5)
    with pytest.raises(ValueError, match=r"table travels by 3\.5 mm.*recon\.pwls"):
        helix.scan()
    flying = ct_pd(tmp_path / "ffs", lines, part, spot="FFSZ")
    with pytest.raises(ValueError, match="focal spot flies"):
        read_dicom_ct_pd(flying)
    assert read_dicom_ct_pd(flying, ignore_flying_spot=True).motion is None


BALLS = [
    Ellipsoid((0.5, 2.0, -3.0), (6.0, 14.0, 18.0), value=MU),
    Ellipsoid((1.0, 6.0, 5.0), 3.0, value=MU),
]


def _deflected(geometry, angle, height, radius):
    """Exact line integrals of BALLS from a deflected spot to a detector that stays."""
    g, lines = geometry, []
    for beta in g.angles:
        e_r, e_t = np.array(
            [[math.cos(beta), math.sin(beta), 0.0], [-math.sin(beta), math.cos(beta), 0.0]]
        )
        turned = np.array([math.cos(beta + angle), math.sin(beta + angle), 0.0])
        source = (g.sod + radius) * turned + [0.0, 0.0, height]
        cells = g.sod * e_r + g.sdd * np.stack(
            [np.cos(g.fan_angles), np.sin(g.fan_angles)], -1
        ) @ np.stack([-e_r, e_t])
        rays = cells + np.array([0.0, 0.0, 1.0]) * g.row_positions[:, None, None] - source
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        lines.append(sum(ball.along(source, rays) for ball in BALLS))
    return np.stack(lines)


@pytest.mark.parametrize("every", [False, True])
def test_every_second_view_of_a_flying_spot_is_a_scan_from_where_the_spot_was(tmp_path, every):
    """Chosen by option, or by copying every second file."""
    spots = [(0.002, 0.3, 0.0), (-0.002, -0.3, 0.5)]
    lines = np.empty(CURVED.shape)
    for k, spot in enumerate(spots):
        lines[k::2] = _deflected(CURVED.select(slice(k, None, 2)), *spot)
    folder = ct_pd(tmp_path / "ffs", lines, CURVED, spot="FFSXZ", shifts=spots)
    with pytest.raises(
        ValueError, match=r"focal spot flies \(FFSXZ\) between 2 positions: pass spot=0"
    ):
        open_scan(folder)
    for k, (angle, height, radius) in enumerate(spots):
        if every:
            (tmp_path / f"half{k}").mkdir()
            # names run against the instance numbers
            for path in sorted(folder.iterdir())[::-1][k::2]:
                shutil.copy(path, tmp_path / f"half{k}")
        scan = open_scan(tmp_path / f"half{k}") if every else open_scan(folder, spot=k)
        g = scan.geometry
        assert g.sod == pytest.approx(300.0 + radius, abs=1e-3)
        np.testing.assert_allclose(g.angles, CURVED.angles[k::2] + angle, atol=1e-5)
        assert g.offset[0] == pytest.approx(CURVED.offset[0] - height, abs=1e-5)
        # z from the spot
        seen = [replace(ball, center=(ball.center[0] - height, *ball.center[1:])) for ball in BALLS]
        np.testing.assert_allclose(
            scan.line_integrals().numpy(), line_integrals(g, seen, sub=1), atol=3e-3
        )
    with pytest.raises(
        ValueError, match="spot must be one of the 2 positions of the focal spot, got 2"
    ):
        open_scan(folder, spot=2)


def test_rtk_matrices(tmp_path):
    """Matrices made from the rays that our own vectors describe, at random homogeneous scales."""
    vectors = VectorGeometry.of(CONE).vectors.reshape(-1, 4, 3)[..., [1, 2, 0]]  # to RTK's axes
    parts = []
    for k, (source, centre, u, v) in enumerate(vectors):
        # A point x meets the detector at centre + s û + t v̂: three homogeneous rows.
        rays = np.stack([u / np.linalg.norm(u), v / np.linalg.norm(v), centre - source], 1)
        inverse = np.linalg.inv(rays) * (-1.0) ** k * (1.0 + k)
        matrix = np.concatenate([inverse, -(inverse @ source)[:, None]], 1)
        parts.append(
            f"<Projection><Matrix>{' '.join(map(str, matrix.ravel()))}</Matrix></Projection>"
        )
    path = tmp_path / "geometry.xml"
    distance = "<SourceToDetectorDistance>500</SourceToDetectorDistance>"
    path.write_text(
        f"<RTKThreeDCircularGeometry>{distance}{''.join(parts)}</RTKThreeDCircularGeometry>"
    )
    geometry = read_rtk(path, CONE.columns, CONE.rows, CONE.pitch)
    np.testing.assert_allclose(geometry.vectors, VectorGeometry.of(CONE).vectors, atol=1e-8)
    circular = geometry.as_circular()
    assert circular is not None
    np.testing.assert_allclose(circular[0].angles % (2 * math.pi), CONE.angles, atol=1e-9)


LAUGHS = "\n".join(
    ["a0: &a0 [x, x]", *(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12))]
)


@pytest.mark.parametrize(
    ("text", "expected_text"),
    [
        (LAUGHS, "stands for more than 1048576 values"),
        ("[" * 60 + "]" * 60, "nested more than 32 deep"),
        ("a: &a [1, *a]", r"alias \*a is undefined, or refers to a part that contains it"),
        ("a: " + "1:" * 40000 + "1", "more than 16384 characters"),
        ("# " + "x" * 2**24, "more than 16777216 characters"),
        ("a: [", "it is not YAML: .* in line 2"),
        ("a: !!python/object:os.system {}", "it is not YAML"),
        (b"a: \xff\xfe".decode("latin-1"), None),
    ],
)
def test_yaml_of_users_is_bounded(tmp_path, text, expected_text):
    """Twelve lines of aliases to aliases hung every reader, and a bad geometry ended in a
    traceback."""
    path = tmp_path / "a.yaml"
    path.write_bytes(text.encode("latin-1" if expected_text is None else "utf-8"))
    readers = [
        lambda: read_yaml(path, "a geometry"),
        lambda: open_scan(path),
        lambda: read_config(path),
    ]
    for read in readers:
        with pytest.raises(
            ValueError, match=f"a.yaml cannot be read as .*: .*{expected_text or 'codec'}"
        ):
            read()
    assert (
        main(
            ["reconstruct", str(tmp_path), "--geometry", str(path), "--out", str(tmp_path / "v.h5")]
        )
        == 2
    )


def test_yaml_with_anchors_is_read(tmp_path):
    (tmp_path / "a.yaml").write_text(
        "a: &a {b: [1, 2]}\nc: *a\nd: &e 3\nf: [*e, *e]\ng: {<<: *a, h: 4}", encoding="utf-8"
    )
    values = read_yaml(tmp_path / "a.yaml", "values")
    assert values == {
        "a": {"b": [1, 2]},
        "c": {"b": [1, 2]},
        "d": 3,
        "f": [3, 3],
        "g": {"b": [1, 2], "h": 4},
    }
