"""How the limit with roughly known outlines hinges on the voxels that it is computed on.

    python tests/bench/shape_limit.py [--voxels 0.4 0.3 0.2] [--doses 0.35 2.0] [--out tests/bench/shape_limit.json]

`recon.limits.deformation_limit` writes what a displaced outline changes as HU of voxels. On large voxels outlines that
lie close together (the wall is 0.19 mm thick, the cap 0.17 mm) change the same voxels and cannot be told apart, so the
limit grows as voxels shrink, until they are small beside what the scan resolves. SD: of the contrast of the whole
lesion; factor: of its variance, soft FBP's (`notebooks/dose_factor`) over it. The file is written after every figure,
and keeps those of other voxels.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from recon.evaluate.store import Store
from recon.pwls.inset_problem import InsetProblem
from recon.study.dose_factor.scene import StudyScene
from recon.study.dose_factor.settings import FBP_BASE, Settings, fbp_label
from recon.study.dose_factor.shape_limit import DISPLACEMENTS_MM, contrast_sd
from recon.study.study import environment
from recon.study.verify import lookup
from torchpcct.files import written_whole

REPORT = Path("notebooks/dose_factor/report.json")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--voxels", type=float, nargs="+", default=[0.4, 0.3, 0.2], metavar="MM")
    parser.add_argument("--doses", type=float, nargs="+", default=[0.35, 2.0], metavar="S")
    parser.add_argument("--work", type=Path, help="folder that keeps the scan")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    options = parser.parse_args()
    report = json.loads(REPORT.read_text(encoding="utf-8"))
    rows: list[dict[str, Any]] = []
    if options.out.exists():
        rows = json.loads(options.out.read_text(encoding="utf-8"))["rows"]
    with TemporaryDirectory() as temporary:
        scene = StudyScene("paper", Settings(), Store(options.work or Path(temporary)))
        for voxel in options.voxels:
            problem = InsetProblem(scene.clean, scene.grid_of(voxel))
            rows = [row for row in rows if row["voxel_mm"] != voxel]
            for dose in options.doses:
                soft = f"methods[method=FBP {fbp_label(*FBP_BASE)},exposure_s={dose}]"
                fbp = lookup(report, f"{soft}/rois/tissue/corrected_sd_hu/value")
                for displacement in DISPLACEMENTS_MM[1:]:
                    sd = contrast_sd(scene, problem, dose, displacement)
                    rows.append({"voxel_mm": voxel, "exposure_s": dose, "displacement_mm": displacement,
                                 "contrast_sd_hu": sd, "factor": (fbp / sd) ** 2})  # fmt: skip
                    print(rows[-1], flush=True)
                    result = {"command": "python tests/bench/shape_limit.py", **environment(), "rows": rows}
                    with written_whole(options.out) as file:
                        file.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
