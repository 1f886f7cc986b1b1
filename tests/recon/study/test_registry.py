"""Checks, effects, and what the registry promises of every study; see also :mod:`tiny_studies`."""

import math
from dataclasses import FrozenInstanceError, fields

import jinja2
import pytest
from refusals import refused
from tiny_studies import TINY

from recon.evaluate.report import templates
from recon.study import registry
from recon.study.hardcases.cases import CASES
from recon.study.names import case_names, setting_names
from recon.study.report import TEMPLATES, Check, around


def test_a_check_is_inside_its_closed_range_only():
    assert around("x", 1.25, 1.0, 0.25).ok
    assert not around("x", 1.2501, 1.0, 0.25).ok
    assert Check("open", 1e9, "any", low=0.0).ok
    assert not Check("undetermined", math.nan, 1.0).ok


def test_checks_as_json_values_and_as_text():
    checks = [
        around("size, mm", 1.97, 1.97, 0.02),
        Check("dice", 0.2, "visible", low=0.5, note="noise"),
    ]
    assert checks[1].as_dict() == {
        "name": "dice",
        "ours": 0.2,
        "paper": "visible",
        "low": 0.5,
        "high": None,
        "note": "noise",
        "ok": False,
    }
    found = [c.as_dict() for c in checks]
    text = rendered("{{ parts.checks(found) }}", found=found)
    assert "1 of 2 checks" in text
    assert "size, mm" in text
    assert "≥ 0.5" in text
    assert "size, mm" not in rendered("{{ parts.checks(found, every=false) }}", found=found)
    assert "not found" in rendered(
        "{{ parts.checks(found) }}", found=[Check("x", math.nan, 1.0).as_dict()]
    )


def test_effects_say_what_is_modelled():
    effects = [
        {"name": "focal spot", "modelled": True, "cost_hu": 3.14159, "note": ""},
        {"name": "scatter", "modelled": False, "cost_hu": None, "note": "grid"},
    ]
    text = rendered("{{ parts.effects(effects, 0.5) }}", effects=effects)
    assert "3.14" in text
    assert "not estimated" in text
    assert "less than 0.5 HU" in text


def rendered(text, **data):
    """A template with what reports share."""
    return (
        templates(TEMPLATES)
        .from_string('{% import "parts.md.j2" as parts %}' + text)
        .render(**data)
    )


def test_a_missing_value_is_an_error_and_no_gap():
    with pytest.raises(jinja2.UndefinedError, match="seconds"):
        rendered("{{ parts.time(seconds) }}")


COUNTS = {
    "compare": "views",
    "detector": "photons",
    "bowtie": "views",
    "hardcases": "views",
    "motion": "thinning",
    "noise": "views",
    "paths": "vessels",
    "phantom": "sections",
    "recovery": "places",
    "resolution": "thinning",
    "spectral": "views",
}
"""Study → a field that counts something."""


@pytest.mark.parametrize("name", registry.STUDIES)
def test_settings_of_every_study(name):
    """Valid as they are, as a first look and at the smallest scale; nonsense is refused by its
    name."""
    full, quick = (registry.build_settings(name, quick=q, seed=3) for q in (False, True))
    assert full != quick
    kind = type(full)
    assert kind(**TINY[name]) != quick
    known = {f.name for f in fields(kind)}
    assert set(TINY[name]) <= known
    assert set(kind.QUICK) <= known
    if "seed" in known:
        assert full.seed == quick.seed == 3
        refused(
            ("seed", lambda: registry.build_settings(name, seed=-1)),
            ("seed", lambda: registry.build_settings(name, changes=["seed=two"])),
        )
    other = registry.build_settings("compare" if name != "compare" else "noise")
    refused(
        (COUNTS[name], lambda: kind(**{COUNTS[name]: 0})),
        (COUNTS[name], lambda: kind(**{COUNTS[name]: 48.5})),
        (
            "nonsense=1.*: give field=value",
            lambda: registry.build_settings(name, changes=["nonsense=1"]),
        ),
        ("=.*: give field=value", lambda: registry.build_settings(name, changes=["="])),
        ("views.*: give field=value", lambda: registry.build_settings(name, changes=["views"])),
        ("settings must be", lambda: registry.run(name, other)),
    )
    with pytest.raises(FrozenInstanceError):
        setattr(full, COUNTS[name], 9)


BAD = {
    "compare": [({"n": 7}, "n must be at least 8"), ({"methods": ()}, "at least one method")],
    "phantom": [({"voxel_mm": 0.5}, "voxel_mm"), ({"energies_kev": (10.0,)}, "energies_kev")],
    "detector": [
        ({"photons": 10}, "photons"),
        ({"dead_times_ns": ()}, "dead_times"),
        ({"charge_sharing": (0.0,)}, "charge_sharing"),
    ],
    "bowtie": [
        ({"views": 4}, "views"),
        ({"realisations": 1}, "realisations"),
        ({"histories": 10}, "histories"),
        ({"exposure_s": 0.0}, "exposure_s"),
        ({"map_mm": math.nan}, "map_mm"),
        ({"plaque_doses": ()}, "plaque_doses"),
        ({"plaque_realisations": 7}, "plaque_realisations"),
        ({"detector": "film"}, "detector"),
    ],
    "hardcases": [
        ({"cases": ("x",)}, "unknown case 'x'"),
        ({"methods": "fbp"}, "methods must be one name or more"),
    ],
    "motion": [
        ({"voxel_mm": 0.0}, "voxel_mm"),
        ({"fractions": (0.4, 0.2)}, "fractions must rise"),
        ({"fractions": ()}, "at least one"),
        ({"errors": (1.5,)}, "errors must rise"),
        ({"methods": ("pwls",)}, "must hold fbp"),
        ({"methods": ("fbp", "tv")}, "must hold fbp"),
    ],
    "noise": [
        ({"realisations": 9}, "realisations"),
        ({"views": 4}, "views"),
        ({"doses": {"1x": 1.0}}, "two exposures"),
        ({"kernels": ("soft",), "voxels_mm": (0.2,)}, "two settings"),
        ({"experiments": 1}, "experiments"),
        ({"reconstructed": 0}, "reconstructed"),
    ],
    "paths": [
        ({"kinds": ()}, "at least one each"),
        ({"kinds": ("a spiral",)}, "a spiral"),
        ({"exposures_s": (0.0,)}, "exposures_s"),
        ({"views": 40}, "views"),
    ],
    "recovery": [
        ({"balls": ()}, "at least one each"),
        ({"balls": ((1.0, 0.0),)}, "contrast_hu"),
        ({"voxel_mm": 0.0}, "voxel_mm"),
        ({"exposures_s": (0.0,)}, "exposures_s"),
        ({"methods": ("fbp:sofd",)}, "sofd"),
    ],
    "resolution": [
        ({"sigmas_px": (1.0, 2.0, 3.0)}, "rise from 0"),
        ({"sigmas_px": (0.0, 2.0, 1.0)}, "rise from 0"),
        ({"tolerance": 1.5}, "tolerance"),
        ({"exposure_s": 0.0}, "exposure_s"),
    ],
    "spectral": [
        ({"exposure_s": 0.0}, "exposure_s"),
        ({"realisations": 0}, "realisations"),
        ({"views": 10}, "views"),
        ({"mbir_realisations": 9}, "mbir_realisations"),
        ({"noise_levels": (0.25, 1.0)}, "ascend from 0"),
        ({"noise_levels": (0.0, 1.0, 0.5)}, "ascend from 0"),
        ({"calibration_views": 8}, "calibration_views"),
        ({"transport_photons": 10}, "transport_photons"),
        ({"threshold_error_kev": 9.0}, "threshold_error_kev"),
    ],
}
"""Study → changes of its settings that it refuses, and in which words."""


@pytest.mark.parametrize(
    ("name", "change", "match"), [(n, *case) for n, cases in BAD.items() for case in cases]
)
def test_bad_settings(name, change, match):
    with pytest.raises(ValueError, match=match):
        registry.settings_class(name)(**change)


def test_changes_from_the_command_line():
    settings = registry.build_settings(
        "compare", quick=True, changes=["views=96", "methods=['fbp:bone']"]
    )
    assert (settings.views, settings.methods) == (96, ("fbp:bone",))


def test_names_that_are_known_unloaded_are_those_that_there_are():
    for name in registry.STUDIES:
        kind = registry.settings_class(name)
        assert setting_names(registry.folder(name)) == tuple(f.name for f in fields(kind) if f.init)
    assert case_names() == tuple(CASES)


def test_names():
    assert set(TINY) == set(COUNTS) == set(registry.STUDIES)
    assert registry.part("dose") is registry.part("bowtie")  # its published name
    with pytest.raises(ValueError, match="unknown study 'x'"):
        registry.build_settings("x")
