"""MBIR around the outlines of a vessel: what is sharp and smooth is drawn, the network reconstructs
the rest.

A network that sees some millimetres about a voxel has to find every piece of a vessel's outline by
itself, in the noise of that place. A contrast-enhanced vessel has two smooth outlines over its
whole length (lumen and outer wall, a dozen numbers a centimetre), so the data determine them far
better (:mod:`recon.plaque.vessel`). With T the drawn vessel, in whose fibrous layer the best linear
estimate of its contents stands (:mod:`recon.plaque.layer`),

    u = T + MBIR(β − H T),

so whatever the drawing lacks (a branch, muscle, texture) comes from the data as ever, beside an
edge that is no longer there to bleed into it.

Where no vessel is found, or a drawn one does not explain the data within 1 mm of its wall, but for
its fibrous layer, the result is the plain reconstruction MBIR(β).

A drawing shows smooth outlines and nothing else. On disease that has others (a flap, an ulcer, a
thrombus at the wall, inflamed fat, a stent) it may be wrong and explain the data all the same. So
it is drawn only where somebody asks for it, the volume's warnings say so, and
:meth:`OutlineMbir.plain` is there to be compared with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from threadpoolctl import threadpool_limits
from torch import Tensor

from recon.least_squares.inset_problem import InsetProblem
from recon.mbir.mbir import Mbir, Reconstructed
from recon.mbir.network import Network
from recon.mbir.unrolled import DEFAULT_FIDELITY
from recon.plaque.data import TissueData
from recon.plaque.layer import SD_HU, LayerEstimate
from recon.plaque.quality import STRIKING, scores_of
from recon.plaque.start import find_vessel
from recon.plaque.vessel import FAT, FIBROUS, WALL, Fit, Vessel
from recon.plaque.vessel_prior import VesselPrior
from torchpcct.switches import undisturbed

__all__ = ["Drawn", "OutlineMbir"]

_SHIFT_HU = 200.0
"""Where the zero lies does not matter to an image: 150 HU added to everything change it by 1 HU
rms instead of 9."""
_APART_MM = 1.0
"""From the wall: muscle, veins and other vessels further away speak against no drawing; what is
nearer may be a part of the vessel that the drawing lacks."""
_TISSUE_HU = 120.0, 350.0
"""Wall and fibrous tissue above fat. Ten fits of sound vessels had 148 to 302 HU of fibrous tissue;
inflamed fat about a healthy vessel was fitted with 29 to 75, a flap with 457 and 473, a stent with
28 and 33 HU."""
_DRAWN = (
    "a vessel with smooth outlines was drawn, and disease that has others (flap, ulcer, thrombus, "
    "inflamed fat, stent, "
    "calcifications below 1 mm) may be missing: compare with the reconstruction that draws nothing"
)


@dataclass(frozen=True, eq=False)
class Drawn:
    """What is drawn of a scan.

    Attributes:
        image: T, HU ``(z, y, x)``, or None.
        note: for the volume's report.
        unexplained: the highest score (:func:`recon.plaque.quality.scores_of`) of what is left of
            the data, given the reconstruction, HU ``(z, y, x)``.
    """

    image: Tensor | None
    note: dict[str, Any]
    unexplained: Callable[[Tensor], float] = lambda volume: 0.0


def layer_sd_hu(fidelity: float) -> float:
    """Prior standard deviation of what the fibrous layer holds, HU: from 50, quiet, to 200, for
    measuring contrast."""
    return SD_HU * 4.0 ** (fidelity - DEFAULT_FIDELITY)


class OutlineMbir(Mbir):
    """:class:`recon.mbir.mbir.Mbir` around the outlines of a vessel.

    It is differentiable in the statistic; the fit by its linear model (of Gauss and Newton) at the
    mode.

    Args:
        network: gives weights, fidelity and parts.
        vessel_prior: what is believed of the vessel before the data; None: a coronary artery, on a
            scanner whose zero is not known (``shift`` of 200 HU), and one whose tissues are none of
            a coronary artery is not drawn.
    """

    def __init__(self, network: Mbir, vessel_prior: VesselPrior | None = None) -> None:
        super().__init__(network.model, network.fidelity, **network.parts)
        self.vessel_prior = vessel_prior

    @undisturbed
    def plain(self, problem: InsetProblem, b: Tensor, exposure_s: float) -> Reconstructed:
        """:meth:`recon.mbir.mbir.Mbir.solved`, nothing drawn."""
        return super().solved(problem, b, exposure_s)

    @undisturbed
    def solved(self, problem: InsetProblem, b: Tensor, exposure_s: float) -> Reconstructed:
        """See :meth:`recon.mbir.mbir.Mbir.solved`; the notes hold ``vessel``: whether it was
        drawn, or why not."""
        found = [self.drawn(problem, own, exposure_s) for own in b]
        notes = [one.note for one in found]
        normal = self.problem(problem, b, exposure_s)
        around = [k for k, one in enumerate(found) if one.image is not None]
        volumes: dict[int, Tensor] = {}
        if around:
            part, images = (
                normal.part(around),
                [one.image for one in found if one.image is not None],
            )
            t = self.in_noise_units(problem, torch.stack(images), part)
            # Once the outlines are taken off, four turns do what eight do: 0.7 HU rms apart on the
            # paper's plaque.
            network = self.model.network
            quick = (
                {"prior": partial(network, mirrored=False)} if isinstance(network, Network) else {}
            )
            u = t + self.solution(replace(part, beta=part.beta - part.apply(t)), **quick)
            for k, own, volume in zip(
                around, u, self.in_hu(problem, u.detach(), part), strict=True
            ):
                highest = found[k].unexplained(volume)
                if highest > STRIKING:
                    notes[k] |= _not_drawn(
                        f"its outlines leave {highest:.0f} standard deviations of the noise "
                        "unexplained"
                    )
                else:
                    volumes[k] = own
                    notes[k] |= {"vessel": {"drawn": True}}
        plain = [k for k in range(len(found)) if k not in volumes]
        if plain:
            volumes |= dict(zip(plain, self.plain(problem, b[plain], exposure_s).u, strict=True))
        for note in notes:
            vessel = note["vessel"]
            text = _DRAWN if vessel["drawn"] else f"no vessel was drawn: {vessel['why']}"
            note["warnings"] = [*note.get("warnings", []), text]
        return Reconstructed(normal, torch.stack([volumes[k] for k in range(len(found))]), notes)

    def drawn(self, problem: InsetProblem, b: Tensor, exposure_s: float) -> Drawn:
        """What is drawn of one scan.

        Args:
            problem: of the scan.
            b: its statistic ``(z, y, x)``.
            exposure_s: of b.
        """
        data = TissueData.of_statistic(b.detach(), problem, exposure_s)
        try:
            # Many small matrices: BLAS threads would wait for each other.
            with threadpool_limits(limits=1, user_api="blas"):
                prior = self.vessel_prior or VesselPrior(shift=_SHIFT_HU)
                vessel = Vessel(data, find_vessel(data.pilot(), data.grid, None), prior)
                estimate = LayerEstimate(
                    vessel.fit(vessel.first_guess(), expected=True), layer_sd_hu(self.fidelity)
                )
        except (ValueError, np.linalg.LinAlgError) as error:
            return Drawn(None, _not_drawn(str(error)))
        fit = estimate.fit
        strange = None if self.vessel_prior is not None else _strange_tissue(fit)
        if strange:
            return Drawn(None, _not_drawn(strange))
        credited = np.maximum(vessel.on_grid(estimate.share), _apart(vessel, fit))
        outlines, others = (torch.from_numpy(v).to(b) for v in (fit.image, credited))

        def unexplained(volume: Tensor) -> float:
            # The drawing knows fibrous tissue alone in the layer, and fat alone around: there the
            # network is believed.
            there = data.apply(others * (volume - outlines))
            return float(np.abs(scores_of(vessel, fit, there)).max())

        image = _Linear.apply(b, estimate, problem.mu_ref / 1000.0)
        return Drawn(image, {}, unexplained)


class _Linear(torch.autograd.Function):
    """The image of an estimate, whose change with b is linear and symmetric."""

    @staticmethod
    def forward(ctx: Any, b: Tensor, estimate: LayerEstimate, mu_per_hu: float) -> Tensor:
        ctx.kept = estimate, mu_per_hu
        return torch.from_numpy(estimate.image).to(b)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        estimate, mu_per_hu = ctx.kept
        with threadpool_limits(limits=1, user_api="blas"):
            change = estimate.change(grad.detach().double().numpy())
        return torch.from_numpy(change).to(grad) * mu_per_hu, None, None


def _apart(vessel: Vessel, fit: Fit) -> NDArray[np.float32]:
    """1 for voxels that are so far from the vessel's wall that nothing there can be meant for
    it, 0 elsewhere."""
    outside = vessel.on_grid(fit.drawing.shares[0]) < 0.5
    distance = ndimage.distance_transform_edt(outside, sampling=vessel.grid.spacing)
    return (distance >= _APART_MM).astype(np.float32)


def _strange_tissue(fit: Fit) -> str:
    """Which fitted tissue is none, or nothing: inflamed fat, a flap and a stent are fitted with
    such values."""
    fat = fit.parameters[FAT]
    least, most = _TISSUE_HU
    for name, value in (
        ("wall", fit.parameters[WALL]),
        ("fibrous tissue", fit.parameters[FIBROUS]),
    ):
        if not least <= value - fat <= most:
            return (
                f"its {name} would have {value - fat:.0f} HU more than what lies around the "
                "vessel, and a coronary "
                f"artery's has {least:.0f} to {most:.0f}"
            )
    return ""


def _not_drawn(why: str) -> dict[str, Any]:
    return {"vessel": {"drawn": False, "why": why}}
