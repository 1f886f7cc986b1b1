"""``torchpcct plaque`` on a scan file. Few views would smear the vessel: the gantry turns during
each."""

import json

import pytest


@pytest.mark.slow
def test_reads_a_scan_and_says_what_fbp_reads(here, cli):
    out = here / "reading"
    cli("simulate --views 984 --exposure 20 --seed 1 --out scan.h5")
    more = "--particles 100 --voxel 0.25 --out reading --no-progress"
    assert "soft FBP, same regions" in cli(f"plaque scan.h5 --point 0 -30.4 -28.1 {more}")
    told = json.loads((out / "report.json").read_text())
    assert told["figures"]["lumen"]["value"] == pytest.approx(480, abs=15)
    assert told["figures"]["lumen area"]["value"] == pytest.approx(4.11, abs=0.4)
    assert told["same_regions"]["soft FBP"]["fat"] == pytest.approx(-93, abs=8)
    assert {f.name for f in out.iterdir()} == {
        "report.md",
        "report.json",
        "tissues.nii.gz",
        "image.nii.gz",
        "plaque.png",
    }


def test_refuses_a_point_outside(here, cli):
    cli("simulate --views 8 --out scan.h5")
    assert "outside of the volume" in cli(
        "plaque scan.h5 --voxel 0.5 --point 90 0 0 --out reading --no-progress", 2
    )
    assert not (here / "reading").exists()


@pytest.mark.parametrize(
    ("option", "why"),
    [
        ("--wall 50 0", "--wall SD must be greater than 0"),
        ("--beside zzz", "invalid choice: 'zzz'"),
        ("--particles 3", "--particles must be at least 50"),
        ("--point-sd 0", "--point-sd must be greater than 0"),
        ("--point 1 nan 2", "--point[1] must be finite"),
        ("--extent 1 -2 3", "--extent[1] must be greater than 0"),
        ("--seed -1", "--seed must be at least 0"),
        ("--out scan.h5", "is a file"),
    ],
)
def test_arguments_are_refused_before_the_scan_is_read(here, cli, monkeypatch, option, why):
    monkeypatch.setattr("torchpcct.scan.Scan.load", lambda path: pytest.fail("the scan was read"))
    (here / "scan.h5").write_bytes(b"")
    assert why in cli(f"plaque scan.h5 --no-progress {option}", 2)
