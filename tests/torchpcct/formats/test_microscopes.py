"""Scans of laboratory machines (Nikon, Zeiss) and MATLAB arrays, written as their descriptions
say."""

import math

import h5py
import numpy as np
import pytest
from analytic import Ellipsoid, line_integrals
from foreign_files import txrm, xtekct
from scipy.io import savemat

from recon import reconstruct
from torchpcct import ConeBeam, ParallelBeam, VolumeGrid, full_turn
from torchpcct.formats.scans import open_scan
from torchpcct.vector_geometry import VectorGeometry

MU = 0.02
BODY = [
    Ellipsoid((2.0, -3.0, 0.5), (9.0, 12.0, 30.0), value=MU),
    Ellipsoid((7.0, 4.0, 0.0), (3.0, 3.0, 2.0), value=MU),
]
NIKON = ConeBeam(full_turn(24, math.radians(120.0)), 300.0, 500.0, 48, 4, (1.5, 1.7), (0.0, 0.8))
ZEISS = ConeBeam(-full_turn(24) - math.pi / 2, 300.0, 500.0, 48, 4, 1.7)
WHITE = 60000.0


def same(scan, geometry, lines, rows=slice(None)):
    assert scan.geometry.shape[1:] == lines[:, rows].shape[1:]
    np.testing.assert_allclose(
        np.exp(1j * scan.geometry.angles), np.exp(1j * geometry.angles), atol=1e-5
    )
    np.testing.assert_allclose(scan.line_integrals().numpy(), lines[:, rows], atol=2e-3)


def test_nikon(tmp_path):
    lines = line_integrals(NIKON, BODY, sub=1)
    path = xtekct(tmp_path / "part", WHITE * np.exp(-lines), NIKON, WHITE)
    scan = open_scan(path, mu_water=MU)
    same(scan, NIKON, lines)
    g = scan.geometry
    assert (g.sod, g.sdd, g.pitch, g.offset) == (
        300.0,
        500.0,
        (1.5, 1.7),
        pytest.approx((0.0, 0.8)),
    )
    inside = reconstruct(scan, VolumeGrid((1, 4, 4), 1.0, (0.0, 0.0, -3.0)), "fbp").data
    assert float(inside.mean().abs()) < 40
    same(open_scan(path, slices=slice(1, 3)), NIKON, lines, slice(1, 3))
    assert open_scan(path, slices=slice(1, 3)).geometry == open_scan(path).geometry.with_rows(1, 2)
    (tmp_path / "part" / "part_0024.tif").unlink()
    with pytest.raises(
        ValueError, match=r"part\.xtekct cannot be read as .*: it says 24 Projections, 23 images"
    ):
        open_scan(path)


def test_nikon_with_another_axis_and_without_a_value(tmp_path):
    lines = line_integrals(NIKON, BODY, sub=1)
    path = xtekct(tmp_path / "part", WHITE * np.exp(-lines), NIKON, WHITE, ObjectOffsetX=0.48)
    assert open_scan(path).geometry.offset == pytest.approx((0.0, 0.8))
    text = path.read_text(encoding="utf-8-sig")
    path.write_text(text.replace("ObjectOffsetX=0.48", "ObjectTilt=0.7"), encoding="utf-8")
    with pytest.warns(UserWarning, match=r"rotation axis is inclined \(ObjectTilt 0\.7°\)"):
        open_scan(path)
    path.write_text(text.replace("Projections", "DetectorOffsetY=2\nProjections"), encoding="utf-8")
    with pytest.warns(UserWarning, match=r"DetectorOffsetY 2 mm is left out, as programs differ"):
        open_scan(path)
    path.write_text(text.replace("SrcToObject=300.0", "SrcToObject="), encoding="utf-8")
    with pytest.raises(ValueError, match="it has no SrcToObject"):
        open_scan(path)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("Projections", 24.5, r"Projections must be a whole number, got '24\.5'"),
        ("DetectorPixelsX", 48.5, r"DetectorPixelsX must be a whole number, got '48\.5'"),
        ("AngularStep", 0, "AngularStep is 0 and there are 24 Projections: the object has not"),
    ],
)
def test_nikon_with_a_number_that_cannot_be(tmp_path, name, value, said):
    readings = np.full(NIKON.shape, 0.5 * WHITE)
    path = xtekct(tmp_path / "part", readings, NIKON, WHITE, **{name: value})
    with pytest.raises(ValueError, match=said):
        open_scan(path)


def test_nikon_images_that_do_not_count_on(tmp_path):
    readings = np.full(NIKON.shape, 0.5 * WHITE)
    path = xtekct(tmp_path / "part", readings, NIKON, WHITE)
    (path.parent / "part_0005.tif").rename(path.parent / "part_0025.tif")
    with pytest.raises(ValueError, match=r"evenly: part_0006\.tif follows part_0004\.tif; a view"):
        open_scan(path)
    (path.parent / "part_0025.tif").rename(path.parent / "part_0005.tif")
    for k in range(24, 0, -1):  # every second view of a longer scan
        (path.parent / f"part_{k:04d}.tif").rename(path.parent / f"part_{2 * k:04d}.tif")
    assert open_scan(path).geometry.views == 24


LISTED = {
    "part.ang": "Proj\tAngle(deg)\r\n" + "{0:d}:\t{1:.4f}\r\n",
    "_ctdata.txt": "Projs Frames Exposure\r\n24 1 500\r\nProj Angle Time\r\n"
    + "{0:d} {1:.4f} {2:.2f}\r\n",
}
"""Lists of angles beside a scan: head, and a line that is written for every view."""


@pytest.mark.parametrize("name", LISTED)
def test_nikon_with_a_list_of_angles(tmp_path, name):
    path = xtekct(tmp_path / "part", np.full(NIKON.shape, 0.5 * WHITE), NIKON, WHITE)
    head, line = LISTED[name][: LISTED[name].index("{")], LISTED[name][LISTED[name].index("{") :]
    even = 15.0 * np.arange(24)

    def written(degrees):
        lines = [line.format(k + 1, d, 0.5 * k) for k, d in enumerate(degrees)]
        (path.parent / name).write_text(head + "".join(lines), encoding="utf-8")

    rng = np.random.default_rng(0)
    for sound in (even, -even, 90.0 - even, even % 360.0 - 180.0, even + rng.normal(0, 0.2, 24)):
        written(sound)
        assert open_scan(path).geometry == open_scan(path, gain=1.0).geometry
    written(np.where(np.arange(24) > 9, even + 30.0, even))  # two views were left out
    with pytest.warns(UserWarning, match=rf"{name} lists angles that do not go on by AngularStep"):
        assert open_scan(path).geometry.views == 24
    given = open_scan(path, angles_deg=(even + 30.0).tolist()).geometry
    np.testing.assert_allclose(given.angles, NIKON.angles, atol=1e-12)
    written(even[:20])
    with pytest.raises(ValueError, match=rf"{name} lists 20 angles of 24 Projections"):
        open_scan(path)


def test_nikon_in_an_encoding_of_windows(tmp_path):
    readings = np.full(NIKON.shape, 0.5 * WHITE)
    path = xtekct(tmp_path / "part", readings, NIKON, WHITE)
    text = path.read_text(encoding="utf-8-sig") + "Operator=M\u00fcller\n"
    path.write_bytes(text.encode("cp1252"))
    assert open_scan(path).geometry.views == 24


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_zeiss_with_shifts_that_are_no_numbers(tmp_path, wrong):
    readings = np.full(ZEISS.shape, 0.5 * WHITE)
    shifts = {"x": np.where(np.arange(24) == 3, wrong, 2.0)}
    path = txrm(tmp_path / "a.txrm", readings, ZEISS, np.full((4, 48), WHITE), shifts)
    with pytest.raises(ValueError, match=r"x-shifts of image 4 is (nan|inf), no shift: export"):
        open_scan(path)


def test_zeiss(tmp_path):
    lines = line_integrals(ZEISS, BODY, sub=1)
    path = txrm(tmp_path / "a.txrm", WHITE * np.exp(-lines), ZEISS, np.full((4, 48), WHITE))
    scan = open_scan(path, mu_water=MU)
    same(scan, ZEISS, lines)
    assert (scan.geometry.sod, scan.geometry.sdd) == (300.0, 500.0)
    np.testing.assert_allclose(scan.geometry.pitch, 1.7, rtol=1e-6)
    same(open_scan(path, slices=slice(1, 3)), ZEISS, lines, slice(1, 3))
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"a\.txrm cannot be read as a Zeiss scan"):
        open_scan(path)


def test_zeiss_at_one_distance(tmp_path):
    readings, air = np.full(ZEISS.shape, 0.5 * WHITE), np.full((4, 48), WHITE)
    stopped = np.where(np.arange(24) < 20, -300.0, 0.0).astype("<f4")
    path = txrm(tmp_path / "a.txrm", readings, ZEISS, air, StoRADistance=stopped)
    assert open_scan(path).geometry.sod == 300.0
    moved = np.where(np.arange(24) < 12, -300.0, -310.0).astype("<f4")
    path = txrm(tmp_path / "b.txrm", readings, ZEISS, air, StoRADistance=moved)
    with pytest.raises(ValueError, match="is 300 mm of image 1 and 310 mm of image 13: the axis"):
        open_scan(path)


def test_zeiss_with_exposures_that_differ(tmp_path):
    readings, air = np.full(ZEISS.shape, 0.5 * WHITE), np.full((4, 48), WHITE)
    for k, times in enumerate(
        (np.full(24, 2.0), np.full(1, 2.0), np.r_[np.full(20, 2.0), 4 * [0]])
    ):
        path = txrm(tmp_path / f"{k}.txrm", readings, ZEISS, air, ExpTimes=times.astype("<f4"))
        assert open_scan(path).geometry.views == 24
    times = np.where(np.arange(24) < 6, 4.0, 2.0).astype("<f4")
    path = txrm(tmp_path / "a.txrm", readings, ZEISS, air, ExpTimes=times)
    with pytest.warns(UserWarning, match="exposures of its images reach from 2 to 4 s, and are"):
        open_scan(path)
    given = open_scan(path, flux=times / 2).line_integrals()
    np.testing.assert_allclose(given[0] - given[-1], np.log(2.0), atol=1e-4)


def test_zeiss_with_images_that_were_shifted_and_without_a_reference(tmp_path):
    lines, shifts = (
        line_integrals(ZEISS, BODY, sub=1),
        {"x": np.arange(24) % 3 - 1.0, "y": np.zeros(24)},
    )
    path = txrm(tmp_path / "a.txrm", WHITE * np.exp(-lines), ZEISS, np.full((4, 48), WHITE), shifts)
    expected = VectorGeometry.of(ZEISS).shifted(columns=shifts["x"])
    np.testing.assert_allclose(open_scan(path).geometry.vectors, expected.vectors, atol=1e-3)
    renamed = path.read_bytes().replace(
        "ReferenceData".encode("utf-16-le"), "ReferencyData".encode("utf-16-le")
    )
    path.write_bytes(renamed)
    with pytest.raises(ValueError, match="it has no reference image: give air="):
        open_scan(path)
    np.testing.assert_allclose(
        open_scan(path, air=WHITE).line_integrals().numpy(), lines, atol=2e-3
    )


PARALLEL = ParallelBeam(np.arange(30) * math.pi / 30, 64, 1.0)
SINOGRAM = line_integrals(PARALLEL, [Ellipsoid((2.0, -3.0), (14.0, 18.0), value=MU)], sub=1)


def mat73(path, **arrays):
    """A file of version 7.3: HDF5 behind 512 bytes, axes the other way."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in arrays.items():
            file[name] = values.T
    return path


@pytest.mark.parametrize("new", [False, True])
@pytest.mark.parametrize("turned", [False, True])
def test_matlab_sinograms(tmp_path, new, turned):
    sinogram = SINOGRAM.T if turned else SINOGRAM
    arrays = {
        "sinogram": sinogram,
        "angles": np.arange(30.0)[None],
        "name": np.array([65, 66])[None],
    }
    path = mat73(tmp_path / "s.mat", **arrays) if new else tmp_path / "s.mat"
    if not new:
        savemat(path, {**arrays, "note": "text"}, do_compression=True)
    for options in ({}, {"variable": "sinogram"}):
        scan = open_scan(path, PARALLEL, photons=1e6, mu_water=MU, **options)
        np.testing.assert_allclose(scan.line_integrals().numpy(), SINOGRAM, atol=1e-5)
    with pytest.raises(
        ValueError, match=r"s\.mat, a MATLAB array: such files do not hold the geometry"
    ):
        open_scan(path)
    with pytest.raises(ValueError, match=r"unknown variable 'm': use one of .*sinogram"):
        open_scan(path, PARALLEL, variable="m")
    with pytest.raises(ValueError, match=r"its array of .* is not the geometry's \(30, 63\)"):
        open_scan(path, ParallelBeam(PARALLEL.angles, 63, 1.0))


def test_matlab_readings_stacks_and_arrays_that_leave_it_open(tmp_path):
    # (views, columns, slices)
    counts = np.rint(1e4 * np.exp(-np.stack([SINOGRAM, 0.5 * SINOGRAM], -1)))
    savemat(tmp_path / "n.mat", {"n": counts, "other": counts[..., 0]})
    with pytest.raises(
        ValueError, match=r"it holds 2 arrays: give variable=, .*n \(30, 64, 2\), other \(30, 64\)"
    ):
        open_scan(tmp_path / "n.mat", PARALLEL)
    scan = open_scan(tmp_path / "n.mat", PARALLEL, variable="n", air=1e4)
    np.testing.assert_allclose(scan.line_integrals()[0].numpy(), SINOGRAM, atol=0.02)
    square = ParallelBeam(PARALLEL.angles, 30, 1.0)
    savemat(tmp_path / "s.mat", {"s": SINOGRAM[:, :30]})
    with pytest.warns(
        UserWarning,
        match=r"fits the geometry \(30, 30\) in several ways .*: it is taken as it stands",
    ):
        open_scan(tmp_path / "s.mat", square)
    savemat(tmp_path / "c.mat", {"s": SINOGRAM * 1j})
    with pytest.raises(
        ValueError, match=r"c\.mat cannot be read as a MATLAB file: its variable holds complex128"
    ):
        open_scan(tmp_path / "c.mat", PARALLEL)


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"s": SINOGRAM > 0.1}, "it holds no array of numbers of its own: structures, cells"),
        ({"s": {"sinogram": SINOGRAM}}, "it holds no array of numbers of its own: structures"),
        ({"s": SINOGRAM.ravel()}, r"only s \(1, 1920\): save the readings with an axis of views"),
    ],
)
def test_matlab_files_without_an_array_say_what_to_save(tmp_path, arrays, said):
    savemat(tmp_path / "s.mat", arrays)
    with pytest.raises(ValueError, match=said):
        open_scan(tmp_path / "s.mat", PARALLEL)
