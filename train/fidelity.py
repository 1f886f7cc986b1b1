"""The curve of the fidelity: ``python -m train.fidelity WEIGHTS`` measures weights on held-out plaques, fidelity by
fidelity.

Figures are those of :meth:`train.objective.Objective.validate`; with a seed other than the run's the plaques took no
part in choosing the checkpoint. Figures move by some 10 % from one seed's eight plaques to the next: compare weights on
the same seeds.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from recon.mbir.mbir import WEIGHTS_FORMAT
from recon.mbir.weights_io import read_tensors
from train.__main__ import build
from train.config import TrainConfig, load_config, packaged_config
from train.objective import Validation

__all__ = ["fidelity_table", "main"]

_COLUMNS = {
    "fat SD": "fat_hu", "RMSE": "rmse_hu", "slope": "slope", "SD": "sd_hu", "slope, lesion": "lesion_slope",
    "lesion": "lesion", "no core": "false_hu", "no core, lesion": "false_lesion_hu",
}  # fmt: skip


def fidelity_table(rows: Sequence[tuple[float, Validation]], exposures: Sequence[float]) -> str:
    """Markdown: a row for every fidelity, in every cell the figure at each of the exposures."""
    head = ["fidelity", *_COLUMNS, "score"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for fidelity, found in rows:
        cells = [" / ".join(f"{found.figures[f'{key}_{e:g}s']:.3g}" for e in exposures) for key in _COLUMNS.values()]
        lines.append(f"| {fidelity:g} | " + " | ".join(cells) + f" | {found.score:.3f} |")
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m train.fidelity", description=__doc__.split("\n\n")[0])
    parser.add_argument("weights", type=Path, help="weights of a run, such as runs/mine/weights.safetensors")
    parser.add_argument("--config", type=Path, metavar="FILE", help="of the run (default: train/configs/default.yaml)")
    parser.add_argument("--fidelities", type=float, nargs="+", default=[0.0, 0.3, 0.5, 0.8, 1.0], metavar="L")
    parser.add_argument("--seeds", type=int, nargs="+", default=[5], metavar="N", help="of the plaques (default 5)")
    arguments = parser.parse_args(argv)
    logging.basicConfig(format="%(message)s")
    try:
        config: TrainConfig = load_config(arguments.config) if arguments.config else packaged_config("default")
        model, data, objective = build(config)
        model.load_state_dict(read_tensors(arguments.weights, WEIGHTS_FORMAT)[0])
        model.eval().requires_grad_(False)
        for seed in arguments.seeds:
            rows = [(fidelity, objective.validate(model, data, seed, fidelity)) for fidelity in arguments.fidelities]
            exposures = config.objective.validation_exposures_s
            print(f"Plaques of seed {seed}, {' / '.join(f'{e:g}' for e in exposures)} s, HU:\n")
            print(fidelity_table(rows, exposures) + "\n", flush=True)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
