"""MBIR with the tissues of a vessel: what a tissue is made of is pooled over the tissue, not over a neighbourhood.

The vessel's outlines and tissue values are fitted to the data (:mod:`recon.plaque`), with a plaque's core and without.
With P the probability that the core is there, and x₀ the plain reconstruction, the tissues' image is

    T = P · (with the core) + (1 − P) · (without it, but in its fibrous layer x₀)

and the network reconstructs what T leaves of the data: u = T + MBIR(β − H T). So outlines are sharp, and a proven core
has its full contrast. The less a core is proven, the more the plain reconstruction stands in the layer; in between the
contrast is shrunk, as a mean over two explanations is. (A core that is drawn from P = .95 on and not before is shrunk
less at 0.35 s, but jumps between two pictures: in 100 draws of the paper's plaque at 2.0 s the contrast's SD is 23
instead of 20 HU, and d′ is worth 1.48 instead of 1.81 times the dose.) What the model does not have (a branch, muscle,
texture) comes from the data as ever, and the low frequencies are the data's own in both parts.

A vessel that the model does not fit (its residual exceeds what noise leaves) is left to the plain reconstruction.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from recon.mbir.mbir import Mbir, Solution
from recon.plaque.data import TissueData
from recon.plaque.reading import PlaqueReading, read_plaque
from recon.plaque.vessel_prior import VesselPrior
from recon.pwls.inset_problem import InsetProblem
from torchpcct.validate import numbers

__all__ = ["TissueMbir"]


class TissueMbir(Mbir):
    """:class:`recon.mbir.mbir.Mbir` with tissues.

    Not differentiable: the fit of the tissues is not unrolled.

    Args:
        network: gives weights, look and parts.
        point: ``(z, y, x)`` mm where a reader sees the plaque; None: in the largest vessel.
        seed: of the reading's Monte Carlo.
        vessel_prior: what is believed of the vessel before the data; None: what a reading believes, a coronary artery.

    Raises:
        ValueError, TypeError: a point that is not three finite numbers.
    """

    def __init__(
        self, network: Mbir, point: Any = None, seed: int = 0, vessel_prior: VesselPrior | None = None
    ) -> None:
        super().__init__(network.model, network.look, **network.parts)
        self.point = None if point is None else numbers("point", point, 3, unit="mm")
        self.seed, self.vessel_prior = seed, vessel_prior

    @torch.no_grad()
    def solved(self, problem: InsetProblem, b: Tensor, exposure_s: float) -> Solution:
        """See :meth:`recon.mbir.mbir.Mbir.solved`; the notes hold ``tissues``: what was read, or why not."""
        plain = super().solved(problem, b, exposure_s)
        normal, u = plain.normal, plain.u.clone()
        volumes = self.in_hu(problem, u, normal)
        notes: list[dict[str, Any]] = []
        for k in range(b.shape[0]):
            try:
                data = TissueData.of_statistic(b[k], problem, exposure_s)
                reading = read_plaque(data, self.point, vessel_prior=self.vessel_prior, seed=self.seed)
            except ValueError as error:
                notes.append(_unused(f"no tissues were fitted: {error}"))
                continue
            if reading.warnings:
                notes.append(_unused(f"the fitted tissues were not used: {reading.warnings[0]}"))
                continue
            it = slice(k, k + 1)
            one = replace(normal, beta=normal.beta[it], scale_hu=normal.scale_hu[it], factor=normal.factor[it])
            drawn = self.in_noise_units(problem, _tissues(reading, volumes[k])[None], one)
            left = replace(one, beta=one.beta - one.apply(drawn))
            u[k] = (drawn + self.model(left, self.look, **self.parts))[0]
            notes.append({"tissues": {"used": True, "presence": reading.presence, "chi2": reading.chi2,
                                      "calcifications": reading.calcifications}})  # fmt: skip
        return Solution(normal, u, notes)


def _unused(why: str) -> dict[str, Any]:
    return {"tissues": {"used": False, "why": why}, "warnings": [f"{why}; this is the reconstruction without them"]}


def _tissues(reading: PlaqueReading, plain: Tensor) -> Tensor:
    """T of a reading, HU ``(z, y, x)``; ``plain`` is the reconstruction without tissues."""
    with_core, without, layer = (
        torch.from_numpy(v).to(plain) for v in (reading.image, reading.image_without, reading.layer)
    )
    open_to = without + layer * (plain - without)
    return reading.presence * with_core + (1.0 - reading.presence) * open_to
