"""The record of a training: how the weights were made, with which settings, and how good they were.

What the weights are for and what they may not be trusted with is written by hand, in ``recon/mbir/weights/card.md``.
"""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import safetensors
import torch
from torch import Tensor

from recon.evaluate.report import filled
from recon.mbir.mbir import WEIGHTS_FORMAT
from recon.mbir.weights_io import digest, write_tensors
from recon.study.study import environment
from torchpcct.files import atomic_write
from train.config import TrainConfig

__all__ = ["export", "finite"]


def _cpu() -> str:
    """Model of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return (names or [platform.processor() or platform.machine()])[0]


def finite(value: Any) -> Any:
    """JSON values with the numbers that JSON does not know ('nan', 'inf') as text."""
    if isinstance(value, Mapping):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def export(folder: Path, weights: Mapping[str, Tensor], config: TrainConfig, state: Mapping[str, Any]) -> None:
    """Write ``weights.safetensors`` (float16), ``card.json`` and the same as text, ``training.md``.

    Args:
        folder: existing.
        weights: state of the model.
        config: of the run.
        state: fields of :class:`train.run.State` as of now; ``best`` describes the weights.
    """
    best = state["best"]
    # Half the bytes, and 0.05 % of a weight: no volume changes by a tenth of a HU.
    stored = {k: w.to(torch.float16) if k.startswith("network.") else w for k, w in weights.items()}
    versions = {**environment(), "safetensors": safetensors.__version__}
    system = f"{platform.system()} {versions.pop('machine')}"
    card = {
        "validation": {"score": best["score"], **best["figures"]},
        "step": best["step"],
        "steps_done": state["step"],
        "steps_skipped": state["skipped"],
        "seconds_to_these_weights": round(best["seconds"], 1),
        "seconds": round(state["seconds"], 1),
        "parameters": sum(w.numel() for w in weights.values()),
        "sha256_of_tensors": digest({k: w.to(weights[k].dtype) for k, w in stored.items()}),
        "seed": config.seed,
        "config": finite(config.as_dict()),
        "sessions": state["sessions"],
        "threads": state["machine"].get("threads"),
        "processes": state["machine"].get("processes"),
        "hardware": {"cpu": _cpu(), "cores": versions.pop("cores"), "system": system},
        "versions": versions,
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    # Enough to build the model that the weights belong to, without the card.
    header = {
        "network": card["config"]["network"],
        "unroll": config.unroll,
        "step": best["step"],
        "score": best["score"],
    }
    write_tensors(folder / "weights.safetensors", WEIGHTS_FORMAT, stored, header)
    record = filled(Path(__file__).parent / "templates" / "training.md.j2", {**card, "yaml": config.to_yaml()}) + "\n"
    texts = {"card.json": json.dumps(card, indent=2, ensure_ascii=False) + "\n", "training.md": record}
    for name, text in texts.items():
        with atomic_write(folder / name) as part:
            part.write_text(text, encoding="utf-8")
