"""Study ``phantom``: materials and lengths beside the paper's, and that wrong ones are seen."""

import copy

import pytest
from tiny_studies import assert_report_is_whole

from recon.study.paper import published as paper
from recon.study.phantom import TRANSMITTED, analytic_lengths, checks, raster_lengths
from torchpcct.scene.materials import MATERIALS
from torchpcct.scene.plaque import plaque_scene


def test_report(tiny, tmp_path):
    study = tiny("phantom")
    sections = (
        "## Agreement with the paper",
        "## Materials",
        "## CT numbers",
        "## Geometry",
        "elastin",
    )
    data = assert_report_is_whole(study, tmp_path, {"phantom.png"}, sections)
    assert (
        {m["material"] for m in data["materials"]}
        == set(paper.MATERIALS)
        == set(data["hu"][TRANSMITTED])
    )
    assert len(data["checks"]) == 5 + 5 + 10 + 14


def test_lengths_of_the_bodies_are_the_paper_s(tiny):
    lengths = tiny("phantom").measured.data["lengths_mm"]
    for name, value in paper.PHANTOM_MM.items():
        assert lengths["bodies"][name] == pytest.approx(
            value, abs=0.05 if "isocentre" in name else 1e-3
        )
        assert lengths["raster"][name] == pytest.approx(value, abs=0.07)  # of voxels of 0.05 mm


def test_the_raster_sees_other_lengths():
    """Each length follows its own parameter, measured on the raster as in the bodies."""
    scene, plaque = plaque_scene(
        vessel_diameter=3.0,
        wall_thickness=0.3,
        cap_thickness=0.3,
        core_semi_axes=(0.4, 0.7, 0.5),
        bulge=0.4,
        position=(10.0, 20.0, 0.0),
        patient_diameter=100.0,
    )
    voxel = 0.03
    bodies, raster = analytic_lengths(scene, plaque), raster_lengths(scene, plaque, voxel, 2)
    assert (bodies["core, minor axis"], bodies["core, major axis"]) == pytest.approx((0.8, 1.4))
    assert bodies["fibrous cap"] == pytest.approx(0.3, abs=1e-6)
    assert bodies["patient diameter"] == 100.0
    assert raster.keys() == bodies.keys()
    for name, value in bodies.items():
        assert raster[name] == pytest.approx(value, abs=1.7 * voxel), name


def test_checks_see_what_is_wrong(tiny):
    parts = copy.deepcopy(tiny("phantom").measured.data)
    failed = {c.name for c in checks(parts) if not c.ok and "raster" not in c.name}
    assert failed == {"blood iodine, HU, 64 keV", "pericoronary fat, HU, 64 keV"}
    parts["materials"][0]["density_g_cm3"] += 0.01
    parts["materials"][1]["fraction_error"] = 0.002
    parts["hu"][TRANSMITTED]["necrotic_core"] = 50.0
    parts["lengths_mm"]["bodies"]["fibrous cap"] = 0.2
    more = {c.name for c in checks(parts) if not c.ok and "raster" not in c.name} - failed
    assert len(more) == 4


def test_the_library_s_table_is_the_published_one():
    for name, (density, _, fractions) in paper.MATERIALS.items():
        total = sum(fractions.values())
        assert MATERIALS[name].density_g_cm3 == density
        assert dict(MATERIALS[name].mass_fractions) == pytest.approx(
            {k: v / total for k, v in fractions.items()}
        )
