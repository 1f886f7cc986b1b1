"""A scanner of a user's own: the code of the how-to, the same in YAML, and what is refused."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from torchpcct.acquisition.config import configured, read_config
from torchpcct.acquisition.scanner_yaml import scanner_of
from torchpcct.scanner.detector import SiliconDetector
from torchpcct.scanner.source import Source

PAGE = Path(__file__).parents[3] / "notebooks" / "docs" / "howto" / "own_scanner.md"


def block(language):
    (found,) = re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    return found


@pytest.fixture(scope="module")
def values():
    return yaml.safe_load(block("yaml"))["scanner"]


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """What the how-to's code makes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("own_scanner"))
        found = {}
        exec(compile(block("python"), PAGE.name, "exec"), found)
        assert Path("jar.nii.gz").exists()
    return found


def test_the_code_of_the_how_to_shows_the_vial(names):
    volume = names["volume"]
    assert not volume.report["warnings"]
    middle = volume.data[1]
    water, vial = float(middle[60:90, 60:90].mean()), float(middle[73:77, 98:102].mean())
    assert water == pytest.approx(0.0, abs=15.0)
    assert 60.0 < vial - water < 400.0


def test_the_yaml_of_the_how_to_is_the_same_scanner(names, tmp_path):
    (tmp_path / "bench.yaml").write_text(block("yaml"), encoding="utf-8")
    config = read_config(tmp_path / "bench.yaml")
    ours, bench = config.scanner, names["bench"]
    np.testing.assert_allclose(ours.geometry.angles, bench.geometry.angles, rtol=1e-12)
    assert ours.replace(geometry=bench.geometry) == bench
    assert ours.geometry == replace(bench.geometry, angles=ours.geometry.angles)
    assert config.scene.names == ("jar", "vial")
    # What is written down beside a scan makes the same scanner again.
    assert configured(config.values, tmp_path).scanner == config.scanner


def test_a_counting_detector_a_spectrum_of_ones_own_and_a_bowtie(values, tmp_path):
    (tmp_path / "tube.txt").write_text("20 0\n40 10\n60 5\n", encoding="utf-8")
    own = {
        **values,
        "source": {"spectrum": "tube.txt", "current_ma": 3},
        "detector": {"kind": "silicon", "mode": "spectral", "thresholds_kev": [10, 30]},
        "bowtie": {"material": "pmma", "fan_angles_deg": [0, 10], "thickness_mm": [1, 20]},
    }
    made = scanner_of(own, tmp_path)
    assert made.source == Source.tabulated([20, 40, 60], [0, 10, 5], current_ma=3)
    assert made.detector == SiliconDetector("spectral", (10.0, 30.0))
    (bowtie,) = made.bowties
    np.testing.assert_allclose(bowtie.thickness(np.deg2rad([0, 10, 15])), [1, 20, 20])
    assert scanner_of({**values, "bowtie": "large"}).bowties[0].name == "large"
    assert not scanner_of({**values, "bowtie": "none"}).bowties


def changed(values, part, **changes):
    return {**values, part: {**values.get(part, {}), **changes}}


@pytest.mark.parametrize(
    ("part", "changes", "message"),
    [
        ("geometry", {"kind": "fan"}, "unknown in a fan geometry: rows"),
        ("geometry", {"pose": {"roll_deg": 1}}, "must be of kind cone, without pose"),
        (
            "detector",
            {"kind": "cdte"},
            "unknown scanner.detector.kind 'cdte': use one of silicon, scint",
        ),
        ("detector", {"deep_mm": 1}, "scanner.detector: unknown deep_mm; it takes material, depth"),
        ("source", {"kv": 80}, "scanner.source: unknown kv; it takes kvp"),
        ("source", {"filtration": {"unobtainium": 1}}, "unknown material 'unobtainium'"),
        ("filters", {"copper": -1}, "scanner.filters.copper must lie in [0, 1e+06] mm, got -1"),
        ("bowtie", {"material": "pmma"}, "scanner.bowtie needs fan_angles_deg, thickness_mm"),
        ("filters", {"copper": 1e300}, "scanner.filters.copper must lie in [0, 1e+06] mm"),
        ("source", {"current_ma": 1e300}, "current_ma must be at most 1e+09 mA"),
        ("source", {"output": 1e300}, "output must be at most 1e+09"),
        ("source", {"focal_spot": [400, 400]}, "focal_spot[0] must lie in [0, 100] mm, got 400"),
        ("geometry", {"pitch": 800}, "are columns, pitch, offset and sdd in one unit, mm?"),
    ],
)
def test_what_no_scanner_is_made_of_is_named(values, part, changes, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        scanner_of(changed(values, part, **changes))


@pytest.mark.parametrize(
    ("part", "changes", "message"),
    [
        ("source", {"current_ma": True}, "current_ma must be a number in mA, got True"),
        ("source", {"filtration": {"aluminium": True}}, "filtration.aluminium must be a number"),
        ("geometry", {"pitch": True}, "pitch must be a number in mm, got True"),
    ],
)
def test_true_and_false_are_no_numbers(values, part, changes, message):
    with pytest.raises(TypeError, match=re.escape(message)):
        scanner_of(changed(values, part, **changes))


def test_names_left_empty_and_a_single_threshold_are_meant(values):
    silicon = {"kind": "silicon", "thresholds_kev": 25}
    made = scanner_of({**values, "name": None, "detector": silicon})
    assert (made.name, made.detector.thresholds_kev) == ("own scanner", (25.0,))
    assert scanner_of({**values, "name": 7}).name == "7"
    with pytest.raises(ValueError, match=r"thresholds_kev must begin below the tube's .* 5000 keV"):
        scanner_of({**values, "detector": {**silicon, "thresholds_kev": [5000]}})
    with pytest.raises(TypeError, match=r"scanner\.name must be a text, got \['a'\]"):
        scanner_of({**values, "name": ["a"]})


def test_what_lacks_or_is_unknown_is_named(values, tmp_path):
    with pytest.raises(ValueError, match="scanner: unknown detectors; it takes name, geometry"):
        scanner_of({**values, "detectors": 1})
    with pytest.raises(ValueError, match="scanner needs detector; or preset: pcct, eid"):
        scanner_of({k: v for k, v in values.items() if k != "detector"})
    with pytest.raises(TypeError, match=r"scanner\.filters must be a mapping such as"):
        scanner_of({**values, "filters": [["copper", 0.2]]})
    with pytest.raises(ValueError, match=r"unknown scanner\.bowtie 'small': use"):
        scanner_of({**values, "bowtie": "small"})
    (tmp_path / "one.txt").write_text("20\n40\n", encoding="utf-8")
    with pytest.raises(ValueError, match="must hold two columns"):
        scanner_of({**values, "source": {"spectrum": "one.txt"}}, tmp_path)
