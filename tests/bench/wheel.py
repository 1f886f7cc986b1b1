"""Build the source distribution, from it the wheel, and use the wheel in an empty environment.

``python tests/bench/wheel.py [PIP OPTION …]``

Nothing of the repository is on the path of that environment: what the wheel lacks (weights,
``py.typed``, a package, a dependency) fails here. Options go to ``pip install``, e.g.
``--extra-index-url https://download.pytorch.org/whl/cpu``.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
REQUIRES = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["build-system"][
    "requires"
]

SMOKE = """
import recon, torchpcct, train
from pathlib import Path
from recon.evaluate.rivals import tuned
from recon.evaluate.tasks import read_task
from recon.mbir.mbir import Mbir
from torchpcct import VolumeGrid, acquire
from torchpcct.scanner import presets
from torchpcct.scene.plaque import plaque_scene
for package in (recon, torchpcct, train):
    assert "site-packages" in package.__file__, package.__file__
for name in ("py.typed", "configs/default.yaml"):
    assert (Path(train.__file__).parent / name).exists(), name
Mbir.load()
assert read_task("nodule").title and tuned("bilateral", "detail", 2.0)
scene, plaque = plaque_scene(vessel_length=2.0)
grid = VolumeGrid((3, 12, 12), 0.5, plaque.position[::-1])
region = VolumeGrid((1, 1, 1), (2.2, 8.0, 8.0), plaque.position[::-1])
scan = acquire(scene, presets.pcct(views=60, rows=12), exposure_s=2.0, region=region, sub_rays=16)
volume = recon.reconstruct(scan, grid, "fbp")
volume.save("plaque.nii.gz")
scan.save("scan.h5")
print("reconstructed", tuple(volume.data.shape), f"{float(volume.data.mean()):.0f} HU on average")
"""


NETWORK = """
from torch import nn


class Mine(nn.Conv3d):
    def __init__(self):
        super().__init__(1, 1, 3, padding=1)

    def forward(self, estimate, towards, condition, smoothed):
        return smoothed + super().forward(towards[:, None])[:, 0]
"""
TRAINING = """
{network: nets:Mine, unroll: 1, steps: 20, batch: 2, validate_every: 20, objective: {held_out: 4},
 data: {scenes_kept: 8, views: 120, shape: [16, 16, 16], situations: [{x: 42.0, y: 0.0}]}}
"""


def build(folder: Path) -> Path:
    """The source distribution of what git knows (an old ``build`` folder would add modules that are
    gone), and the wheel that is built from it, as installing the source distribution would do; both
    in ``folder``."""
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    for name in (name for name in listed.splitlines() if (ROOT / name).is_file()):
        (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / "source" / name)
    venv.create(folder / "builder", with_pip=True)
    python = folder / "builder" / ("Scripts" if os.name == "nt" else "bin") / "python"
    subprocess.run([python, "-m", "pip", "install", "-q", *REQUIRES], cwd=folder, check=True)
    sdist = f"from setuptools import build_meta; build_meta.build_sdist({str(folder)!r})"
    subprocess.run(
        [python, "-c", sdist], cwd=folder / "source", stdout=subprocess.DEVNULL, check=True
    )
    (archive,) = folder.glob("*.tar.gz")
    command = [python, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder), str(archive)]
    subprocess.run(command, cwd=folder, check=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def main(options: list[str]) -> int:
    """0 if the wheel works in an empty environment."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}

    def run(*command: object, folder: Path) -> None:
        subprocess.run([str(part) for part in command], cwd=folder, env=clean, check=True)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        wheel = build(folder)
        venv.create(folder / "empty", with_pip=True)
        scripts = folder / "empty" / ("Scripts" if os.name == "nt" else "bin")
        python = scripts / "python"
        run(
            python,
            "-m",
            "pip",
            "install",
            "-q",
            "-c",
            ROOT / "constraints.txt",
            *options,
            wheel,
            folder=folder,
        )
        run(scripts / "torchpcct", "--version", folder=folder)
        run(
            scripts / "torchpcct",
            "study",
            "phantom",
            "--quick",
            "--no-progress",
            "--out",
            "out",
            folder=folder,
        )
        run(python, "-c", SMOKE, folder=folder)
        run(scripts / "torchpcct", "info", "scan.h5", folder=folder)
        (folder / "nets.py").write_text(NETWORK, encoding="utf-8")
        (folder / "mine.yaml").write_text(TRAINING, encoding="utf-8")
        # A network of a user's own, in the folder where the command is run.
        run(
            scripts / "torchpcct",
            "train",
            "--config",
            "mine.yaml",
            "--out",
            "own",
            "--no-progress",
            "--no-tensorboard",
            folder=folder,
        )
    print("the wheel, built from the source distribution, works in an empty environment")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
