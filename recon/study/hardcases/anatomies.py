"""Disease that a prior for vessels may close, flatten or draw away: what each method shows of it,
beside soft FBP of the same scan.

Each anatomy of :data:`recon.evaluate.anatomies.ANATOMIES` is painted into the plaque's place, with
its feature and without it, and scanned with the same noise. The difference of the two volumes is
what a method shows of the feature: its mean over the voxels that the feature changes by more than
half of what it changes at most, over that of the truth, is the *recovery*. A method that recovers
less than soft FBP does, times :data:`LEAST_RECOVERY`, shows less than the data do, and has to say
so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.evaluate.anatomies import TISSUES_HU, Anatomy, anatomy
from recon.evaluate.tasks import with_painted, without_inset
from recon.jobs.execute import captured_warnings
from recon.jobs.store import StudyCache
from torchpcct.geometry import VolumeGrid
from torchpcct.metrics.recovery import recovered_contrast
from torchpcct.scan import Scan
from torchpcct.volume import Volume

LEAST_RECOVERY = 0.9
"""Share of what soft FBP recovers of a feature's contrast that a method may not fall below without
a word."""
METHODS = ("pwls", "mbir", "mbir:vessel")
"""``"mbir:vessel"``: MBIR with ``vessel=True``."""

Reconstruct = Callable[[Scan, VolumeGrid, str], Volume]


def anatomy_verdict(recovered: float | None, soft: float, messages: Sequence[str]) -> str:
    """``right``, ``warned`` (less than soft FBP shows, or refused, with a message) or ``SILENT``.

    Args:
        recovered: see :func:`torchpcct.metrics.recovery.recovered_contrast`; None: refused.
        soft: of soft FBP.
        messages: of the volume with the feature beside those of the volume without it, and what
            says that a vessel model was used.
    """
    if recovered is not None and recovered >= LEAST_RECOVERY * soft:
        return "right"
    return "warned" if messages else "SILENT"


def anatomy_rows(
    name: str,
    clean: Scan,
    grid: VolumeGrid,
    *,
    exposure_s: float,
    seed: int,
    draws: int,
    methods: Sequence[str],
    reconstruct: Reconstruct,
    kind: Callable[[str], str],
    cache: StudyCache,
) -> list[dict[str, object]]:
    """A row for each method, without noise and as the mean over draws of it: ``anatomy``,
    ``title``, ``method``, ``draws`` (0: without noise), ``recovered`` (None if refused), ``soft``,
    ``messages``, ``verdict``.

    Args:
        name: of the anatomy.
        clean: noise-free scan of the inset ``grid``, whose exterior is the patient.
        draws: of the noise, from ``seed`` on.
        methods: of :data:`METHODS`.
        reconstruct: by ``"soft"`` (FBP) or a method.
        kind: a warning without its figures.
        cache: for what is finished.
    """
    what, rows = anatomy(name), []
    with_it, without = (_scanned(what, clean, grid, feature=f) for f in (True, False))
    truth = torch.from_numpy(
        _painted(what, grid, grid, feature=True) - _painted(what, grid, grid, feature=False)
    ).float()
    realisations: list[tuple[int, list[tuple[Scan, Scan]]]] = [(0, [(with_it, without)])]
    if draws:
        seeds = range(seed, seed + draws)
        drawn = [
            (with_it.with_noise(exposure_s, k), without.with_noise(exposure_s, k)) for k in seeds
        ]
        realisations.append((draws, drawn))
    for number, pairs in realisations:

        def shown(
            method: str, pairs: Sequence[tuple[Scan, Scan]] = pairs
        ) -> tuple[float | None, list[str]]:
            return _recovered(pairs, grid, method, truth, reconstruct, kind)

        soft, refusal = cache(f"{name}_{number}_soft", partial(shown, "soft"))
        if soft is None:
            raise ValueError(f"soft FBP, the reference, refuses the anatomy {name}: {refusal[0]}")
        for method in methods:
            entry = f"{name}_{number}_{method.replace(':', '_')}"
            recovered, messages = cache(entry, partial(shown, method))
            rows.append(
                {
                    "anatomy": name,
                    "title": what.title,
                    "method": method,
                    "draws": number,
                    "recovered": recovered,
                    "soft": soft,
                    "messages": messages,
                    "verdict": anatomy_verdict(recovered, soft, messages),
                }
            )
    return rows


def _recovered(
    pairs: Sequence[tuple[Scan, Scan]],
    grid: VolumeGrid,
    method: str,
    truth: Tensor,
    reconstruct: Reconstruct,
    kind: Callable[[str], str],
) -> tuple[float | None, list[str]]:
    """Mean contrast recovery over pairs of scans, None if one is refused, and the messages."""
    found, unusual = [], []
    for pair in pairs:
        volumes, texts = [], []
        for scan in pair:
            with captured_warnings("recon", "torchpcct", alone=True) as messages:
                try:
                    volume = reconstruct(scan, grid, method)
                except (ValueError, TypeError) as error:
                    return None, [str(error)]
            volumes.append(volume.data)
            texts.append([*volume.report.get("warnings", []), *messages])
        usual = set(map(kind, texts[1]))
        # A vessel model names what it may leave out, whatever it shows.
        unusual += [t for t in texts[0] if kind(t) not in usual or "was used, and disease" in t]
        found.append(recovered_contrast(volumes[0] - volumes[1], truth))
    return float(np.mean(found)), list(dict.fromkeys(unusual))


def _scanned(what: Anatomy, clean: Scan, grid: VolumeGrid, *, feature: bool) -> Scan:
    """The noise-free scan of the patient with an anatomy in its inset."""
    return with_painted(
        without_inset(clean), grid, lambda fine: _painted(what, fine, grid, feature=feature)
    )


def _painted(
    what: Anatomy, fine: VolumeGrid, grid: VolumeGrid, *, feature: bool
) -> NDArray[np.float64]:
    """HU above fat, about the middle of ``grid``."""
    centre = tuple(a - b for a, b in zip(fine.center, grid.center, strict=True))
    above = {t: hu - TISSUES_HU["fat"] for t, hu in what.values.items()}
    return what.painted(replace(fine, center=centre), above, feature=feature)
