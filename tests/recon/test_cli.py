"""The command line: what it writes, what it refuses, what it says of itself."""

import json

import pytest

from recon.cli import main
from torchpcct import Volume


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
        (["reconstruct", "{tmp}/none.h5", "--voxel", "0", "--out", "{tmp}/a.h5"], "--voxel must be greater than 0 mm"),
        (["compare", "--realizations", "2", "--out", "{tmp}/o"], "realizations must be at least 3"),
        (["dose-factor", "--n", "2", "--out", "{tmp}/o"], "n must be at least 8"),
        (["study", "magic", "--out", "{tmp}/o"], "unknown study 'magic'"),
        (["study", "noise", "--set", "views", "--out", "{tmp}/o"], "give field=value"),
    ],
)
def test_command_line_refuses_bad_input_and_writes_nothing(tmp_path, capsys, arguments, message):
    assert main([a.format(tmp=tmp_path) for a in arguments]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["compare", "dose-factor", "study", "simulate", "reconstruct"])
def test_help(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for flag in ("--seed", "--device", "--out"):
        assert flag in text


def test_verify_finds_a_stale_readme_and_mends_it(tmp_path, capsys):
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "notebooks" / "r.json").write_text('{"a": 1.26}', encoding="utf-8")
    (tmp_path / "notebooks" / "claims.yaml").write_text(
        '- {text: "it is {a:.1f}×", values: {a: "r.json: a"}}\n', encoding="utf-8"
    )
    readme = tmp_path / "README.md"
    readme.write_text("# T\n\n## The studies\n\nSo it is 1.2× now.\n", encoding="utf-8")
    assert main(["verify", "--root", str(tmp_path)]) == 2
    assert "the results say: it is 1.3×" in capsys.readouterr().out
    assert main(["verify", "--root", str(tmp_path), "--write"]) == 0
    assert "So it is 1.3× now." in readme.read_text(encoding="utf-8")
    readme.write_text("# T\n\n## The studies\n\nSo it is 1.3× now, of 7.\n", encoding="utf-8")
    assert main(["verify", "--root", str(tmp_path)]) == 2
    assert "no claim covers the figures of: So it is" in capsys.readouterr().out
