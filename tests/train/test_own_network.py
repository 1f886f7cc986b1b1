"""Training a network of a user's own, which the configuration names: the code of the how-to, and
what is refused."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from fresh_python import run_python
from torch import nn

from recon.mbir.mbir import Mbir
from recon.mbir.priors import network_of
from recon.mbir.unrolled import Unrolled
from recon.mbir.weights_io import read_tensors
from train import __main__ as command_line
from train.checkpoint import CheckpointStore
from train.config import TrainConfig
from train.run import export

HOW_TO = Path(__file__).parents[2] / "notebooks" / "docs" / "howto" / "own_prior.md"


def block(title):
    """The code of the how-to that begins with a comment."""
    (found,) = re.findall(
        rf"```\w+\n# {re.escape(title)}\n(.*?)```", HOW_TO.read_text(encoding="utf-8"), re.DOTALL
    )
    return found


@pytest.fixture
def nets(tmp_path, monkeypatch):
    """A module of a user's own with the network of the how-to and others; it has not been
    imported."""
    others = (
        "\nclass Counting(MyNet):\n    def __init__(self, width=16):\n        "
        "super().__init__(width)\n"
        "        self.register_buffer('seen', torch.tensor(100_003))\n"
        "\nclass Filter(nn.Module):\n    def forward(self, estimate, towards, condition, "
        "smoothed):\n"
        "        return smoothed\n"
        "\nclass Denoiser(nn.Conv3d):\n    def __init__(self):\n        super().__init__(1, 1, 1)\n"
        "    def forward(self, volume, sigma):\n        return volume\n"
        "\nclass Channel(MyNet):\n    def forward(self, estimate, towards, condition, smoothed):\n"
        "        return self.layers(torch.stack([estimate, towards, smoothed], 1))\n"
        "\nclass Other(MyNet):\n    def forward(self, estimate, towards, condition, smoothed):\n"
        "        return self.layers(torch.stack([estimate, towards], 1))[:, 0]\n"
    )
    name = f"nets_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(block("mylab/nets.py") + others, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    yield name
    sys.modules.pop(name, None)


def test_a_network_is_named_alone_or_with_its_arguments():
    alone, mapped = (
        TrainConfig.from_yaml(f"network: {text}")
        for text in ("no.such:Net", "{class: no.such:Net}")
    )
    assert alone == mapped
    assert alone.network == {"class": "no.such:Net"}
    given = TrainConfig.from_yaml("network: {class: no.such:Net.Inner, width: 3, deep: [1, 2]}")
    assert given.network == {"class": "no.such:Net.Inner", "width": 3, "deep": [1, 2]}
    assert TrainConfig.from_yaml(given.to_yaml()) == given
    for text, message in (
        ("{class: 3}", "network.class must be package.module:Class, got 3"),
        ("nets", "network.class must be package.module:Class, got 'nets'"),
        ("{class: no.such:Net, a b: 1}", "'a b' names no argument of no.such:Net"),
        ("[8, 8, 8]", "network must be a mapping"),
    ):
        with pytest.raises(ValueError, match=message):
            TrainConfig.from_yaml(f"network: {text}")


@pytest.mark.parametrize(
    ("network", "text"),
    [
        ("no.such:Net", "cannot load 'no.such:Net': No module named"),
        ("NETS:Nothing", "cannot load 'NETS:Nothing'"),
        (
            "{class: NETS:MyNet, wide: 3}",
            "MyNet cannot be made with wide=3: .*unexpected keyword argument 'wide'",
        ),
        ("NETS:Filter", "NETS:Filter has no parameters that a training could change"),
        (
            "NETS:Denoiser",
            r"NETS:Denoiser is a denoiser: one to be trained takes \(estimate, towards",
        ),
        ("{class: builtins:dict}", "dict must make a torch.nn.Module"),
        (
            "NETS:Channel",
            r"the prior Channel returned the shape \(2, 1, 40, 32, 32\) for \(2, 40, 32, 32\)",
        ),
        (
            "NETS:Other",
            r"NETS:Other must take \(estimate, .* volumes of \(2, 40, 32, 32\): .*channels",
        ),
    ],
)
def test_what_cannot_be_trained_is_named(nets, tmp_path, network, text):
    config = TrainConfig.from_yaml(f"network: {network}".replace("NETS", nets))
    with pytest.raises((ValueError, TypeError), match=text.replace("NETS", nets)):
        command_line.build(config, tmp_path / "views")


def test_the_packages_network_starts_as_ever(tmp_path):
    """``network: {channels: …}`` gives the weights that it always gave, and the precision of the
    configuration."""
    config = TrainConfig.from_yaml(
        "{seed: 3, unroll: 1, network: {channels: [4, 4, 4], bilateral: true}}"
    )
    model = command_line.build(config, tmp_path / "views")[0]
    torch.manual_seed(3)
    first = nn.Conv3d(24, 4, 3, bias=False).weight
    nn.init.kaiming_normal_(first, a=0.1)
    assert torch.equal(model.network.enter.weight, first)
    assert model.network.half_precision == torch.ops.mkldnn._is_mkldnn_bf16_supported()


def test_weights_keep_the_class_and_every_digit(nets, tmp_path):
    """Other networks may hold counts and values beyond float16; the voxels are those of the
    training's data."""
    values = {"class": f"{nets}:Counting", "width": 2}
    config = TrainConfig(network=values, unroll=1, data={"voxel_mm": 0.4})
    model = Unrolled(network_of(values, f"{nets}:Counting"), 1, voxel_mm=0.4)
    nn.init.constant_(model.network.layers[0].bias, 1e6 + 0.5)
    best = {"score": 1.0, "step": 2, "seconds": 3.0, "figures": {}}
    state = {"best": best, "step": 2, "skipped": 0, "seconds": 3.0, "sessions": [], "machine": {}}
    export(tmp_path, model.state_dict(), config, state)
    path = tmp_path / "weights.safetensors"
    assert read_tensors(path, "torchpcct unrolled weights 2")[1]["network"] == values
    found = Mbir.load(path, network=f"{nets}:Counting")
    assert found.voxel_mm == 0.4
    assert int(found.model.network.seen) == 100_003
    assert found.weights_sha256 == Mbir(model).weights_sha256
    with pytest.raises(
        ValueError, match=r"they do not fit MyNet: network\.seen has the shape \(\) in the file"
    ):
        Mbir.load(path, network=f"{nets}:MyNet")


def test_a_checkpoint_alone_imports_nothing(nets, tmp_path, capsys):
    """--resume takes the checkpoint's configuration: a class in it is imported once named."""
    out = tmp_path / "run"
    out.mkdir()
    config = TrainConfig.from_yaml(f"network: {nets}:MyNet")
    CheckpointStore(out).save({}, {"config": config.to_yaml(), "state": {}})
    assert command_line.main(["--resume", "--out", str(out), "--no-progress"]) == 2
    said = capsys.readouterr().err
    assert f"trains {nets}:MyNet, which no file alone may import" in said
    assert f"--config {out}/config.yaml" in said
    assert nets not in sys.modules


@pytest.mark.extended
def test_the_network_of_the_how_to_is_trained_from_an_installed_package(tmp_path):
    """20 steps in an empty folder; then a volume by its weights, and by its denoiser."""
    package = tmp_path / "source"
    (package / "mylab").mkdir(parents=True)
    (package / "mylab" / "__init__.py").touch()
    (package / "mylab" / "nets.py").write_text(block("mylab/nets.py"), encoding="utf-8")
    (package / "pyproject.toml").write_text(
        '[build-system]\nrequires = ["setuptools"]\nbuild-backend = "setuptools.build_meta"\n'
        '[project]\nname = "mylab"\nversion = "1"\n[tool.setuptools]\npackages = ["mylab"]\n',
        encoding="utf-8",
    )
    site, here = tmp_path / "site", tmp_path / "elsewhere"
    install = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "-q",
        "--no-deps",
        "--no-build-isolation",
        "--target",
    ]
    subprocess.run([*install, str(site), str(package)], check=True, capture_output=True)
    here.mkdir()
    text = block("mine.yaml").replace("data: {", "data: {views: 120, shape: [16, 16, 16], ")
    (here / "mine.yaml").write_text(text, encoding="utf-8")
    code = f"""
import sys
sys.path.append({str(site)!r})
from recon.cli import main
sys.exit(main(sys.argv[1:]))
"""
    words = ["train", "--config", "mine.yaml", "--out", "own", "--no-progress", "--no-tensorboard"]
    done = run_python(code, *words, cwd=here)
    assert "20 steps in" in done.stdout
    again = run_python(
        code, "train", "--out", "own", "--resume", "--no-progress", cwd=here, check=False
    )
    assert again.returncode == 2
    assert "--config own/config.yaml" in again.stderr
    check = f"""
import sys
sys.path[:0] = [{str(site)!r}, {str(Path(__file__).parents[1] / "helpers")!r}]
from small_scan import CENTER, SCENE, scanner
from torchpcct import VolumeGrid, acquire
from recon import reconstruct
from recon.mbir.mbir import Mbir
grid = VolumeGrid((12, 16, 16), 0.2, CENTER)
scan = acquire(SCENE, scanner(), region=grid, duty=0.06, sub_rays=16).with_noise(2.0, 0)
trained = Mbir.load("own/weights.safetensors", network="mylab.nets:MyNet")
ours, filtered = (
    reconstruct(scan, grid, "mbir:weights=own/weights.safetensors,network=mylab.nets:MyNet"),
    reconstruct(scan, grid, "mbir:prior=mylab.nets:denoise"),
)
assert ours.report["weights_sha256"] == trained.weights_sha256
assert filtered.report["prior"] == "denoise"
untouched = reconstruct(scan, grid, "mbir", prior=lambda volume: volume)
noise = [float(v.data[:, :, :4].std()) for v in (ours, filtered, untouched)]
assert max(noise[:2]) < 0.8 * noise[2], noise
"""
    run_python(check, cwd=here)
