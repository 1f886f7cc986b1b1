"""Model-based reconstruction with the learned prior: from a scan's data term to a volume in HU.

The network works on cubic voxels of one size (the one it was trained at); other grids are
reconstructed on such voxels over the same extent and averaged onto the grid that was asked for.
Weights and their model card ship in ``recon/mbir/weights``.
"""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn

from recon.data_term import Quadratic
from recon.mbir.known import Known, KnownImage
from recon.mbir.network import Network
from recon.mbir.priors import Prior, name_of, network_of, prior_of
from recon.mbir.recovery_note import contrast_note
from recon.mbir.residual import missing_body
from recon.mbir.unrolled import (
    DEFAULT_FIDELITY,
    Unrolled,
    fidelity_frequency,
    low_pass,
    low_residual,
)
from recon.mbir.weights_io import digest, read_tensors
from recon.result import Result
from torchpcct.geometry import VolumeGrid
from torchpcct.switches import undisturbed
from torchpcct.volume import in_words

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from torchpcct.typing import JsonObject


__all__ = ["Mbir"]

_LOG = logging.getLogger(__name__)

SHIPPED = "mbir.safetensors"
"""File of the weights that ship with the package."""
WEIGHTS_FORMAT = "torchpcct unrolled weights 2"
"""What a file of weights says of itself."""
LARGEST_HU = 2000.0
"""Above the densest calcification of the training, 1800 HU: what reads more is metal."""


class Mbir:
    """The unrolled reconstruction with trained weights, or with another prior.

    Args:
        model: with its weights; None: the one that ships, or with ``prior`` one step of that.
        fidelity: 0 (viewing) … 1 (measuring), see :mod:`recon.mbir.unrolled`.
        prior: in the place of the model's network: a prior, a denoiser, or a name
            (:func:`recon.mbir.priors.prior_of`); a module goes into evaluation mode.
        parts: for ablations, ``steps``, ``final_data_consistency``, ``cut_overshoot`` and
            ``restore`` of :meth:`recon.mbir.unrolled.Unrolled.forward`.

    Raises:
        ValueError, TypeError: a fidelity outside of 0 … 1; what is no prior.
        FileNotFoundError: the package has no weights.
    """

    name = "mbir"
    model: Unrolled

    def __init__(
        self,
        model: Unrolled | None = None,
        fidelity: float = DEFAULT_FIDELITY,
        *,
        prior: Prior | str | None = None,
        **parts: Any,
    ) -> None:
        fidelity_frequency(fidelity)
        if prior is not None:
            prior = parts["prior"] = _ready(prior)
        if model is None:
            model = Unrolled(prior, steps=1) if prior is not None else Mbir.load().model
        self.model = model.eval().requires_grad_(False)
        self.fidelity = fidelity
        self.parts = parts
        self.known: Known | None = None
        self._sha256 = ""
        self.voxel_mm = model.voxel_mm

    @classmethod
    @undisturbed
    def load(
        cls,
        path: str | Path | None = None,
        fidelity: float = DEFAULT_FIDELITY,
        network: object = None,
    ) -> Mbir:
        """From a weights file; None: the weights that ship with the package.

        Args:
            path: of the file.
            fidelity: as for the class.
            network: for weights of another network than the package's: its class,
                ``package.module:Class`` or the class or a module itself
                (:func:`recon.mbir.priors.network_of`). A file alone imports nothing.

        Raises:
            FileNotFoundError: no such file.
            ValueError: a file that is damaged or holds no weights of this model; of another network
                which is not named.
        """
        source = (
            Path(path)
            if path is not None
            else Path(str(resources.files("recon") / "mbir" / "weights" / SHIPPED))
        )
        if not source.is_file():
            raise FileNotFoundError(
                f"no weights at {source}: train them (torchpcct train) or name a file"
            )
        foreign = network is not None
        try:
            tensors, config = read_tensors(source, WEIGHTS_FORMAT)
            foreign = foreign or "class" in config["network"]
            prior = network_of(config["network"], network)
            model = Unrolled(prior, steps=config["unroll"], voxel_mm=config.get("voxel_mm"))
            _fill(model, tensors)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            if foreign:
                raise ValueError(f"{source}: {error}") from error
            raise ValueError(
                f"{source} holds no weights of this unrolled reconstruction: {error} (shipped "
                "weights come back with a new installation of the package)"
            ) from error
        return cls(model, fidelity)

    @property
    def prior(self) -> Prior:
        """What stands between the data steps."""
        prior: Prior = self.parts.get("prior", self.model.network)
        return prior

    @property
    def prior_name(self) -> str:
        """Of what stands between the data steps."""
        return name_of(self.prior)

    @property
    def made_with(self) -> dict[str, str]:
        """For a report: the weights, or the prior in their place."""
        return (
            {"prior": self.prior_name}
            if "prior" in self.parts
            else {"weights_sha256": self.weights_sha256}
        )

    @property
    def weights_sha256(self) -> str:
        """SHA-256 of the weights' names, types, shapes and values, as in the record of their
        training."""
        return self._sha256 or digest(self.model.state_dict())

    def normal(self, term: Quadratic) -> Quadratic:
        """A data term in noise units, on the voxels that the network knows.

        Args:
            term: in mm⁻¹, of cubic voxels of ``voxel_mm``.

        Raises:
            ValueError: other voxels.
        """
        if max(abs(s / self.voxel_mm - 1.0) for s in term.spacing) > 0.01:
            raise ValueError(
                f"the network works on cubic voxels of {self.voxel_mm:g} mm, got {term.spacing}: "
                "make the problem on recon.mbir.mbir.working_grid and average the result onto the "
                "grid"
            )
        return replace(term, spacing=(self.voxel_mm,) * 3).in_noise_units()

    @undisturbed
    def __call__(self, term: Quadratic) -> Tensor:
        """Volumes in HU, ``(batch, z, y, x)``, differentiable in the term's b.

        Args:
            term: of scans, in mm⁻¹ on voxels of ``voxel_mm``
                (:meth:`recon.least_squares.inset_problem.InsetProblem.term`).
        """
        normal = self.normal(term)
        return normal.hu(self._solved(term, normal)[0])

    @undisturbed
    def solve(self, term: Quadratic) -> list[Result]:
        """Volumes in HU with their reports (:meth:`results`), the units of ``term`` as above, and
        ``missing_body``: the ball that the data hold and the volume does not, by diameter_mm,
        contrast_hu, deviations and voxel, or None (:func:`recon.mbir.residual.missing_body`). With
        something known, reports and warnings say that it was used, or why not."""
        normal = self.normal(term)
        u, notes = self._solved(term, normal)
        with torch.no_grad():
            left = normal.left(u)
            passed = low_pass(normal, torch.full_like(normal.unit_hu, self.fidelity))
            missing = missing_body(normal, left, 1.0 - passed)
        results = self.results(normal, u, normal.hu(u), left)
        found = zip(results, notes, missing, strict=True)
        return [
            result._replace(
                report=result.report
                | {"missing_body": None if body is None else body._asdict()}
                | note.report,
                warnings=note.warnings,
            )
            for result, note, body in found
        ]

    @torch.no_grad()
    def results(
        self,
        normal: Quadratic,
        u: Tensor,
        volumes: Tensor,
        left: Tensor,
        whole: Quadratic | None = None,
    ) -> list[Result]:
        """Volumes with their reports: ``method``, ``iterations``, ``fidelity``, ``residual``
        (:func:`recon.mbir.unrolled.low_residual`), ``chi2`` where yᵀW y is known,
        ``noise_scale_hu`` (least and largest), and the weights or the prior.

        Args:
            normal: the data term in noise units.
            u: the volumes in these units.
            volumes: the same as they are given back.
            left: what the volumes leave of the data, ``normal.left(u)``.
            whole: the data term before something was taken off that the volumes show; None:
                ``normal``.
        """
        residual = low_residual(whole or normal, left, self.fidelity).tolist()
        chi2 = [None] * len(u) if normal.energy is None else normal.chi2(u, left).tolist()
        same = {"method": "mbir", "iterations": self.model.steps, "fidelity": self.fidelity}
        return [
            Result(
                volume,
                {
                    **same,
                    "residual": residual[k],
                    "chi2": chi2[k],
                    "noise_scale_hu": (float(normal.unit_hu[k]),) * 2,
                    **self.made_with,
                },
            )
            for k, volume in enumerate(volumes)
        ]

    def _solved(self, term: Quadratic, normal: Quadratic) -> tuple[Tensor, list[_Note]]:
        """u of a batch, and the warnings of each volume."""
        if self.known is not None:
            return self._around(self.known, term, normal)
        return self.solution(normal), [_Note({}, [])] * len(term.b)

    def _around(
        self, known: Known, term: Quadratic, normal: Quadratic
    ) -> tuple[Tensor, list[_Note]]:
        """Around what is known; without it where there is no image of it, or an objection."""
        scans = range(len(term.b))
        # What is known is fitted on the CPU.
        found = [known.image_of(term.part([k]).to("cpu"), self.fidelity) for k in scans]
        why = [one.why for one in found]
        images = {k: one.image for k, one in enumerate(found) if one.image is not None}
        volumes: dict[int, Tensor] = {}
        if images:
            part = normal.part(list(images))
            t = part.of_hu(torch.stack(list(images.values())).to(part.b))
            # Once what is known is taken off, four turns do what eight do: 0.7 HU rms apart on
            # the paper's plaque.
            network = self.model.network
            quick = (
                {"prior": partial(network, mirrored=False)} if isinstance(network, Network) else {}
            )
            u = t + self.solution(part.less(t), **quick)
            hu = part.hu(u.detach())
            for k, own, volume in zip(images, u, hu, strict=True):
                why[k] = found[k].objection(volume.cpu())
                if not why[k]:
                    volumes[k] = own
        plain = [k for k in scans if k not in volumes]
        if plain:
            volumes |= dict(zip(plain, self.solution(normal.part(plain)), strict=True))
        notes = [_note(known, *one) for one in zip(found, why, strict=True)]
        return torch.stack([volumes[k] for k in scans]), notes

    def solution(self, normal: Quadratic, **parts: Any) -> Tensor:
        """u of a normalised problem, ``(batch, z, y, x)``.

        Args:
            normal: the problem.
            parts: arguments of the model that those of this method go before.

        Raises:
            ValueError, TypeError: the prior returns NaN, or something else than a volume like the
                one that it is given.
        """
        sound = True

        def watch(step: int, v: Tensor) -> None:
            nonlocal sound
            bad = int((~torch.isfinite(v)).sum()) if sound else 0
            sound = sound and not bad
            if bad and step:
                raise ValueError(
                    f"the prior {self.prior_name} returned NaN or infinite values in {bad} of "
                    f"{v.numel()} voxels: use other weights, or another prior"
                )

        found: Tensor = self.model(normal, self.fidelity, callback=watch, **{**parts, **self.parts})
        return found

    def with_prior(self, prior: Prior | str) -> Self:
        """The same method with another prior.

        Raises:
            ValueError, TypeError: what is no prior.
        """
        other = copy.copy(self)
        other.parts = {**self.parts, "prior": _ready(prior)}
        return other

    def to(self, device: torch.device | str) -> Self:
        """The same method with its weights on a device; itself where they are there already."""
        held = [self.model, *(p for p in (self.parts.get("prior"),) if isinstance(p, nn.Module))]
        target = torch.device(device)
        tensors = [t for m in held for t in (*m.parameters(), *m.buffers())]
        if all(t.device == target for t in tensors):
            return self
        other = copy.copy(self)
        other._sha256 = self.weights_sha256  # copies of all weights would travel for it
        other.model = copy.deepcopy(self.model).to(target)
        if len(held) > 1:
            other.parts = {**self.parts, "prior": copy.deepcopy(held[1]).to(target)}
        return other

    def with_known(self, known: Known | None) -> Self:
        """The same method around what is known of the object; None: around nothing.

        A T that depends on the data is differentiable in them as far as the plug-in makes it so.
        """
        other = copy.copy(self)
        other.known = known
        return other

    def with_fidelity(self, fidelity: float) -> Self:
        """The same method with another fidelity.

        Raises:
            ValueError: a fidelity outside of 0 … 1.
        """
        fidelity_frequency(fidelity)
        other = copy.copy(self)
        other.fidelity = fidelity
        return other

    @undisturbed
    @torch.no_grad()
    def noise_map(self, term: Quadratic, draws: int = 8, seed: int = 0) -> Tensor:
        """Standard deviation of each voxel in HU, ``(z, y, x)``, of one scan.

        The scan is perturbed by fresh noise of its own covariance; the network's response, root
        mean square over ``draws`` and averaged over 3 × 3 × 3 voxels, estimates the noise that the
        volume holds already.

        Args:
            term: of the scan, in mm⁻¹, a batch of one; its operator is a
                :class:`recon.gram.gram.Gram`.
            draws, seed: of the noise.
        """
        gram: Any = term.operator
        generator = torch.Generator().manual_seed(seed)
        noise = gram.noise((draws,), generator=generator) * math.sqrt(float(term.scale))
        # Half of the noise in either direction: the response is the local one, and the reference is
        # their mean.
        both = torch.cat([term.b + noise / 2, term.b - noise / 2])
        volumes = self(replace(term, b=both, scale=term.scale.expand(len(both)), energy=None))
        square = (volumes[:draws] - volumes[draws:]).square().mean(0)
        return torch.nn.functional.avg_pool3d(square[None, None], 3, 1, 1, count_include_pad=False)[
            0, 0
        ].sqrt()

    def notes(self, noise_scale_hu: float) -> list[str]:
        """What is to be known of a volume of this noise that speaks neither for nor against it
        (:mod:`recon.mbir.recovery_note`)."""
        if not self.trained or self.known is not None:
            return []
        return contrast_note(self.weights_sha256, noise_scale_hu, self.fidelity)

    def noisier_or_quieter(self, scales: Sequence[float]) -> list[float]:
        """Those of the noise scales in HU that the training has not seen."""
        low, high = self.model.seen_scale_hu.tolist()
        return [s for s in scales if self.trained and not 0.98 * low <= s <= 1.02 * high]

    @property
    def trained(self) -> bool:
        """Whether the prior has been trained on scans of some noise: a filter knows any."""
        return "prior" not in self.parts and float(self.model.seen_scale_hu[1]) > 0

    def check(
        self, scales: Sequence[float], peak: float, unit: str = "HU", mu_water: float = 0.02
    ) -> list[str]:
        """What speaks against trusting the network.

        Args:
            scales: noise scales of the scan, HU.
            peak: largest value of the volume, HU.
            unit, mu_water: of the scan; messages are in its unit.
        """
        found = []
        low, high = self.model.seen_scale_hu.tolist()
        outside = self.noisier_or_quieter(scales)
        if outside:
            seen = " and ".join(dict.fromkeys(in_words(s, unit, mu_water) for s in outside))
            found.append(
                f"the noise scale of the scan, {seen}, lies outside of the "
                f"{in_words(low, unit, mu_water).split()[0]}…"
                f"{in_words(high, unit, mu_water)} of the training: the contrast of small "
                "structures may be wrong"
                + (
                    ', and edges of bone less sharp than by "fbp" or "pwls"'
                    if min(outside) < low
                    else ""
                )
            )
        if peak > LARGEST_HU:
            most, largest = (
                in_words(v, unit, mu_water, difference=False) for v in (peak, LARGEST_HU)
            )
            what = (
                "metal shades the tissue beside it"
                if unit == "HU"
                else "what is so dense shades what is beside it"
            )
            more, learned = (
                f"the volume reaches {most}, more than",
                ", and the prior has not learned that",
            )
            found.append(
                f"{more} the {largest} of the training: {what}{learned}"
                if self.trained
                else f"{more} {largest}: {what}"
            )
        return found


def _ready(given: Prior | str) -> Prior:
    """A prior, in evaluation mode if it is a module."""
    prior = prior_of(given)
    return prior.eval() if isinstance(prior, nn.Module) else prior


class _Note(NamedTuple):
    """What is added to the report and the warnings of a volume."""

    report: JsonObject
    warnings: list[str]


def _note(known: Known, found: KnownImage, why: str) -> _Note:
    """Report and warnings of a scan for which a model of something known was asked for."""
    entry = {"used": False, "why": why} if why else {"used": True}
    text = f"no {known.name} model was used: {why}" if why else known.caution
    return _Note({**found.report, known.name: entry}, [*found.warnings, text])


def _fill(model: Unrolled, tensors: Mapping[str, Tensor]) -> None:
    """Put weights into a model (ValueError: they are of another one)."""
    state = model.state_dict()
    for name in [*state, *tensors]:
        there, here = (
            tuple(part[name].shape) if name in part else "none" for part in (tensors, state)
        )
        if there != here:
            raise ValueError(
                f"they do not fit {name_of(model.network)}: {name} has the shape {there} in the "
                f"file, {here} in the network"
            )
    model.load_state_dict(tensors)


def working_grid(grid: VolumeGrid, voxel_mm: float) -> VolumeGrid:
    """The grid of cubic voxels that covers ``grid``; ``grid`` itself if its voxels have that
    size already."""
    if max(abs(s / voxel_mm - 1.0) for s in grid.spacing) <= 0.01:
        return grid
    shape = tuple(max(1, math.ceil(e / voxel_mm - 1e-6)) for e in grid.extent)
    return VolumeGrid(shape, voxel_mm, grid.center)


def average_onto(volume: Tensor, source: VolumeGrid, target: VolumeGrid) -> Tensor:
    """Averages of a volume over the voxels of another grid that lies inside of it, ``(...,
    *target.shape)``."""
    for axis in range(3):
        shared = overlap(source, target, axis)
        matrix = torch.from_numpy(shared / shared.sum(axis=1, keepdims=True))
        volume = torch.movedim(
            torch.movedim(volume, axis - 3, -1) @ matrix.to(volume).T, -1, axis - 3
        )
    return volume


def overlap(source: VolumeGrid, target: VolumeGrid, axis: int) -> NDArray[np.float64]:
    """How much of each target voxel lies in each source voxel along an axis, ``(target,
    source)``, as shares."""
    at, width = target.axes[axis][:, None], target.spacing[axis]
    middle, step = source.axes[axis], source.spacing[axis]
    shared = np.minimum(at + width / 2, middle + step / 2) - np.maximum(
        at - width / 2, middle - step / 2
    )
    return np.clip(shared, 0.0, None) / width
