"""Files of beamlines: Data Exchange and NeXus, written by h5py alone."""

import warnings

import h5py
import numpy as np
import pytest
from foreign_files import data_exchange, nexus

from recon.cli import main
from torchpcct import ParallelBeam
from torchpcct.formats.scans import open_scan, own_options
from torchpcct.volume import Volume

GEOMETRY = ParallelBeam(np.arange(60) * np.pi / 60, 32, 0.5)


def frames(seed=0):
    """Projections, flats and darks of three rows of a disc, photons of two units each above a
    dark of 100."""
    rng = np.random.default_rng(seed)
    lines = (
        0.08
        * np.sqrt(np.clip(6.0**2 - GEOMETRY.column_positions**2, 0, None))
        * np.ones((60, 3, 1))
    )
    data, white = (
        2 * rng.poisson(n) + 100 for n in (1e4 * np.exp(-lines), np.full((6, 3, 32), 1e4))
    )
    return lines, data, white, np.full((3, 3, 32), 100) + rng.integers(0, 2, (3, 3, 32))


LINES, DATA, WHITE, DARK = frames()


@pytest.fixture
def exchange(tmp_path):
    return data_exchange(tmp_path / "a.h5", DATA, WHITE, GEOMETRY.angles, DARK, 500.0)


def rewritten(path, name, values=None, unit=None):
    with h5py.File(path, "a") as file:
        values = file[name][()] if values is None else values
        del file[name]
        file[name] = values
        if unit is not None:
            file[name].attrs["units"] = unit


def close(scan, rows=slice(None)):
    np.testing.assert_allclose(scan.geometry.angles, GEOMETRY.angles, atol=1e-6)
    off = scan.line_integrals().numpy() - np.moveaxis(LINES, 0, 1)[rows]
    assert abs(float(off.mean())) < 2e-3
    assert float(off.std()) < 0.03


@pytest.mark.parametrize(
    "unit", ["deg", "Degrees", "°", "rad", "radian", b"radians", np.array(["rad"], "S3")]
)
def test_angles_in_degrees_and_rad_by_their_unit(exchange, unit):
    text = str(np.ravel(unit)[0])
    rewritten(
        exchange,
        "exchange/theta",
        GEOMETRY.angles if "rad" in text else np.rad2deg(GEOMETRY.angles),
        unit,
    )
    close(open_scan(exchange))


@pytest.mark.parametrize(
    "unit", ["mdeg", "mrad", "turn", "gon", "grad", "arcmin", "encoder counts"]
)
def test_angles_in_another_unit_are_refused_by_name_and_may_be_given(exchange, unit):
    rewritten(exchange, "exchange/theta", unit=unit)
    with pytest.raises(
        ValueError, match=rf"are in '{unit}', which is neither deg nor rad: give angles_deg="
    ):
        open_scan(exchange)
    close(open_scan(exchange, angles_deg={"step": 3.0}))


def test_angles_without_a_unit(exchange):
    rewritten(exchange, "exchange/theta", np.rad2deg(GEOMETRY.angles))
    close(open_scan(exchange))  # degrees, the format's default
    for span, turns in (
        (GEOMETRY.angles, "1 half turn"),
        (np.linspace(0, 2 * np.pi, 60), "2 half turns"),
    ):
        rewritten(exchange, "exchange/theta", span)
        with pytest.warns(UserWarning, match=f"have no unit .* taken as rad, {turns}"):
            np.testing.assert_allclose(open_scan(exchange).geometry.angles, span)
    rewritten(exchange, "exchange/theta", 0.6 * GEOMETRY.angles)
    with pytest.raises(ValueError, match=r"have no unit and cover 1\.854: deg or rad"):
        open_scan(exchange)


def test_uint16_that_was_stored_as_int16(exchange):
    """Some readings, all air frames, no dark frame: beyond 32767."""
    with h5py.File(exchange, "a") as file:
        for name, values in (
            ("data", 2 * DATA),
            ("data_white", 2 * WHITE),
            ("data_dark", 2 * DARK),
        ):
            del file[f"exchange/{name}"]
            file[f"exchange/{name}"] = values.astype(np.uint16).view(np.int16)
    with pytest.warns(
        UserWarning, match=r"of type int16 reach down to -\d+: they are read as uint16"
    ):
        close(open_scan(exchange))


@pytest.mark.parametrize("name", ["data", "data_white"])
def test_readings_at_the_end_of_their_type(exchange, name):
    with h5py.File(exchange, "a") as file:
        held = {"data": DATA, "data_white": WHITE}[name].astype(np.uint16)
        few = held.copy()
        few.flat[: held.size // 300] = 65535  # hot cells are no saturation
        del file[f"exchange/{name}"]
        file[f"exchange/{name}"] = few
    open_scan(exchange)
    full = np.minimum(65535, held.astype(np.float64) * 65535.0 / np.quantile(held, 0.9))
    rewritten(exchange, f"exchange/{name}", full.astype(np.uint16))
    said = "air" if name == "data_white" else "readings"
    with pytest.warns(UserWarning, match=rf"% of {said} are 65535, the most that uint16 holds"):
        open_scan(exchange)


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (data_exchange, "measurement/instrument/detector/pixel_size"),
        (nexus, "entry/instrument/detector/x_pixel_size"),
    ],
)
def test_pixels_of_several_sizes_are_of_none(tmp_path, write, name):
    path = write(tmp_path / "a.h5", DATA, WHITE, GEOMETRY.angles, DARK, 500.0)
    for sizes, known in (([20.0, 20.0], True), ([20.0, np.nan], False), ([20.0, 40.0], False)):
        rewritten(path, name, np.array(sizes), "um")
        assert (open_scan(path).unit == "pixel^-1") is not known
    with pytest.raises(ValueError, match="the size of its pixels is unknown: give pitch=, too"):
        open_scan(path, mu_water=0.02)


def test_what_a_file_lacks_is_asked_for_and_given(exchange, tmp_path):
    with h5py.File(exchange, "a") as file:
        del file["exchange/theta"], file["exchange/data_white"], file["exchange/data_dark"]
    with pytest.raises(ValueError, match="it has no angles, /exchange/theta: give angles_deg="):
        open_scan(exchange)
    with pytest.raises(
        ValueError, match=r"it has no white frames, /exchange/data_white: .* give air="
    ):
        open_scan(exchange, angles_deg={"step": 3.0})
    (tmp_path / "angles.txt").write_text(
        "\n".join(str(3.0 * k) for k in range(60)), encoding="utf-8"
    )
    np.save(tmp_path / "white.npy", WHITE)
    for angles, air in (
        ({"step": 3.0}, 2e4 + 100),
        (np.rad2deg(GEOMETRY.angles), WHITE),
        (str(tmp_path / "angles.txt"), str(tmp_path / "white.npy")),
    ):
        close(open_scan(exchange, angles_deg=angles, air=air, dark=100.0))
        close(
            open_scan(exchange, angles_deg=angles, air=air, dark=100.0, slices=slice(1, 3)),
            slice(1, 3),
        )
    with pytest.raises(ValueError, match="angles_deg must be 60 angles, one a view"):
        open_scan(exchange, angles_deg=[0.0, 1.0], air=2e4)
    out = tmp_path / "v.h5"
    command = [
        "reconstruct",
        str(exchange),
        "--out",
        str(out),
        "--air",
        str(tmp_path / "white.npy"),
        "--dark",
        "100",
        "--no-progress",
    ]
    assert main([*command, "--angles-deg", "0:3"]) == 0
    first = Volume.load(out).data
    assert main([*command, "--angles-deg", str(tmp_path / "angles.txt")]) == 0
    np.testing.assert_array_equal(Volume.load(out).data, first)


@pytest.mark.parametrize("white", [20100, np.full((1,), 20100), np.full((3, 32), 20100)])
def test_a_constant_flat(exchange, white):
    rewritten(exchange, "exchange/data_white", white)
    close(open_scan(exchange))


def test_nexus(tmp_path):
    path = nexus(tmp_path / "a.nxs", DATA, WHITE, GEOMETRY.angles, DARK, 500.0)
    scan = open_scan(path, mu_water=0.02)
    close(scan)
    assert (scan.geometry.pitch, scan.info["format"], scan.unit) == (0.5, "NeXus", "HU")
    assert scan.info["signal_of_one_photon"] == pytest.approx(2.0, rel=0.15)
    close(open_scan(path, slices=slice(0, 2)), slice(0, 2))
    assert "slices" in own_options(path)
    close(open_scan(nexus(tmp_path / "b.h5", DATA, WHITE, GEOMETRY.angles, DARK, unit="rad")))
    longer = nexus(
        tmp_path / "c.h5", DATA, (WHITE - 100) / 2 + 100, GEOMETRY.angles, DARK, times=(0.2, 0.1)
    )
    close(open_scan(longer))


def test_nexus_that_is_no_scan_or_several(tmp_path):
    path = nexus(tmp_path / "a.nxs", DATA, WHITE, GEOMETRY.angles, DARK)
    with h5py.File(path, "a") as file:
        file.copy(file["entry"], "entry2")
    with pytest.raises(ValueError, match="it holds 2 scans: give entry=, one of entry, entry2"):
        open_scan(path)
    assert open_scan(path, entry="entry2").unit == "pixel^-1"
    with h5py.File(path, "a") as file:
        del file["entry2"]
        key = file["entry/instrument/detector/image_key"]
        key[key[()] == 1] = 3
    with pytest.raises(ValueError, match=r"names no flat fields \(1\): give air="):
        open_scan(path)
    close(open_scan(path, air=2e4 + 100))
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["table"] = np.zeros(3)
    with pytest.raises(
        ValueError, match=r"b\.h5 is no scan of a known format: neither of torchpcct, nor Data"
    ):
        open_scan(tmp_path / "b.h5")


@pytest.mark.parametrize("wrong", [7, 0.7, np.nan, -1, b"projection"])
def test_image_keys_that_nexus_does_not_know_are_refused(tmp_path, wrong):
    path = nexus(tmp_path / "a.nxs", DATA, WHITE, GEOMETRY.angles, DARK, 500.0)
    name = "entry/instrument/detector/image_key"
    with h5py.File(path) as file:
        key = file[name][()]
    key = key.astype("S10" if isinstance(wrong, bytes) else float)
    key[20] = wrong
    rewritten(path, name, key)
    first = 0 if isinstance(wrong, bytes) else 20
    with pytest.raises(ValueError, match=rf"image_key holds .*, of frame {first}: NXtomo knows 0"):
        open_scan(path)


DECAY = np.linspace(1.05, 0.85, 60)
"""Of the beam during the projections, relative to the flats."""


def decayed(path, monitor, **more):
    """The scan of :data:`DATA` in a beam that loses a fifth meanwhile, as a monitor saw it."""
    data = np.rint((DATA - 100) * DECAY[:, None, None]) + 100
    nexus(path, data, WHITE, GEOMETRY.angles, DARK, 500.0, **more)
    with h5py.File(path, "a") as file:
        key = file["entry/instrument/detector/image_key"][()]
        read = np.full(key.size, 200.0)
        read[key == 2] = 0.0  # dark: the beam is shut off
        read[key == 0] *= DECAY
        file["entry/control/data"] = monitor(read)
    return path


def test_what_a_monitor_of_the_beam_has_read_is_the_flux(tmp_path):
    scan = open_scan(decayed(tmp_path / "a.nxs", lambda read: read))
    np.testing.assert_allclose(scan.flux.numpy(), DECAY, rtol=1e-6)
    close(scan)
    close(open_scan(tmp_path / "a.nxs", slices=slice(1, 3)), slice(1, 3))
    given = open_scan(tmp_path / "a.nxs", flux=2 * DECAY)
    np.testing.assert_allclose(given.flux.numpy(), 2 * DECAY, rtol=1e-6)
    for k, none in enumerate((lambda read: 0 * read, lambda read: read[:5])):
        assert open_scan(decayed(tmp_path / f"{k}.nxs", none)).flux is None


def test_a_monitor_in_another_file_is_left_out(tmp_path):
    path = nexus(tmp_path / "a.nxs", DATA, WHITE, GEOMETRY.angles, DARK, 500.0)
    with h5py.File(path, "a") as file:
        file["entry/control/data"] = h5py.ExternalLink("b.nxs", "/data")
    with pytest.warns(UserWarning, match="is a link to another file, b.nxs.*: it is left out"):
        close(open_scan(path))


def test_the_current_of_a_ring_is_no_sum_over_an_exposure(tmp_path):
    path = decayed(tmp_path / "a.nxs", lambda read: read, times=(0.4, 0.2))
    with h5py.File(path, "a") as file:
        file["entry/control/data"].attrs["units"] = "mA"
    np.testing.assert_allclose(open_scan(path).flux.numpy(), DECAY, rtol=1e-6)


@pytest.mark.parametrize(
    ("monitor", "times", "said"),
    [
        (lambda read: np.where(np.arange(read.size) == 20, 3.0, read), None, "changes from 3 to"),
        (lambda read: np.where(np.arange(read.size) == 20, np.nan, read), None, "changes from nan"),
        (lambda read: read, (0.4, 0.2), "may hold sums over exposures, which differ, give"),
    ],
)
def test_a_monitor_that_cannot_be_the_flux_is_left_out(tmp_path, monitor, times, said):
    path = decayed(tmp_path / "a.nxs", monitor, times=times)
    with pytest.warns(
        UserWarning, match=rf"control/data \(the beam's monitor\) {said}.*flux= for it: it is left"
    ):
        assert open_scan(path).flux is None


@pytest.mark.parametrize(("moved_um", "said"), [(0.0, False), (100.0, False), (900.0, True)])
def test_an_object_that_was_moved_during_a_nexus_scan(tmp_path, moved_um, said):
    path = nexus(tmp_path / "a.nxs", DATA, WHITE, GEOMETRY.angles, DARK, 500.0)
    with h5py.File(path, "a") as file:
        key = file["entry/instrument/detector/image_key"][()]
        at = np.full(key.size, 9000.0)  # beside the beam, of flats
        at[key == 0] = np.linspace(0.0, moved_um, 60)
        file["entry/sample/z_translation"] = at
        file["entry/sample/z_translation"].attrs["units"] = "um"
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        close(open_scan(path))
    moved = "z_translation changes by 0.9 mm during the projections: the object was moved"
    assert any(moved in str(w.message) for w in found) is said


def test_images_of_alignment_of_a_nexus_file_are_no_views(tmp_path):
    # taken after the scan, as if the object had moved by then
    data = np.concatenate([DATA, np.roll(DATA[:3], 9, -1)])
    angles = np.concatenate([GEOMETRY.angles, [np.pi, np.pi / 2, 0.0]])
    path = nexus(tmp_path / "a.nxs", data, WHITE, angles, DARK, 500.0)
    with h5py.File(path, "a") as file:
        detector = file["entry/instrument/detector"]
        control = detector["image_key"][()].astype(int)
        control[np.flatnonzero(control == 0)[-3:]] = -1
        detector["image_key_control"] = control
    close(open_scan(path))


def test_a_group_in_the_place_of_nexus_frames(tmp_path):
    path = nexus(tmp_path / "a.nxs", DATA, WHITE, GEOMETRY.angles, DARK, 500.0)
    with h5py.File(path, "a") as file:
        del file["entry/instrument/detector/data"], file["entry/data"]
        file.create_group("entry/instrument/detector/data")
    with pytest.raises(ValueError, match="it has no detector with data and image_key"):
        open_scan(path)


@pytest.mark.parametrize("form", ["exchange", "nexus"])
@pytest.mark.parametrize(
    "kind", ["external link", "soft link out", "external storage", "virtual", "empty"]
)
def test_numbers_that_lie_in_other_files_are_refused_by_name(tmp_path, form, kind):
    if form == "exchange":
        path, name = (
            data_exchange(tmp_path / "a.h5", DATA, WHITE, GEOMETRY.angles, DARK),
            "exchange/data",
        )
    else:
        path = nexus(tmp_path / "a.nxs", DATA, WHITE, GEOMETRY.angles, DARK)
        name = "entry/instrument/detector/data"
    with h5py.File(path, "a") as file:
        data = file[name][()]
        (tmp_path / "other.raw").write_bytes(data.tobytes())
        with h5py.File(tmp_path / "other.h5", "w") as other:
            other["data"] = data
        del file[name]
        if kind == "external link":
            file[name] = h5py.ExternalLink("other.h5", "/data")
        elif kind == "soft link out":
            file["elsewhere"] = h5py.ExternalLink("other.h5", "/")
            file[name] = h5py.SoftLink("/elsewhere/data")
        elif kind == "external storage":
            file.create_dataset(
                name, data.shape, data.dtype, external=[("other.raw", 0, data.nbytes)]
            )
        elif kind == "virtual":
            layout = h5py.VirtualLayout(data.shape, data.dtype)
            layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "data", data.shape)
            file.create_virtual_dataset(name, layout)
        else:  # 2 GiB of nothing
            file.create_dataset(name, (len(data), 2**10, 2**14), "u2", chunks=(1, 2**10, 2**10))
    expected = (
        "is compressed to 0 MiB"
        if kind == "empty"
        else r"other\.(h5|raw).*copy all into one file first"
    )
    with pytest.raises(ValueError, match=rf"a\.\w+ cannot be read as .*: .*{expected}"):
        open_scan(path)


def test_soft_links_within_a_file_are_followed_and_circles_refused(exchange):
    with h5py.File(exchange, "a") as file:
        file.move("exchange/data", "raw")
        file["exchange/data"] = h5py.SoftLink("../raw")
        file["there"] = h5py.SoftLink("/raw")
    with pytest.raises(ValueError, match=r"leads to \.\./raw, which is not there"):
        open_scan(exchange)
    with h5py.File(exchange, "a") as file:
        del file["exchange/data"]
        file["exchange/data"] = h5py.SoftLink("/there")
    close(open_scan(exchange))
    with h5py.File(exchange, "a") as file:
        del file["there"]
        file["there"] = h5py.SoftLink("/exchange/data")
    with pytest.raises(ValueError, match="leads in a circle"):
        open_scan(exchange)
