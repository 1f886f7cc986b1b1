"""MBIR around the outlines of a vessel: what is sharp and smooth is drawn, the network reconstructs the rest.

A network that sees some millimetres about a voxel has to find every piece of a vessel's outline by itself, in the noise
of that place. A contrast-enhanced vessel has two smooth outlines over its whole length (lumen and outer wall, a dozen
numbers a centimetre), so the data determine them far better (:mod:`recon.plaque.vessel`). With T the drawn vessel, in
whose fibrous layer the plain reconstruction x₀ stands,

    u = T + MBIR(β − H T),

so plaque, and whatever else the drawing lacks (a branch, muscle, texture), comes from the data as ever, beside an edge
that is no longer there to bleed into it.

Where no vessel is found, or a drawn one does not explain the data outside of its fibrous layer, the result is x₀.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from recon.least_squares.inset_problem import InsetProblem
from recon.mbir.mbir import Mbir, Solution
from recon.plaque.data import TissueData
from recon.plaque.quality import STRIKING, scores_of
from recon.plaque.reading import drawn_image, drawn_layer
from recon.plaque.start import find_vessel
from recon.plaque.vessel import Vessel
from recon.plaque.vessel_prior import VesselPrior

__all__ = ["Drawn", "OutlineMbir"]


@dataclass(frozen=True, eq=False)
class Drawn:
    """What is drawn of a scan.

    Attributes:
        image: T, HU ``(z, y, x)``, or None.
        note: for the volume's report.
        unexplained: the highest score (:func:`recon.plaque.quality.scores_of`) of what is left of the data, given the
            reconstruction, HU ``(z, y, x)``.
    """

    image: Tensor | None
    note: dict[str, Any]
    unexplained: Callable[[Tensor], float] = lambda volume: 0.0


class OutlineMbir(Mbir):
    """:class:`recon.mbir.mbir.Mbir` around the outlines of a vessel.

    The fit of the outlines is not differentiated, what the network makes of the rest is.

    Args:
        network: gives weights, fidelity and parts.
        vessel_prior: what is believed of the vessel before the data; None: a coronary artery.
    """

    def __init__(self, network: Mbir, vessel_prior: VesselPrior | None = None) -> None:
        super().__init__(network.model, network.fidelity, **network.parts)
        self.vessel_prior = vessel_prior

    def solved(self, problem: InsetProblem, b: Tensor, exposure_s: float) -> Solution:
        """See :meth:`recon.mbir.mbir.Mbir.solved`; the notes hold ``outlines``: whether they were drawn, or why not."""
        plain = super().solved(problem, b, exposure_s)
        volumes = self.in_hu(problem, plain.u, plain.normal)
        found = [self.drawn(problem, b[k], exposure_s, volumes[k]) for k in range(b.shape[0])]
        at = [k for k, one in enumerate(found) if one.image is not None]
        notes = [one.note for one in found]
        if not at:
            return replace(plain, notes=notes)
        normal = plain.normal
        some = replace(normal, beta=normal.beta[at], scale_hu=normal.scale_hu[at], factor=normal.factor[at])
        images = self.in_noise_units(
            problem, torch.stack([v for v in (one.image for one in found) if v is not None]), some
        )
        u = images + self.model(replace(some, beta=some.beta - some.apply(images)), self.fidelity, **self.parts)
        explained = []
        for j, (k, volume) in enumerate(zip(at, self.in_hu(problem, u.detach(), some), strict=True)):
            highest = found[k].unexplained(volume)
            if highest <= STRIKING:
                explained.append(j)
            else:
                notes[k] |= _unused(f"its outlines leave {highest:.0f} standard deviations of the noise unexplained")
        places = torch.tensor([at[j] for j in explained], dtype=torch.long)
        return Solution(normal, plain.u.index_copy(0, places, u[explained]), notes)

    def drawn(self, problem: InsetProblem, b: Tensor, exposure_s: float, plain: Tensor) -> Drawn:
        """What is drawn of one scan.

        Args:
            problem: of the scan.
            b: its statistic ``(z, y, x)``.
            exposure_s: of b.
            plain: x₀, HU ``(z, y, x)``.
        """
        data = TissueData.of_statistic(b.detach(), problem, exposure_s)
        try:
            # Many small matrices: BLAS threads would wait for each other.
            with threadpool_limits(limits=1, user_api="blas"):
                vessel = Vessel(data, find_vessel(data.pilot(), data.grid, None), self.vessel_prior)
                fit = vessel.fit(vessel.first_guess(), expected=True)
        except (ValueError, np.linalg.LinAlgError) as error:
            return Drawn(None, _unused(str(error)))
        image, layer = (torch.from_numpy(v).to(plain) for v in (drawn_image(vessel, fit), drawn_layer(vessel, fit)))

        def unexplained(volume: Tensor) -> float:
            # The fibrous layer is not asked: the model has nothing but fibrous tissue there.
            there = data.apply(layer * (volume - image))
            return float(np.abs(scores_of(vessel, fit, there)).max())

        return Drawn(image + layer * (plain - image), {"outlines": {"used": True}}, unexplained)


def _unused(why: str) -> dict[str, Any]:
    return {"outlines": {"used": False, "why": why}}
