"""The configuration of a run and its YAML form."""

from dataclasses import replace

import pytest

from train.config import TrainConfig, differences, load_config, packaged_config


def test_round_trip(tmp_path):
    config = TrainConfig(
        steps=7, clip=float("inf"), network={"channels": [4, 6, 8]}, learning_rate=1e-5
    )
    assert TrainConfig.from_yaml(config.to_yaml()).to_yaml() == config.to_yaml()
    assert TrainConfig.from_yaml(config.to_yaml()) == config
    (tmp_path / "c.yaml").write_text(config.to_yaml())
    assert load_config(tmp_path / "c.yaml") == config
    assert TrainConfig.from_yaml("") == TrainConfig()
    assert TrainConfig.from_yaml("learning_rate: 1e-3").learning_rate == 1e-3
    assert differences(config.as_dict(), replace(config, seed=3).as_dict()) == ["seed"]


def test_sections_from_plain_values():
    text = "data: {shape: [8, 9, 10], situations: [{x: 1, y: 2}]}\nobjective: {held_out: 5}"
    config = TrainConfig.from_yaml(text)
    assert config.data.shape == (8, 9, 10)
    assert config.data.situations[0].patient_mm == 240.0
    assert config.objective.held_out == 5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stepps: 3", "unknown key 'stepps'"),
        ("optimiser: lion", "optimiser must be adam or soap, got 'lion'"),
        ("optimiser: [soap]", r"optimiser must be adam or soap, got \['soap'\]"),
        ("network: {channels: [4, 6, 8], filters: 3}", r"unknown key 'network\.filters'"),
        ("data: {nonsense: 1}", r"unknown key 'data\.nonsense'"),
        ("data: {scenes: {nonsense: 1}}", r"data: unknown key 'scenes\.nonsense'"),
        ("data: {situations: [{x: 1}]}", r"data: situations\[0\]: .*'y'"),
        ("data: {shape: [8, 9]}", "data: shape must be 3 numbers"),
        ("data: {shape: [8, 9, 0]}", r"data: shape\[2\] must be at least 1"),
        ("data: {exposure_s: [2, 1]}", "data: exposure_s must be a range"),
        ("data: {situations: []}", "data: situations must name"),
        ("objective: {nonsense: 1}", r"unknown key 'objective\.nonsense'"),
        (
            "objective: {contrast_bias: [-1, 0]}",
            "objective: contrast_bias must be two weights of at least 0",
        ),
        ("objective: {fidelities: [0.5, 1.5]}", "objective: fidelities must be a range within"),
        ("objective: {held_out: 1}", "objective: held_out must be at least 2"),
        ("network: {channels: [8, 8]}", "network: channels must name 3 levels"),
        ("steps: 3.5", "steps must be a whole number"),
        ("steps: true", "steps must be a whole number"),
        ("steps: 0", "steps must be at least 1"),
        ("learning_rate: fast", "learning_rate must be a number"),
        ("learning_rate: .nan", "learning_rate must be finite"),
        ("checkpoint_seconds: 121", "checkpoint_seconds must be at most 120"),
        ("ema: 1.0", "ema must be less than 1"),
        ("final_fraction: 2", "final_fraction must lie in"),
        ("network: 3", "network must be a mapping"),
        ("single: 1.5", "single must lie in"),
        ("bfloat16: 1", "bfloat16 must be true or false"),
        ("data: {scenes_kept: 0}", "data: scenes_kept must be at least 1"),
        (
            "batch: 4\ndata: {scenes_kept: 6, situations: [{x: 1, y: 2}, {x: 2, y: 1}]}",
            r"data\.scenes_kept must be at least 7, got 6: .* one of the 2 situations",
        ),
        (
            "late: {begins: 0.5, scenes_kept: 3}\nbatch: 4\ndata: {situations: [{x: 1, y: 2}]}",
            r"late\.scenes_kept must be at least 4, got 3",
        ),
        (
            "objective: {held_out: 6}\ndata: {situations: [{x: 1, y: 2}, {x: 2, y: 1}]}",
            r"objective\.held_out must be at least 7, got 6",
        ),
        ("decay: 1.5", "decay must lie in"),
        ("network: {gate: true}", "network: gate needs the filtered view"),
        ("network: {channels: 5}", "network: channels must name 3 levels, got 5"),
        ("network: {channels: [8, 8, 1000000]}", "channels must be at most 16384"),
        ("network: {voxel_mm: true}", "network: voxel_mm must be a number, got True"),
        ("learning_rate: true", "learning_rate must be a number, got True"),
        ("learning_rate: 1e300", "learning_rate must be at most 10"),
        ("seed: 99999999999999999999", "seed must be at most"),
        ("unroll: 100000", "unroll must be at most 1000"),
        ("steps: 10000000000", "steps must be at most"),
        ("data: {shape: 5}", r"data: shape must be 3 numbers \(z, y, x\), got 5"),
        ("data: {shape: [4000, 8, 8]}", r"data: shape\[0\] must be at most 1024"),
        ("data: {situations: 5}", "data: situations must be a list of places"),
        ("data: {situations: {x: 1, y: 2}}", "data: situations must be a list of places"),
        ("data: {situations: [{x: 420, y: 0}]}", r"situations\[0\]: x and y must be .* 120 mm"),
        ("data: {situations: [{x: true, y: 0}]}", r"situations\[0\]: x must be a number"),
        ("data: {roi_margin: 9}", "data: roi_margin must be at most 8"),
        ("late: {roi_margin: 0.5}", "late: roi_margin must be a whole number"),
        ("data: {scenes: {fat: 5}}", "data: scenes: fat must be 2 numbers, got 5"),
        ("data: {scenes: {fat: [5, 1]}}", "scenes: fat must be a range, the lower end first"),
        ("data: {scenes: {fat: [.nan, 1]}}", r"scenes: fat\[0\] must be finite"),
        ("data: {scenes: {diameter: [-2, 5]}}", r"scenes: diameter\[0\] must be greater than 0"),
        ("data: {scenes: {blur: [-2, 5]}}", r"scenes: blur\[0\] must be at least 0"),
        ("data: {scenes: {muscle_probability: 15}}", r"muscle_probability must lie in \[0, 1\]"),
        ("data: {scenes: {touching: true}}", "scenes: touching must be a number, got True"),
        ("data: {scenes: {tilt: steep}}", "scenes: tilt must be a number in °, got 'steep'"),
        ("data: {scenes: {free_count: [2.5, 6]}}", r"free_count\[0\] must be a whole number"),
        ("data: {scenes: {free_count: [6, 2]}}", "free_count must be a range"),
        ("data: {scenes: {core_counts: [0, 0]}}", "core_counts must hold a frequency above 0"),
        ("late: {scenes: {fat: 5}}", "late: scenes: fat must be 2 numbers"),
        ("looks: [0, 1]", "unknown key 'looks'"),
        ("objective: {looks: [0, 1], fidelities: [0, 1]}", "looks is the former name of fidelit"),
        ("objective: {image: 0}", "objective: image must be greater than 0"),
        ("objective: {relative: 30, image: 30}", "relative is the former name of image"),
        (
            "objective: {relative: 30, lesion_bias: [0, -6]}",
            "lesion_bias must be two weights of at least 0",
        ),
        ("base: nosuch", "base must be one of default, quick, short, got 'nosuch'"),
        ("base: [default]", "base must be one of"),
        ("base: default\nlate: {begin: 0.5}", "unknown key 'late.begin'"),
        ("- 3", "mapping"),
        ("a: [", "not YAML"),
    ],
)
def test_bad_values_name_the_key(text, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        TrainConfig.from_yaml(text)
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"bad\.yaml"):
        load_config(tmp_path / "bad.yaml")


def test_a_base_is_changed_key_by_key_in_its_sections_and_as_a_whole_elsewhere():
    base = packaged_config("default")
    changed = TrainConfig.from_yaml(
        "base: default\nsteps: 100\ndata: {views: 246}\nnetwork: mylab.nets:Net\n"
        "late: {scenes: {tilt: 10}}"
    )
    assert differences(base.as_dict(), changed.as_dict()) == sorted(
        [
            "steps",
            "data.views",
            "late.scenes.tilt",
            "network.class",
            *(f"network.{key}" for key in base.network),
            *(f"late.scenes.{key}" for key in base.late.scenes),
        ]
    )
    assert changed.network == {"class": "mylab.nets:Net"}
    assert TrainConfig.from_yaml("base: default") == base


def test_packaged():
    assert packaged_config("default").steps > packaged_config("quick").steps
    assert packaged_config("default").network["bilateral"]
