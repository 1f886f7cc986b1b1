"""The curve of the fidelity."""

import pytest
from safetensors.torch import save_file

from train.config import packaged_config
from train.fidelity import fidelity_table, main
from train.objective import Validation


def test_a_row_for_every_fidelity():
    names = ("fat_hu", "rmse_hu", "slope", "sd_hu", "lesion_slope", "lesion", "false_hu", "false_lesion_hu")
    figures = {f"{name}_{e:g}s": k + e for k, name in enumerate(names) for e in (0.35, 2.0)}
    table = fidelity_table([(0.0, Validation(-5.0, figures)), (0.5, Validation(-4.0, figures))], (0.35, 2.0))
    lines = table.splitlines()
    assert len(lines) == 4
    assert lines[0].count("|") == lines[2].count("|") == 11
    assert lines[3].startswith("| 0.5 | 0.35 / 2 | 1.35 / 3 |")
    assert lines[3].endswith("| -4.000 |")


def test_what_cannot_be_measured_says_why(tmp_path, capsys):
    assert packaged_config("default").objective.validation_exposures_s == (0.35, 2.0)
    assert main([str(tmp_path / "missing.safetensors")]) == 1
    assert "missing.safetensors" in capsys.readouterr().err
    import torch

    save_file({"a": torch.zeros(1)}, tmp_path / "other.safetensors")
    assert main([str(tmp_path / "other.safetensors")]) == 1
    assert "other.safetensors" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([])
