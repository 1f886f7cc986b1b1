"""True tissue values by rods: against the spectrum behind the patient, and what they must not
depend on."""

import pytest

from recon.study.paper import plaque_scan
from recon.study.paper.plaque_scan import rod_values
from torchpcct.scanner import presets
from torchpcct.scene.materials import MATERIALS
from torchpcct.scene.plaque import plaque_scene


@pytest.fixture(scope="module")
def setup():
    scene, plaque = plaque_scene()
    return scene, presets.pcct(views=246), plaque.position


@pytest.fixture(scope="module")
def found(setup):
    return rod_values(*setup, materials(setup))


def materials(setup, *names):
    return {name: setup[0][name].material for name in names or setup[0].names}


@pytest.mark.extended
def test_ct_numbers_behind_the_patient(setup, found):
    """Material.hu behind the cylinder refers to water behind fat, FBP to water alone: a shift of
    a few HU."""
    scene, scanner, _ = setup
    energies, weights = scanner.weights()
    column = weights.shape[1] // 2
    behind = scanner.behind({MATERIALS["pericoronary_fat"]: 230.0}).sum(0)[column]
    assert behind.shape == energies.shape
    for body in scene.bodies:
        expected = MATERIALS[body.material].hu(energies, behind)
        assert 0 < found[body.name] - expected < (8 if body.name != "lumen" else 20), body.name
    core, fibrous = (
        MATERIALS[scene[name].material].hu(energies, behind) for name in ("core", "fibrous")
    )
    assert found["fibrous"] - found["core"] == pytest.approx(fibrous - core, abs=1.5)


@pytest.mark.extended
def test_neither_diameter_nor_views_matter(setup, found, monkeypatch):
    tissues = materials(setup, "core", "fibrous")
    monkeypatch.setattr(plaque_scan, "_ROD_VIEWS", 30)
    fewer = rod_values(*setup, tissues)
    monkeypatch.setattr(plaque_scan, "_ROD_MM", 6.0)
    thick = rod_values(*setup, tissues)
    for name in tissues:
        assert thick[name] == pytest.approx(found[name], abs=0.1)
        assert fewer[name] == pytest.approx(found[name], abs=0.05)


@pytest.mark.extended
def test_blood_hardens_its_own_beam(setup, found, monkeypatch):
    monkeypatch.setattr(plaque_scan, "_ROD_MM", 6.0)
    thick = rod_values(*setup, materials(setup, "lumen"))
    assert -4.0 < thick["lumen"] - found["lumen"] < -1.5


def test_another_material(setup):
    own = rod_values(*setup, {"own": MATERIALS["fibrous_tissue"], "core": "necrotic_core"})
    known = rod_values(*setup, materials(setup, "fibrous", "core"))
    assert own == pytest.approx({"own": known["fibrous"], "core": known["core"]})


def test_refusals(setup):
    with pytest.raises(ValueError, match="leaves its parent"):
        rod_values(setup[0], setup[1], (119.0, 0.0), {"core": "necrotic_core"})
    with pytest.raises(ValueError, match="unknown material"):
        rod_values(*setup, {"x": "cheese"})
