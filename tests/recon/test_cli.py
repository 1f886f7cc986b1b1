"""The command line: what it writes, what it refuses, what it says of itself."""

import argparse
import hashlib
import json
import logging
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from analytic import Ellipsoid, line_integrals
from foreign_files import data_exchange
from small_scan import GRID

from recon.cli import main
from recon.cli.parsing import as_options, showing_messages
from recon.mbir.known import KnownImage
from recon.motion import InsetMotion
from recon.study.results import README_MARKS
from recon.vessel.known import KnownVessel
from torchpcct import ConeBeam, ParallelBeam, Scan, Volume, VolumeGrid, __version__, full_turn
from torchpcct.acquisition.config import read_config
from torchpcct.formats.geometry_yaml import geometry_of
from torchpcct.formats.stack import _COUNTS, _LINES
from torchpcct.scene.scene import Scene
from torchpcct.scene.voxels import VoxelScene

CONFIG = """
scene: {kind: bodies, bodies: [{name: a, shape: cylinder, semi_axes: 20, material: water}]}
scanner: {preset: pcct, views: 60, rows: 2, columns: 300}
exposure_s: 1.0
seed: 5
"""


def test_a_scene_from_a_configuration_to_a_picture(here, cli):
    (here / "scene.yaml").write_text(CONFIG, encoding="utf-8")
    assert "sub-rays a reading" in cli("simulate --config scene.yaml --dry-run --out scan.h5")
    assert not (here / "scan.h5").exists()
    assert len(cli("simulate --config scene.yaml --out scan.h5").splitlines()) == 1
    # What was done stands beside the result, and does the same again.
    cli("simulate --config scan.h5.yaml --out again.h5")
    assert torch.equal(Scan.load("again.h5").counts, Scan.load("scan.h5").counts)
    assert "GiB" in cli("reconstruct scan.h5 --voxel 2 --dry-run --out v.mha")
    assert not (here / "v.mha").exists()
    cli("reconstruct scan.h5 --voxel 2 --extent 2 60 60 --center 0 0 0 --out v.mha")
    assert yaml.safe_load((here / "v.mha.yaml").read_text())["geometry"]["kind"] == "cone"
    cli("info scan.h5")
    assert '"kind": "volume"' in cli("info v.mha --json")
    cli("view v.mha --level 0 --window 300 --out v.png")
    assert (here / "v.png").read_bytes().startswith(b"\x89PNG")


def test_the_example_configuration_is_complete(tmp_path, cli):
    path = tmp_path / "example.yaml"
    path.write_text(cli("show-config"), encoding="utf-8")
    config = read_config(path)
    assert config.scene.names == ("patient", "spine", "vessel")
    assert set(yaml.safe_load(path.read_text())) == set(config.values)
    path.write_text(CONFIG.replace("views", "view"), encoding="utf-8")
    with pytest.raises(ValueError, match="scanner: unknown view; it takes views, mode"):
        read_config(path)


@pytest.mark.parametrize(
    ("text", "expected_text"),
    [
        ("scene: [", "is not YAML"),
        (
            "scene: {kind: water, diameter: 100}\nexposure: 1",
            "unknown exposure; it takes scene, scanner, exposure_s",
        ),
        ("- scene", "must be a mapping with scene"),
        ("scene: water", "scene must be a mapping with kind, got 'water'"),
        ("scene: {kind: fog}", "scene.kind"),
        (
            "scene: {kind: bodies, bodies: [{name: a, shape: box}]}",
            r"scene.bodies\[0\] needs material",
        ),
        (
            "scene: {kind: bodies, bodies: [{name: a, material: water, shape: box}]}",
            r"scene.bodies\[0\] needs",
        ),
        ("scene: {kind: bodies, bodies: [{shape: cube}]}", r"scene.bodies\[0\].shape"),
        ("scene: {kind: volume}", "needs file"),
        (
            "scene: {kind: volume, file: v.h5, energy_kev: high}",
            "scene.energy_kev must be a number in keV, got 'high'",
        ),
        (
            "scene: {kind: volume, file: v.h5}",
            "v.h5 is in mm\\^-1: a scene is made of a volume in HU",
        ),
        ("scene: {kind: water}\nregion: {shape: [1, 2, 2]}", "region needs spacing"),
        ("scene: {kind: water}\nscanner: {preset: mri}", "scanner.preset"),
        (
            "scene: {kind: water}\ntolerance_hu: small",
            "tolerance_hu must be a number in HU, got 'small'",
        ),
        ("scene: {kind: water}\ntolerance_hu: -1", "tolerance_hu must be"),
        ("scene: {kind: water}\ntolerance_hu: true", "tolerance_hu must be a number in HU"),
        ("scene: {kind: bodies, bodies: 5}", "scene.bodies must be a list of bodies, .* got 5"),
        ("scene: {kind: bodies, bodies: {a: 1}}", "scene.bodies must be a list of bodies"),
        ("scene: {kind: water}\nscanner: pcct", "scanner must be a mapping with preset .*'pcct'"),
    ],
)
def test_configurations_that_are_none_are_refused(tmp_path, text, expected_text):
    Volume(torch.zeros(2, 2, 2), VolumeGrid((2, 2, 2), 1.0), unit="mm^-1").save(tmp_path / "v.h5")
    (tmp_path / "scene.yaml").write_text(text, encoding="utf-8")
    with pytest.raises((ValueError, TypeError), match=expected_text):
        read_config(tmp_path / "scene.yaml")


def test_the_seed_is_the_options_if_there_is_one_and_0_is_one(here, cli):
    (here / "scene.yaml").write_text(CONFIG, encoding="utf-8")
    for given, found in (("", 5), ("--seed 0", 0), ("--seed 7", 7)):
        assert f"seed: {found}\n" in cli(
            f"simulate --config scene.yaml --dry-run --out a.h5 {given}"
        )


def test_scenes_by_their_kind(tmp_path):
    """Water, the paper's plaque and a volume in HU, with the defaults in what the scan keeps."""
    Volume(torch.zeros(2, 2, 2), VolumeGrid((2, 2, 2), 1.0)).save(tmp_path / "v.h5")
    for text, kind, expected_text in (
        ("{kind: water}", Scene, {"kind": "water"}),
        ("{kind: plaque, core_contrast: 0.5}", Scene, {"kind": "plaque", "core_contrast": 0.5}),
        (
            "{kind: volume, file: v.h5}",
            VoxelScene,
            {"kind": "volume", "file": str(tmp_path / "v.h5"), "energy_kev": None, "dense": "bone"},
        ),
    ):
        (tmp_path / "scene.yaml").write_text(f"scene: {text}", encoding="utf-8")
        config = read_config(tmp_path / "scene.yaml")
        assert isinstance(config.scene, kind)
        assert config.values["scene"] == expected_text


def test_numbers_by_the_names_of_their_axes(tmp_path):
    """x, y, z of a body and z, y, x of a region in any order; lists as they were."""
    (tmp_path / "named.yaml").write_text(
        "scene: {kind: bodies, bodies: [{name: a, shape: cylinder, semi_axes: {y: 2, x: 1}, "
        "material: water, "
        "position: {z: 3, x: 1, y: 2}}]}\nregion: {shape: {x: 4, y: 5, z: 6}, spacing: {z: 1, y: "
        "2, x: 2}, "
        "center: {x: 1, y: 2, z: 3}}",
        encoding="utf-8",
    )
    (tmp_path / "listed.yaml").write_text(
        "scene: {kind: bodies, bodies: [{name: a, shape: cylinder, semi_axes: [1, 2], material: "
        "water, "
        "position: [1, 2, 3]}]}\nregion: {shape: [6, 5, 4], spacing: [1, 2, 2], center: [3, 2, 1]}",
        encoding="utf-8",
    )
    named, listed = (read_config(tmp_path / f"{name}.yaml") for name in ("named", "listed"))
    assert named.region == listed.region == VolumeGrid((6, 5, 4), (1, 2, 2), (3, 2, 1))
    assert named.scene["a"] == listed.scene["a"]
    assert named.scene["a"].shape.position == (1, 2, 3)
    for text, expected_text in (
        (
            "{kind: water, position: {x: 1, y: 2, w: 3}}",
            "scene.position must be numbers, or a mapping of the axes x, y",
        ),
        ("{kind: water, position: {x: 1, z: 3}}", "position must be 3 numbers"),
    ):
        (tmp_path / "bad.yaml").write_text(f"scene: {text}", encoding="utf-8")
        with pytest.raises(ValueError, match=expected_text):
            read_config(tmp_path / "bad.yaml")


def test_what_is_above_muscle_in_a_volume_is_said_and_chosen(here, cli):
    """Bone unless iodine, water or labels are asked for; the command line says which share was
    scanned as what."""
    hu = torch.full((2, 10, 10), -1000.0)
    hu[:, 4:8, 4:8] = 40.0
    hu[:, 4, 4:8] = 300.0
    Volume(hu, VolumeGrid((2, 10, 10), 4.0)).save("v.h5")
    labels = torch.zeros(hu.shape)
    labels[:, :, :6] = 1.0
    Volume(labels, VolumeGrid((2, 10, 10), 4.0)).save("labels.h5")
    Volume(labels, VolumeGrid((2, 10, 10), 3.0)).save("coarse.h5")
    path, scanner = here / "scene.yaml", "\nscanner: {preset: pcct, views: 4, rows: 1, columns: 60}"
    for dense, expected_text in (
        ("", "4.0% of the voxels as bone"),
        (", dense: iodine", "4.0% of the voxels as iodine"),
        (
            ", dense: labels.h5",
            "2.0% of the voxels as bone, 2.0% of the voxels as iodine, 0.0% of the voxels as water",
        ),
    ):
        path.write_text(f"scene: {{kind: volume, file: v.h5{dense}}}{scanner}", encoding="utf-8")
        assert expected_text in cli("simulate --config scene.yaml --dry-run --out s.h5")
    assert expected_text in cli("simulate --config scene.yaml --out s.h5")
    assert read_config(here / "s.h5.yaml").values["scene"]["dense"] == str(here / "labels.h5")
    for dense, expected_text in (
        ("gold", "scene.dense must be bone, iodine, water"),
        ("coarse.h5", "not those of v.h5"),
    ):
        path.write_text(f"scene: {{kind: volume, file: v.h5, dense: {dense}}}", encoding="utf-8")
        with pytest.raises(ValueError, match=expected_text):
            read_config(path)


def test_a_foreign_scan_without_pixel_size(here, cli):
    """README's own command on the best known file of the format; every refusal names options of
    the command line."""
    geometry = ParallelBeam(np.arange(31) * np.pi / 30, 48, 1.0)
    lines = line_integrals(geometry, [Ellipsoid((2.0, -3.0), 12.0, value=0.02)])
    data_exchange(
        "tooth.h5", 4e4 * np.exp(-lines[:, None]), np.full((5, 1, 48), 4e4), geometry.angles
    )
    assert "unit: pixel^-1" in cli("info tooth.h5")
    command = "reconstruct tooth.h5 --find-axis --out tooth.nii.gz"
    output = cli(command)
    assert "axis at column 23." in output
    assert "of 1 × 1 × 1 pixels (the file does not know their size: --pitch MM)" in output
    report = (here / "tooth.nii.gz.json").read_text(encoding="utf-8")
    assert '"spacing_pixels": [1.0, 1.0, 1.0],' in report  # lists on one line
    assert "mean_hu" not in report
    for option, message in (
        ("--mu-water 0.02", "the size of its pixels is unknown: give --pitch MM, too"),
        ("--photons 100", "--photons N applies to line integrals"),
        ("--slices 7:", "--slices A:B must lie within the 1 rows"),
        ("--pitch -1", "--pitch must be greater than 0 mm"),
    ):
        assert message in cli(f"{command} {option}", 2)
    # Nor does a calibration invent a size; its geometry takes one.
    output = cli("calibrate tooth.h5 --free offset --out found.yaml")
    assert "pixels\nfound.yaml: " in output
    assert "--geometry found.yaml --pitch MM" in output
    assert "# lengths in pixels" in (here / "found.yaml").read_text(encoding="utf-8")
    placed = "reconstruct tooth.h5 --geometry found.yaml --force --out tooth.nii.gz"
    assert "of 1 × 1 × 1 pixels" in cli(placed)
    assert "of 0.5 × 0.5 × 0.5 mm" in cli(f"{placed} --pitch 0.5 --mu-water 0.02")


def test_names_and_grey_scale_of_their_own(here, cli):
    """Without --out in the working directory; a volume in mm⁻¹ is not drawn black; a scan is no
    volume."""
    geometry = ParallelBeam(np.arange(8) * np.pi / 8, 12, 1.0)
    Scan.from_line_integrals(np.full(geometry.shape, 0.3), geometry, photons=1e4).save("lines.h5")
    plan = json.loads(cli("reconstruct lines.h5 --dry-run --json"))
    assert plan["estimate"]["file"] == "lines_fbp.nii.gz"
    assert plan["geometry"]["kind"] == "parallel"
    assert "is a scan, not a volume" in cli("view lines.h5", 2)
    ramp = torch.linspace(0.0, 0.2, 48).reshape(3, 4, 4)
    Volume(ramp, VolumeGrid((3, 4, 4), 1.0), unit="mm^-1").save("small.nii.gz")
    assert "level 0.1, window 0.19" in cli("view small.nii.gz")
    Volume(10000 * ramp - 1000, VolumeGrid((3, 4, 4), 1.0)).save("series")
    assert "level 40, window 400" in cli("view series")
    assert "kind: volume" in cli("info series")
    assert sorted(p.name for p in here.glob("*.png")) == ["series.png", "small.png"]
    # What only looks at a volume shows one with holes, too.
    ramp[0, 0] = torch.nan
    Volume(ramp, VolumeGrid((3, 4, 4), 1.0), unit="mm^-1").save("holes.nii")
    about = json.loads(cli("info holes.nii --json"))
    assert about["voxels_not_finite"] == 4
    assert about["highest"] == pytest.approx(0.2)
    assert "level 0.1" in cli("view holes.nii")
    Volume(ramp * torch.nan, VolumeGrid((3, 4, 4), 1.0), unit="mm^-1").save("none.nii")
    assert "none.nii has no finite value" in cli("view none.nii", 2)


def test_a_lower_dose_of_a_scan_file(here, cli):
    """Counts are thinned, the same by the same seed; nothing is made of line integrals of
    unknown photons."""
    geometry = ParallelBeam(np.arange(60) * np.pi / 60, 40, 0.5)
    lines = line_integrals(geometry, [Ellipsoid((0.0, 0.0), 8.0, value=0.02)])
    scan = Scan.from_counts(
        np.random.default_rng(0).poisson(1e4 * np.exp(-lines)), geometry, air=1e4
    )
    scan.save("full.h5")
    assert "exact" in cli("lower-dose full.h5 --fraction 0.1 --seed 3 --out low.h5")
    low = Scan.load("low.h5")
    assert torch.equal(low.counts, scan.at_dose(0.1, 3).counts)
    assert low.info["lower_dose"] == {"fraction": 0.1, "seed": 3, "exact": True}
    assert float(low.counts.sum() / scan.counts.sum()) == pytest.approx(0.1, rel=0.01)
    Scan.from_line_integrals(lines, geometry).save("lines.h5")
    command = "lower-dose lines.h5 --fraction 0.5 --out l.h5"
    assert "--photons N" in cli(command, 2)
    assert not (here / "l.h5").exists()
    assert "approximate" in cli(f"{command} --photons 1e4")


def test_verify_finds_a_stale_readme_and_renders_it(here, capsys, cli):
    folder = here / "notebooks"
    (folder / "r").mkdir(parents=True)
    (folder / "r" / "report.json").write_text('{"a": 1.26}', encoding="utf-8")
    first, last = README_MARKS
    (folder / "results.template.md").write_text(
        f"{first}\nSo it is {{{{ r.a|f('.1f') }}}}× now.\n{last}\n", encoding="utf-8"
    )
    readme = here / "README.md"
    readme.write_text(f"# T\n{first}\nSo it is 1.2× now.\n{last}\n", encoding="utf-8")
    assert main(["verify", "--root", "."]) == 2
    assert "stale: README.md, notebooks/RESULTS.md" in capsys.readouterr().out
    cli("verify --root . --write")
    assert "So it is 1.3× now." in readme.read_text(encoding="utf-8")
    assert (folder / "RESULTS.md").read_text(encoding="utf-8") == "So it is 1.3× now.\n"
    cli("verify --root .")


def test_a_report_says_what_it_was_made_of_and_how(here, capsys, cli):
    """Version, command line, hash of the input, found axis; weights by name, with their hash."""
    geometry = ParallelBeam(np.arange(48) * np.pi / 24, 40, 1.0, -1.4)
    lines = line_integrals(geometry, [Ellipsoid((2.0, -3.0), (9.0, 12.0), value=0.02)])
    counts = np.random.default_rng(0).poisson(1e5 * np.exp(-lines))
    Scan.from_counts(counts, replace(geometry, offset=0.0), air=1e5, mu_water=0.02).save("scan.h5")
    command = "reconstruct scan.h5 --find-axis --out v.h5"
    assert main(command.split()) == 0
    output = capsys.readouterr()
    assert "axis at column 20.9" in output.out
    report = Volume.load("v.h5").report
    assert report["axis"]["column"] == pytest.approx(20.9, abs=report["axis"]["error"])
    assert report["command"] == f"torchpcct {command}"
    assert report["torchpcct"] == __version__
    assert report["input_sha256"] == hashlib.sha256((here / "scan.h5").read_bytes()).hexdigest()
    assert all(output.err.count(text) <= 1 for text in report["warnings"])
    assert (
        json.loads((here / "v.h5.json").read_text(encoding="utf-8"))["command"] == report["command"]
    )
    command += " --force --weights scan.h5"
    assert "--weights is an option of --method mbir" in cli(command, 2)
    assert "holds no weights of this unrolled reconstruction" in cli(f"{command} --method mbir", 2)


def test_the_example_of_a_stack_is_complete(cli):
    # what is optional, too
    text = cli("show-config --stack").split("\n", 1)[1].replace("\n# ", "\n")
    given = yaml.safe_load(text)
    assert set(given) - {"readings", "kind", "geometry"} <= _COUNTS | _LINES
    assert geometry_of(given["geometry"]).shape == (720, 64, 888)


def test_a_warning_is_said_once_and_in_the_words_of_the_command(capsys):
    actions = [argparse.ArgumentParser().add_argument("--pitch", metavar="MM")]
    with showing_messages(actions, verbose=False) as warn:
        logging.getLogger("recon.api").warning("%s", "too few: give pitch=")
        warnings.simplefilter("always")
        warnings.warn("too few: give pitch=", UserWarning, stacklevel=1)
        warn("too few: give pitch=")
    assert capsys.readouterr().err == "warning: too few: give --pitch MM\n"
    assert (
        as_options("pitch=0.5 or pitch='x'; pitch must be 1", actions)
        == "--pitch 0.5 or --pitch x; pitch must be 1"
    )
    assert as_options("pitch must be 1", actions) == "--pitch must be 1"
    of_file = "a.yaml cannot be read as a scan: pitch must be 1"
    assert as_options(of_file, actions) == of_file
    assert (
        as_options("a: pitch[1] needs 1 (pitch=)", actions) == "a: --pitch[1] needs 1 (--pitch MM)"
    )


@pytest.mark.parametrize(
    "value",
    [
        "VolumeGrid(shape=(8, 8), spacing=(1.0, 1.0), pitch=(0.0, 0.0))",
        "Scan(1 view\n  ConeBeam(pitch=(0.5, 0.35), offset=np.array((1, (2,))), pitch=1.0))",
        "'pitch=1'",
        '"pitch=1 and pitch= must be"',
        "/data/pitch=0.5/scan.h5",
        "pitch=0.5/scan.h5",
        "pitch=0.5.h5",
        "pitch=(1, 2)",
        "pitch=[1, 2]",
        "x-pitch=3",
    ],
)
def test_a_value_in_a_message_stays_as_it_is(value):
    actions = [argparse.ArgumentParser().add_argument("--pitch", metavar="MM")]
    assert (
        as_options(f"{value} does not fit the scan's pitch=", actions)
        == f"{value} does not fit the scan's --pitch MM"
    )


def test_a_scan_of_a_region_is_reconstructed_there(here, cli, clean):
    """The user's own, wherever it lies: the paper's plaque was the default once."""
    clean.with_noise(1.0, 0).save("mine.h5")
    cli("reconstruct mine.h5 --out mine.nii.gz")
    assert Volume.load("mine.nii.gz").grid.shape == GRID.shape
    np.testing.assert_allclose(Volume.load("mine.nii.gz").grid.center, GRID.center, atol=1e-4)
    elsewhere = yaml.safe_load(
        cli("reconstruct mine.h5 --voxel 0.8 --extent 1.6 3.2 4 --dry-run").rpartition("\n")[0]
    )
    assert elsewhere["grid"] == {
        "shape": [2, 4, 5],
        "spacing": [0.8] * 3,
        "center": list(GRID.center),
    }
    said = cli("reconstruct mine.h5 --memory 2GB --out mine.nii", 2)
    assert "mine.h5 can only be read as a whole: leave out --memory SIZE" in said
    assert "damaged" not in said
    assert "--slices A:B" in cli("reconstruct mine.h5 --slices 1:2 --out other.nii", 2)


def test_a_path_is_written_beside_the_volume(here, cli, clean, monkeypatch):
    clean.with_noise(1.0, 0).save("mine.h5")
    still = np.zeros((clean.geometry.views, 3))
    found = InsetMotion(still, still + 0.02, True, 9.0, 0.1, (1.0, 1.0), 2)
    monkeypatch.setattr("recon.motion.estimate.estimate_motion", lambda scan, grid: found)
    (here / "a_motion.csv").write_text("my own", encoding="utf-8")
    assert "a_motion.csv exists" in cli("reconstruct mine.h5 --motion estimate --out a.mha", 2)
    assert (here / "a_motion.csv").read_text(encoding="utf-8") == "my own"
    cli("reconstruct mine.h5 --motion estimate --out b.nii.gz")
    report = json.loads((here / "b.nii.gz.json").read_text(encoding="utf-8"))["motion"]
    assert (report["table"], report["picture"]) == ("b_motion.csv", "b_motion.png")
    assert len((here / "b_motion.csv").read_text(encoding="utf-8").splitlines()) == 1 + len(still)
    assert (here / "b_motion.png").read_bytes().startswith(b"\x89PNG")
    cli("reconstruct mine.h5 --motion estimate --out b.nii.gz")  # onto its own files


def test_what_a_drawn_vessel_has_changed_is_written_and_shown(here, cli, clean, monkeypatch):
    monkeypatch.setattr(
        KnownVessel, "image_of", lambda self, term, _: KnownImage(torch.zeros(term.shape))
    )
    clean.with_noise(1.0, 0).save("mine.h5")
    cli("reconstruct mine.h5 --method mbir --vessel --out a.nii.gz")
    report = json.loads((here / "a.nii.gz.json").read_text(encoding="utf-8"))
    assert any(
        "a vessel model with smooth outlines was used" in text for text in report["warnings"]
    )
    assert report["vessel_difference_hu"] == "a_vessel_difference.nii.gz"
    changed = Volume.load("a_vessel_difference.nii.gz").data
    cli("reconstruct mine.h5 --method mbir --out b.nii.gz")
    difference = Volume.load("a.nii.gz").data - Volume.load("b.nii.gz").data
    torch.testing.assert_close(changed, difference, rtol=0, atol=1e-3)
    assert "a, b, a_vessel_difference" in cli("view a.nii.gz b.nii.gz --html both.html")


def test_a_vessel_is_read_where_the_scan_was_taken_or_said(here, cli):
    cone = ConeBeam(full_turn(8), 60.0, 100.0, 6, 4, 1.0)
    Scan.from_counts(np.ones((8, 4, 6), np.float32), cone, air=2.0).save("whole.h5")
    assert "--center Z Y X and --extent Z Y X in mm" in cli("plaque whole.h5 --out reading", 2)
