"""MBIR of scans, of an inset (:mod:`recon.mbir.inset`) or a whole field
(:mod:`recon.mbir.field`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from recon.least_squares.inset_problem import InsetProblem, is_whole_field
from recon.mbir.field import Field
from recon.mbir.inset import Inset
from recon.mbir.known import Known
from recon.mbir.mbir import Mbir
from recon.result import Result
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan

if TYPE_CHECKING:
    from recon.mbir.priors import Prior

__all__ = ["reconstruct_mbir"]


def reconstruct_mbir(
    scans: Sequence[Scan],
    grid: VolumeGrid,
    progress: Callable[[float], None],
    *,
    network: Mbir | None = None,
    prior: Prior | str | None = None,
    problem: InsetProblem | None = None,
    batch: int = 4,
    fidelity: float | None = None,
    noise_map: bool = False,
    known: Known | None = None,
) -> Iterator[list[Result]]:
    """Unrolled MBIR with the learned prior, of an inset or of a whole field
    (:mod:`recon.mbir.field`).

    Args:
        scans: realisations of one scan.
        grid: the inset, or the field.
        progress: called with the finished fraction.
        network: with its weights; None: those of the package.
        prior: in the place of the network, which keeps the data steps: a prior, a denoiser of HU,
            or a name such as ``perona-malik`` or ``package.module:function``
            (:func:`recon.mbir.priors.prior_of`).
        problem: kept from an earlier call with the same scan and (working) grid; None: made here.
        batch: volumes of an inset at a time; of a whole field it is one.
        fidelity: from 0 (quiet images for viewing) to 1 (for measuring: more of the contrast and
            more noise), see :mod:`recon.mbir.unrolled`; None: that of ``network``, which is 0.5
            unless it was loaded with another.
        noise_map: add an estimate of each voxel's standard deviation, ``report["noise_sd_hu"]``.
        known: what is known of the object before, such as a vessel
            (:mod:`recon.mbir.known`), of small insets; None: nothing, or what ``network`` knows.

    Yields:
        Volumes in HU, batch by batch. Report: ``iterations``, ``fidelity``, ``residual`` (what is
        left of the data at the low frequencies that are the data's own, over what there was,
        :func:`recon.mbir.unrolled.low_residual`), ``chi2`` (weighted squared residual per reading),
        ``noise_scale_hu`` (of a whole field where 10 and 90 % of the voxels lie), ``voxel_mm`` (of
        the grid that is worked on), ``weights_sha256`` or the name of the ``prior``, of noisy scans
        ``residual_p`` (:mod:`torchpcct.metrics.residual_test`: does the volume explain its data?),
        ``missing_body`` of an inset (:func:`recon.mbir.residual.missing_body`), ``warnings``; with
        something ``known``, under its name, whether its model was used (``used``) or
        ``why`` not, and where it was, ``vessel_difference_hu``, the difference from the volume
        without it, like the volume in HU.

    Raises:
        ValueError, TypeError: see :class:`recon.least_squares.inset_problem.InsetProblem`; an inset
            of a scanner whose cells have another size than the network's voxels by far; a problem
            that was made for another grid; a fidelity outside of 0 … 1; what is no prior, or
            returns NaN or another kind of volume; for a whole field see
            :class:`recon.mbir.field.Field`.
        FileNotFoundError: the package has no weights.
    """
    if prior is not None:
        network = network.with_prior(prior) if network is not None else Mbir(prior=prior)
    network = (network or Mbir.load()).to(scans[0].device)
    if fidelity is not None:
        network = network.with_fidelity(fidelity)
    if known is not None:
        network = network.with_known(known)
    if problem is None and is_whole_field(scans[0], grid):
        asked = ["noise_map"] * noise_map
        asked += [f"a {network.known.name} model"] if network.known is not None else []
        if asked:
            raise ValueError(
                f"{asked[0]} needs the FFT model of a small inset: ask for a smaller grid"
            )
        domain: Field | Inset = Field(scans[0], grid, network)
        batch = 1
    else:
        domain = Inset(scans[0], grid, network, problem, noise_map)
    for i in range(0, len(scans), batch):
        yield domain.solve(scans[i : i + batch])
        progress(min(i + batch, len(scans)) / len(scans))
