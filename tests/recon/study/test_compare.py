"""The compare study and the command line, end to end at small scale."""

import json

import numpy as np
import pytest

from recon.cli import main
from recon.study.compare.measure import Settings, inset_grid, run
from recon.study.compare.report import build_report
from recon.study.paper import facts as paper
from recon.study.report import markdown_table
from torchpcct import Volume
from torchpcct.metrics.placement import RoiRule, place_rois
from torchpcct.metrics.roi import axial_grid
from torchpcct.scene.plaque import plaque_scene

TINY = Settings(
    realizations=3, views=48, kernels=("soft",), voxels_mm=(0.4,), doses={"1x": 0.35, "5.7x": 2.0}, pwls=False
)


@pytest.fixture(scope="module")
def result():
    return run(TINY)


def test_statistics_and_checks(result):
    assert len(result.statistics) == 2
    stat = result.find("fbp", "soft", 0.4, 2.0)
    d = stat.as_dict()
    fg, bg = np.array(stat.foreground), np.array(stat.background)
    assert d["cnr"] == pytest.approx((bg.mean() - fg.mean()) / np.hypot(bg.std(ddof=1), fg.std(ddof=1)))
    assert d["cnr_interval"][0] < d["cnr"] < d["cnr_interval"][1]
    # 48 views with the tube load of the whole scan: the slope of noise against dose is still −½.
    assert result.as_dict()["noise_against_dose"][0]["pixel"] == pytest.approx(-0.5, abs=0.02)


def test_the_same_seed_gives_the_same_report(result):
    again = run(TINY)
    for a, b in zip(result.statistics, again.statistics, strict=True):
        np.testing.assert_array_equal(a.foreground, b.foreground)
        np.testing.assert_array_equal(a.background, b.background)


def test_report_files(result, tmp_path):
    build_report(result).save(tmp_path / "out")
    data = json.loads((tmp_path / "out" / "report.json").read_text())
    assert data["study"] == "compare"
    assert data["rois"]["foreground_mm2"] > 0
    assert all({"name", "ours", "paper", "low", "high", "ok"} <= set(c) for c in data["checks"])
    text = (tmp_path / "out" / "report.md").read_text()
    assert "paper 1.51" in text
    assert (tmp_path / "out" / "compare.png").read_bytes().startswith(b"\x89PNG")


def test_markdown_table_is_aligned():
    lines = markdown_table(["a", "bb"], [["long name", "1"], ["x", "22"]]).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert lines[1] == "|:----------|---:|"


@pytest.mark.parametrize(("changes", "match"), [({"realizations": 2}, "realizations"), ({"views": 4}, "views")])
def test_bad_settings(changes, match):
    with pytest.raises(ValueError, match=match):
        Settings(**changes)


def test_rois_lie_inside_their_tissues():
    scene, plaque = plaque_scene()
    image = axial_grid(inset_grid(plaque, 0.1).center)
    rois = place_rois(scene, image)
    labels = scene.labels(image)
    assert (labels[rois.foreground] == scene.index("core")).all()
    assert (labels[rois.background] == scene.index("fibrous")).all()
    assert rois.background.sum() < rois.foreground.sum()
    with pytest.raises(ValueError, match="foreground ROI is empty"):
        place_rois(scene, image, rule=RoiRule(core_margin=3.0))


def test_paper_tables_have_the_papers_shape():
    assert paper.FOREGROUND.shape == paper.BACKGROUND.shape == (4, 5, 2)
    assert paper.CNR.max() == paper.CNR[0, 1] == 2.20


def test_command_line_simulate_and_reconstruct(tmp_path, capsys):
    scan, volume = tmp_path / "scan.h5", tmp_path / "plaque.nii.gz"
    assert main(["simulate", "--views", "48", "--exposure", "2", "--seed", "3", "--out", str(scan)]) == 0
    assert json.loads(capsys.readouterr().out)["seed"] == 3
    assert main(["reconstruct", str(scan), "--kernel", "soft", "--voxel", "0.4", "--out", str(volume)]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["method"] == "fbp"
    assert json.loads((tmp_path / "plaque.nii.gz.json").read_text()) == summary
    assert volume.exists()
    h5 = tmp_path / "plaque.h5"
    assert main(["reconstruct", str(scan), "--voxel", "0.4", "--out", str(h5)]) == 0
    assert Volume.load(h5).grid.spacing == (0.4, 0.4, 0.4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["simulate", "--exposure", "0", "--out", "{tmp}/a.h5"], "exposure_s"),
        (["simulate", "--seed", "-1", "--exposure", "1", "--out", "{tmp}/a.h5"], "seed"),
        (["simulate", "--out", "{tmp}/none/a.h5"], "does not exist"),
        (["reconstruct", "{tmp}/none.h5", "--out", "{tmp}/a.h5"], "none.h5"),
        (["reconstruct", "{tmp}/none.h5", "--out", "{tmp}/a.png"], "unknown volume format"),
        (["compare", "--realizations", "2", "--out", "{tmp}/o"], "realizations"),
    ],
)
def test_command_line_refuses_bad_input_and_writes_nothing(tmp_path, capsys, arguments, message):
    assert main([a.format(tmp=tmp_path) for a in arguments]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["compare", "simulate", "reconstruct"])
def test_help(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for flag in ("--seed", "--device", "--out"):
        assert flag in text
