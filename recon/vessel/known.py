"""What MBIR may know of a vessel: its outlines, or its tissues, modelled before the network
reconstructs the rest (:mod:`recon.mbir.known`).

**Outlines** (:class:`KnownVessel`). A network that sees some millimetres about a voxel has to find
every piece of a vessel's outline by itself, in the noise of that place. A contrast-enhanced vessel
has two smooth outlines over its whole length (lumen and outer wall, a dozen numbers a centimetre),
so the data determine them far better (:mod:`recon.vessel.model`). In the fibrous layer of the
modelled vessel stands the best linear estimate of its contents (:mod:`recon.vessel.layer`). Where
no vessel is found, or the model does not explain the data within 1 mm of its wall, but for its
fibrous layer, no model is used.

A vessel model has smooth outlines and nothing else. On disease that has others (a flap, an ulcer, a
thrombus at the wall, inflamed fat, a stent) it may be wrong and explain the data all the same. So
it is used only where somebody asks for it, the volume's warnings say so, and the reconstruction
without it (:meth:`recon.mbir.mbir.Mbir.with_known` of None) is there to be compared with.

**Tissues** (:class:`KnownTissues`). What a tissue is made of is pooled over the tissue, not over a
neighbourhood: beside the outlines the tissue values and a plaque's core are fitted to the data
(:mod:`recon.vessel.reading`), with a core and without. With P the probability that the core is
there the model's image is

    T = P · (with the core) + (1 − P) · (as around outlines alone)

So a proven core has its full contrast. The less a core is proven, the more the linear estimate
stands in the layer; in between the contrast is shrunk, as a mean over two explanations is.

Other weights than P trade one thing for another, as 48 noise realisations at 0.35 and 2.0 s have
shown. A core that is always modelled has the least error where there is none, and up to 45 % more
noise of the contrast. P² has up to 11 % less noise of the contrast than P, but 16 to 29 % more
error where there is no core. P has the least error inside the vessel, or nearly. Where
the tissues do not explain the data (their residual exceeds what noise leaves), the outlines alone
are tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from threadpoolctl import threadpool_limits
from torch import Tensor

from recon.data_term import Quadratic
from recon.mbir.known import Known, KnownImage
from recon.mbir.unrolled import DEFAULT_FIDELITY
from recon.vessel.data import grid_of, in_hu, pilot
from recon.vessel.layer import SD_HU, LayerEstimate
from recon.vessel.model import FAT, FIBROUS, WALL, Fit, VesselModel
from recon.vessel.prior import VesselPrior
from recon.vessel.quality import STRIKING, scores_of
from recon.vessel.reading import read_plaque
from recon.vessel.start import find_vessel
from torchpcct.validate import numbers

_SHIFT_HU = 200.0
"""HU; where the zero lies does not matter to an image: 150 HU added to everything change it by 1 HU
rms instead of 9."""
_APART_MM = 1.0
"""From the wall: muscle, veins and other vessels further away speak against no model; what is
nearer may be a part of the vessel that the model lacks."""
_TISSUE_HU = 120.0, 350.0
"""Wall and fibrous tissue above fat. Ten fits of sound vessels had 148 to 302 HU of fibrous tissue;
inflamed fat about a healthy vessel was fitted with 29 to 75, a flap with 457 and 473, a stent with
28 and 33 HU."""
_PROVEN = 0.999
"""Probability from which on the image is that with the core: what else would be less than a
tenth of an HU."""


def known_vessel(
    vessel: bool = False,
    tissues: bool = False,
    point: Sequence[float] | None = None,
    vessel_prior: VesselPrior | None = None,
) -> Known | None:
    """What MBIR is to know of a vessel, by the options of :func:`recon.api.reconstruct`.

    Args:
        vessel: model its outlines.
        tissues: model its tissues as well.
        point: ``(z, y, x)`` mm where a reader sees the plaque, for ``tissues``; None: in the
            largest vessel.
        vessel_prior: what is believed of the vessel's tissues before the data; None: a coronary
            artery.

    Returns:
        The plug-in; None: nothing is asked for.

    Raises:
        ValueError, TypeError: a point without tissues or that is not three finite numbers, a prior
            without a vessel.
    """
    if point is not None and not tissues:
        raise ValueError("point says where a plaque is: give it with tissues=True")
    if vessel_prior is not None and not (vessel or tissues):
        raise ValueError(
            "vessel_prior says what a vessel is made of: give it with vessel=True or tissues=True"
        )
    if tissues:
        return KnownTissues(vessel_prior, point)
    return KnownVessel(vessel_prior) if vessel else None


def layer_sd_hu(fidelity: float) -> float:
    """Prior standard deviation of what the fibrous layer holds, HU: from 50, quiet, to 200, for
    measuring contrast."""
    return SD_HU * 4.0 ** (fidelity - DEFAULT_FIDELITY)


@dataclass(frozen=True)
class KnownVessel:
    """The outlines of a vessel.

    T is differentiable in the data; the fit by its linear model (of Gauss and Newton) at the mode.

    Args:
        vessel_prior: what is believed of the vessel before the data; None: a coronary artery, on a
            scanner whose zero is not known (``shift`` of 200 HU), and one whose tissues are none of
            a coronary artery is not modelled.
    """

    vessel_prior: VesselPrior | None = None
    name = "vessel"
    caution = (
        "a vessel model with smooth outlines was used, and disease that has others (flap, ulcer, "
        "thrombus, inflamed fat, stent, calcifications below 1 mm) may be missing: compare with "
        "the reconstruction without it"
    )

    def image_of(self, term: Quadratic, fidelity: float) -> KnownImage:
        """See :meth:`recon.mbir.known.Known.image_of`."""
        b, data = term.b[0], in_hu(term)
        try:
            # Many small matrices: BLAS threads would wait for each other.
            with threadpool_limits(limits=1, user_api="blas"):
                prior = self.vessel_prior or VesselPrior(shift=_SHIFT_HU)
                vessel = VesselModel(data, find_vessel(pilot(data), grid_of(data), None), prior)
                estimate = LayerEstimate(
                    vessel.fit(vessel.first_guess(), expected=True), layer_sd_hu(fidelity)
                )
        except (ValueError, np.linalg.LinAlgError) as error:
            return KnownImage(None, str(error))
        fit = estimate.fit
        strange = None if self.vessel_prior is not None else _strange_tissue(fit)
        if strange:
            return KnownImage(None, strange)
        credited = np.maximum(vessel.on_grid(estimate.share), _apart(vessel, fit))
        outlines, others = (torch.from_numpy(v).to(b) for v in (fit.image, credited))

        def objection(volume: Tensor) -> str:
            # The model knows fibrous tissue alone in the layer, and fat alone around: there the
            # network is believed.
            there = data.apply((others * (volume - outlines))[None])[0]
            highest = float(np.abs(scores_of(vessel, fit, there)).max())
            if highest <= STRIKING:
                return ""
            return f"its outlines leave {highest:.0f} standard deviations of the noise unexplained"

        return KnownImage(_LinearImage.apply(b, estimate, term.mu_per_hu), objection=objection)


@dataclass(frozen=True)
class KnownTissues(KnownVessel):
    """The tissues of a vessel: outlines, values and a plaque's core.

    Args:
        vessel_prior: what is believed of the vessel before the data; None: what a reading believes,
            a coronary artery.
        point: ``(z, y, x)`` mm where a reader sees the plaque; None: in the largest vessel.

    Raises:
        ValueError, TypeError: a point that is not three finite numbers.
    """

    point: Sequence[float] | None = None

    def __post_init__(self) -> None:
        if self.point is not None:
            object.__setattr__(self, "point", numbers("point", self.point, 3, unit="mm"))

    def image_of(self, term: Quadratic, fidelity: float) -> KnownImage:
        """See :meth:`recon.mbir.known.Known.image_of`; the report holds ``tissues``: what was
        read, or why not."""
        outlines = super().image_of
        try:
            reading = read_plaque(term, self.point, vessel_prior=self.vessel_prior)
        except ValueError as error:
            why = f"no tissues were fitted: {error}"
            return _without(outlines(term, fidelity), why)
        if reading.warnings:
            why = f"the fitted tissues were not used: {reading.warnings[0]}"
            return _without(outlines(term, fidelity), why)
        read = {
            "used": True,
            "presence": reading.presence,
            "chi2": reading.chi2,
            "calcifications": reading.calcifications,
        }
        image, presence = torch.from_numpy(reading.image).to(term.b), reading.presence
        if presence < _PROVEN:
            around = outlines(term, fidelity).image
            if around is not None:
                image = presence * image + (1.0 - presence) * around
        return KnownImage(image, report={"tissues": read})


def _without(found: KnownImage, why: str) -> KnownImage:
    """The image without tissues, with a warning that they are not used."""
    report = {"tissues": {"used": False, "why": why}}
    return replace(
        found,
        report=found.report | report,
        warnings=(f"{why}; this is the reconstruction without them",),
    )


class _ImageContext(Protocol):
    """What a forward pass leaves to the backward one."""

    kept: tuple[LayerEstimate, float]


class _LinearImage(torch.autograd.Function):
    """The image of an estimate, whose change with b is linear and symmetric."""

    @staticmethod
    def forward(ctx: _ImageContext, b: Tensor, estimate: LayerEstimate, mu_per_hu: float) -> Tensor:
        ctx.kept = estimate, mu_per_hu
        return torch.from_numpy(estimate.image).to(b)

    @staticmethod
    def backward(ctx: _ImageContext, grad: Tensor) -> tuple[Tensor, None, None]:
        estimate, mu_per_hu = ctx.kept
        with threadpool_limits(limits=1, user_api="blas"):
            change = estimate.change(grad.detach().double().numpy())
        return torch.from_numpy(change).to(grad) * mu_per_hu, None, None


def _apart(vessel: VesselModel, fit: Fit) -> NDArray[np.float32]:
    """1 for voxels that are so far from the vessel's wall that nothing there can be meant for
    it, 0 elsewhere."""
    outside = vessel.on_grid(fit.drawing.fractions[0]) < 0.5
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
                f"vessel, and a coronary artery's has {least:.0f} to {most:.0f}"
            )
    return ""
