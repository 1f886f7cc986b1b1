"""Which files a pattern means, and in which order they are read."""

import unicodedata
import warnings
from pathlib import Path

import numpy as np
import pytest
import tifffile
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from torchpcct import ParallelBeam
from torchpcct.formats.file_names import gap_in_numbers, in_number_order, matching
from torchpcct.formats.geometry_yaml import geometry_of, geometry_values
from torchpcct.formats.scans import open_scan

GEOMETRY = ParallelBeam(np.arange(12) * np.pi / 12, 16, 1.0)
READINGS = (1000 + np.arange(12 * 16)).reshape(12, 1, 16).astype(np.uint16)


def ordered(folder, names):
    return [path.name for path in in_number_order([folder / name for name in sorted(names)])]


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(["p_{}.tif", "{}.tif", "scan2_run10_{}.TIFF", "v1.2.3-{}_b.npy", "a({}).tif"]),
    st.integers(0, 99),
    st.integers(1, 40),
    st.integers(2, 130),
)
def test_numbers_that_count_up_in_equal_steps_decide_without_a_word(
    tmp_path_factory, form, first, step, count
):
    folder = tmp_path_factory.getbasetemp()
    names = [form.format(first + step * k) for k in range(count)]
    assert ordered(folder, names) == names


@pytest.mark.parametrize(
    "names",
    [
        [f"p{k:04d}.tif" for k in (3, 4, 9, 11)],
        [f"run{r}_{k}.tif" for r in (8, 9, 10) for k in range(12)],
        [f"angle_{v}.tif" for v in (-10, -5, 0, 5, 10)],
        [f"angle_{v}.tif" for v in ("0", "0.25", "0.5", "0.75", "1", "1.25")],
        [f"1.{k}.tif" for k in range(8, 12)],
        [f"slice-{k}.tif" for k in range(12)],
    ],
)
def test_orders_that_are_clear_are_taken_without_a_word(tmp_path, names):
    assert ordered(tmp_path, names) == names


@pytest.mark.parametrize(
    "names",
    [
        ["p_1.tif", "p_2.tif", "p_10.tif", "p_50.tif"],
        ["scan2_run10_003.tif", "scan2_run11_001.tif", "scan11_run3_002.tif"],
        ["p_0.3.tif", "p_2.5.tif", "p_10.1.tif"],
    ],
)
def test_where_text_and_numbers_differ_and_nothing_decides_the_order_is_said(tmp_path, names):
    with pytest.warns(
        UserWarning,
        match=rf"do not determine their order: they are read as {names[0]}.* \(by the numbers\)",
    ):
        assert ordered(tmp_path, names) == names


def stack(folder, readings, names, geometry=None, form="tif"):
    folder.mkdir(parents=True, exist_ok=True)
    for name, values in zip(names, READINGS, strict=True):
        tifffile.imwrite(folder / name, values)
    text = {
        "readings": readings,
        "kind": "counts",
        "air": 3000,
        "geometry": geometry or geometry_values(GEOMETRY),
    }
    (folder / "scan.yaml").write_text(yaml.safe_dump(text), encoding="utf-8")
    return open_scan(folder / "scan.yaml").counts.numpy()[0]


def test_stacks_are_read_in_number_order_or_in_that_of_a_list(tmp_path):
    names = [f"p_{k}.tif" for k in range(12)]
    np.testing.assert_array_equal(stack(tmp_path / "a", "p_*.tif", names), READINGS[:, 0])
    np.testing.assert_array_equal(stack(tmp_path / "b", names[::-1], names), READINGS[::-1, 0])


@pytest.mark.parametrize("pattern", ["*.tif", "p*.tiff", "*.TIF", "*.TIFF", "*.tif*", "p??.ti?"])
@pytest.mark.parametrize("ending", [".tif", ".TIF", ".Tif", ".tiff", ".TIFF"])
def test_patterns_find_all_endings_of_a_format_and_leave_hidden_files(tmp_path, pattern, ending):
    names = [f"p{k:02d}{ending}" for k in range(12)]
    (tmp_path / "._p00.tif").write_bytes(b"\0\5\26\7")
    if pattern == "p??.ti?" and len(ending) == 5:
        with pytest.raises(FileNotFoundError, match="no file matches"):
            stack(tmp_path, pattern, names)
    else:
        np.testing.assert_array_equal(stack(tmp_path, pattern, names), READINGS[:, 0])


def test_a_pattern_means_its_own_ending_and_one_image_twice_is_refused(tmp_path):
    names = [f"p{k:02d}{('.tif', '.TIF', '.Tif')[k % 3]}" for k in range(12)]
    np.testing.assert_array_equal(stack(tmp_path, "p*.tiff", names), READINGS[:, 0])
    # A copy with another ending of the format is not meant, nor are files of other formats.
    (tmp_path / "p00.tiff").write_bytes((tmp_path / "p00.tif").read_bytes())
    (tmp_path / "p00.txt").touch()
    assert [p.name for p in matching("p*.tif", tmp_path)] == names
    assert [p.name for p in matching("p*.tiff", tmp_path)] == ["p00.tiff"]
    with pytest.raises(
        ValueError, match=r"p00\.tif and p00\.tiff both match p\*\.tif\*, one image"
    ):
        matching("p*.tif*", tmp_path)
    (tmp_path / "p00.TIF").write_bytes((tmp_path / "p00.tif").read_bytes())
    with pytest.raises(
        ValueError,
        match=r"p00\.TIF and p00\.tif both match p\*\.tif, one image .* as p\*\.ti\[f\],",
    ):
        matching("p*.tif", tmp_path)
    assert [p.name for p in matching("p*.ti[f]", tmp_path)] == [n for n in names if ".tif" in n]


def test_a_pattern_may_be_absolute_and_its_folder_may_hold_brackets(tmp_path):
    names = [f"p{k:02d}.tif" for k in range(12)]
    found = (
        stack(tmp_path / "scan [1]", str(tmp_path / "plain" / "p*.tif"), names)
        if (stack(tmp_path / "plain", "p*.tif", names) is not None)
        else None
    )
    np.testing.assert_array_equal(found, READINGS[:, 0])
    assert [path.name for path in matching("p*.tif", tmp_path / "scan [1]")] == names
    tifffile.imwrite(tmp_path / "v[0].tif", READINGS)
    assert matching("v[0].tif", tmp_path) == [tmp_path / "v[0].tif"]
    with pytest.raises(FileNotFoundError, match=r"no file matches .*q\*\.tif"):
        matching("q*.tif", tmp_path)
    # Also where the folder stands in the pattern; the one of that very name goes before others.
    for folder in ("run [1]", "run 1", "a\nb", "ünï"):
        found = stack(tmp_path / "at" / folder, "p*.tif", names)
        np.testing.assert_array_equal(found, READINGS[:, 0])
    at = tmp_path / "at"
    for pattern in ("run [1]/p*.tif", f"{at}/run [1]/p*.tif", "run 1/../run [1]/p0*.tif"):
        assert {path.parent.resolve() for path in matching(pattern, at)} == {at / "run [1]"}
    assert [p.parent.name for p in matching("run [0-9]/p00.tif", at)] == ["run 1"]
    assert [p.name for p in matching("a\nb/*.tif", at)] == names
    # Two encodings of one umlaut, of Macs and of others.
    for form in ("NFC", "NFD"):
        pattern = unicodedata.normalize(form, "ünï/p*.tif")
        assert [p.name for p in matching(pattern, at)] == names
        assert matching(pattern.replace("*", "00"), at)[0].exists()


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("p_{000..023}.tif", r"no such file: .*: patterns are written with \* and \?"),
        ("p_%03d.tif", "patterns are written with"),
        ("p_###.tif", "patterns are written with"),
        ("~/p*.tif", r"no file matches .*: ~ and \$NAME are not replaced"),
        ("$HOME/p.tif", "are not replaced"),
        ("q_[0-9].tif", r"\[\[\] for a bracket itself"),
        ("q_1.tif", "q_1.tif$"),
        ("q_*.tif", r"q_\*\.tif$"),
    ],
)
def test_names_that_no_file_has_say_how_patterns_are_written(tmp_path, name, hint):
    with pytest.raises(FileNotFoundError, match=hint):
        matching(name, tmp_path)


@pytest.mark.parametrize(
    ("numbers", "gap"),
    [
        ([k for k in range(13) if k != 9], "p000008.tif and p000010.tif"),
        ([0, 10, *range(30, 130, 10)], "p000010.tif and p000030.tif"),
        ([k + 101 for k in range(13) if k != 5], "p000105.tif and p000107.tif"),
        (range(12), ""),
        (range(7, 67, 5), ""),
        ([3, 4, 9, 11, 14, 18, 19, 25, 27, 30, 31, 40], ""),  # left out on purpose
        ([120001 + k + (k > 4) for k in range(12)], ""),  # a time of day
    ],
)
def test_a_file_that_is_missing_between_evenly_spaced_views_is_warned_of(tmp_path, numbers, gap):
    names = [f"p{k:06d}.tif" for k in numbers]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = stack(tmp_path, "p*.tif", names)
    np.testing.assert_array_equal(found, READINGS[:, 0])
    said = [str(w.message) for w in caught if "have a gap" in str(w.message)]
    assert len(said) == bool(gap)
    if gap:
        assert f"the numbers of p*.tif have a gap between {gap}: if views" in said[0]
        # Views with an angle each, and files in a list, are as they are given.
        listed = {**geometry_values(GEOMETRY), "angles_deg": np.degrees(GEOMETRY.angles).tolist()}
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            stack(tmp_path, "p*.tif", names, listed)
            stack(tmp_path, names, names)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(["p_{:04d}.tif", "{}.tif", "run2_{:03d}.tif", "a_{:02d}_b.tif"]),
    st.integers(0, 999),
    st.integers(1, 12),
    st.integers(2, 400),
)
def test_series_without_a_gap_have_none(form, first, step, count):
    names = [Path(form.format(first + step * k)) for k in range(count)]
    assert gap_in_numbers(names) == ""
    assert gap_in_numbers([*names, Path("flat_1.tif")]) == ""


def test_multi_page_files_in_capitals_and_of_several_kinds(tmp_path):
    tifffile.imwrite(tmp_path / "all.TIFF", READINGS[:, 0])
    text = {
        "readings": "all.TIFF",
        "kind": "counts",
        "air": 3000,
        "geometry": geometry_values(GEOMETRY),
    }
    (tmp_path / "scan.yaml").write_text(yaml.safe_dump(text), encoding="utf-8")
    np.testing.assert_array_equal(open_scan(tmp_path / "scan.yaml").counts.numpy(), READINGS[:, 0])
    with tifffile.TiffWriter(tmp_path / "all.TIFF") as file:
        file.write(READINGS[0])
        file.write(np.zeros((3, 5), np.uint16))
    with pytest.raises(
        ValueError,
        match=r"all\.TIFF cannot be read as a TIFF image: it holds images of several kinds",
    ):
        open_scan(tmp_path / "scan.yaml")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_texts_with_and_without_a_byte_order_mark(tmp_path, encoding):
    angles = "\r\n".join(str(15.0 * k) for k in range(12))
    (tmp_path / "a.txt").write_bytes(angles.encode(encoding))
    values = {**geometry_values(GEOMETRY), "angles_deg": "a.txt"}
    np.testing.assert_allclose(geometry_of(values, tmp_path).angles, GEOMETRY.angles)
    np.save(tmp_path / "lines.npy", np.zeros((12, 16)))
    text = yaml.safe_dump({"readings": "lines.npy", "kind": "line_integrals", "geometry": values})
    (tmp_path / "scan.yaml").write_bytes(text.encode(encoding))
    assert open_scan(tmp_path / "scan.yaml").geometry.views == 12


def test_readings_of_16_bits_that_were_stored_with_a_sign(tmp_path):
    """Far below 0: 40000 and more of a camera; a little below 0: what is left of the dark."""
    counts = np.linspace(100, 60000, 12 * 16).reshape(12, 16).astype(np.uint16)
    np.save(tmp_path / "n.npy", counts.view(np.int16))
    text = {
        "readings": "n.npy",
        "kind": "counts",
        "air": 65000,
        "dark": 1.0,
        "electronic_noise": 3.0,
        "geometry": geometry_values(GEOMETRY),
    }
    (tmp_path / "scan.yaml").write_text(yaml.safe_dump(text), encoding="utf-8")
    with pytest.warns(
        UserWarning, match="readings of type int16 reach down to -.*: they are read as uint16"
    ):
        np.testing.assert_array_equal(
            open_scan(tmp_path / "scan.yaml").counts.numpy(), counts - 1.0
        )
    np.save(tmp_path / "n.npy", np.arange(-20, 172).reshape(12, 16).astype(np.int16))
    assert float(open_scan(tmp_path / "scan.yaml").counts.min()) == -21.0
