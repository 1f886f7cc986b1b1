"""Geometry from the object itself: what was put in is found, within its errors, or refused."""

import math
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from analytic import Ellipsoid, line_integrals, vector_lines
from refusals import refusals

import recon
from recon.calibration import calibrate
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Scan, VectorGeometry, VolumeGrid, full_turn
from torchpcct.formats.geometry_yaml import geometry_of
from torchpcct.projector import with_parameters

PHOTONS = 2e4
FAN = FanBeam(full_turn(40), 40.0, 60.0, 40, 0.5)
GRID = VolumeGrid((28, 28), 0.34)
DISCS = [
    Ellipsoid((0.3, -0.4), (3.4, 4.0), 0.3, 0.05),
    Ellipsoid((0.6, -1.2), (1.4, 0.9), 0.6, -0.03),
    Ellipsoid((-1.2, 1.9), (0.7, 0.6), 0.0, 0.04),
]
CONE = ConeBeam(full_turn(30), 25.0, 50.0, 20, 16, 1.2)
VOLUME = VolumeGrid((11, 17, 17), 0.6)
TOOTH = [
    Ellipsoid((0.2, 0.3, -0.2), (2.6, 3.6, 4.2), 0.3, 0.05),
    Ellipsoid((-0.4, 0.5, 0.9), (1.5, 1.2, 1.4), 0.6, -0.03),
    Ellipsoid((1.0, -1.9, -1.2), (0.9, 0.9, 1.0), 0.0, 0.04),
]


def _scan(lines: Any, geometry: Any, seed: int | None = 0) -> Scan:
    lines = torch.from_numpy(lines)
    if seed is not None:
        counts = np.random.default_rng(seed).poisson(PHOTONS * np.exp(-lines.numpy()))
        lines = torch.from_numpy(-np.log(np.maximum(counts, 1) / PHOTONS))
    return Scan.from_line_integrals(lines.float(), geometry, photons=PHOTONS, mu_water=0.02)


def _cone_lines(**numbers: float) -> Any:
    given = {n: torch.tensor(v, dtype=torch.float64) for n, v in numbers.items()}
    poses = with_parameters(CONE, **given).poses().numpy()
    return vector_lines(VectorGeometry(poses.reshape(-1, 12), CONE.columns, CONE.rows), TOOTH, 2)


def test_the_offset_of_noisy_fans_lies_within_its_error():
    lines = line_integrals(FAN.with_column_offset(0.23), DISCS)
    found = [calibrate(_scan(lines, FAN, seed), GRID, ["offset"]) for seed in range(3)]
    errors = np.array([f.values["offset"] - 0.23 for f in found])
    stated = np.array([f.errors["offset"] for f in found])
    assert np.abs(errors).max() < 0.05 * FAN.pitch
    assert (np.abs(errors) < 3 * stated).all()
    assert np.sqrt(np.mean((errors / stated) ** 2)) > 0.3  # nor are they empty words
    assert isinstance(found[0].geometry, FanBeam)
    assert found[0].geometry.offset == pytest.approx(found[0].values["offset"])
    assert found[0].misfit[0] > 2 * found[0].misfit[1]


def test_offset_and_roll_of_a_cone_beam():
    lines = _cone_lines(offset=0.35, roll=math.radians(-1.2))
    found = recon.calibrate(_scan(lines, CONE), VOLUME)
    assert abs(found.values["offset"] - 0.35) < min(
        0.05 * CONE.column_pitch, 4 * found.errors["offset"]
    )
    assert abs(found.values["roll"] + 1.2) < max(0.05, 4 * found.errors["roll"])
    assert found.errors["roll"] < 0.2
    assert isinstance(found.geometry, VectorGeometry)
    expected = VectorGeometry.of(CONE.with_column_offset(found.values["offset"]))
    roll = math.radians(found.values["roll"])
    np.testing.assert_allclose(
        found.geometry.vectors, expected.turned(roll=roll).vectors, atol=1e-9
    )


def test_the_command_writes_what_reconstruct_reads(here, cli):
    lines = line_integrals(FAN.with_column_offset(0.23), DISCS)
    _scan(lines, FAN).save("tooth.h5")
    text = cli("calibrate tooth.h5 --free offset --voxel 0.28 --extent 9.5 9.5")
    assert "offset     +0.2" in text
    assert "reconstruct tooth.h5 --geometry tooth_geometry.yaml" in text
    written = (here / "tooth_geometry.yaml").read_text(encoding="utf-8")
    geometry = geometry_of(yaml.safe_load(written))
    assert geometry.column_offset == pytest.approx(0.23, abs=0.02)
    cli("reconstruct tooth.h5 --geometry tooth_geometry.yaml --voxel 0.5 --out v.nii.gz")
    # Its own file is written anew, another one is not. A name of two lines is one line of YAML.
    (here / "tooth.h5").rename(here / "to\noth.h5")
    again = "--voxel 0.28 --extent 9.5 9.5 --out tooth_geometry.yaml --json"
    assert '"errors"' in cli(f"calibrate 'to\noth.h5' {again}")
    written = (here / "tooth_geometry.yaml").read_text(encoding="utf-8")
    assert geometry_of(yaml.safe_load(written)) == geometry
    (here / "to\noth.h5").rename(here / "tooth.h5")
    (here / "mine.yaml").write_text("kind: fan\n", encoding="utf-8")
    refusing = cli("calibrate tooth.h5 --out mine.yaml", status=2)
    assert "not made by torchpcct calibrate" in refusing


def _fan() -> Scan:
    return _scan(line_integrals(FAN, DISCS), FAN)


PARALLEL = ParallelBeam(np.arange(40) * math.pi / 40, 48, 0.28)
CURVED = FanBeam(full_turn(60), 40.0, 60.0, 48, 0.4, detector="curved")
test_refusals = refusals(
    ("unknown size", lambda: calibrate(_fan(), GRID, ["sod"])),
    ("sdd is not determined", lambda: calibrate(_fan(), GRID, ["offset", "sdd"])),
    (
        "offset and axis cannot be distinguished",
        lambda: calibrate(
            _scan(line_integrals(PARALLEL, DISCS), PARALLEL), GRID, ["offset", "axis"]
        ),
    ),
    (
        "tilt is not determined",
        lambda: calibrate(_scan(_cone_lines(), CONE), VOLUME, ["offset", "tilt"]),
    ),
    ("did you mean 'offset'", lambda: calibrate(_fan(), GRID, ["ofset"])),
    ("twice", lambda: calibrate(_fan(), GRID, ["offset", "offset"])),
    ("name what to estimate", lambda: calibrate(_fan(), GRID, [])),
    ("needs a detector with rows", lambda: calibrate(_fan(), GRID, ["roll"])),
    ("flat", lambda: calibrate(_scan(line_integrals(CURVED, DISCS), CURVED), GRID)),
    ("must be a Scan", lambda: calibrate(torch.zeros(3), GRID)),  # type: ignore[arg-type]
)
