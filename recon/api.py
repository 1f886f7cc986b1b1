"""The inference API: one call from a scan to a volume in HU."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, Unpack, overload

import numpy as np
import torch
from torch import Tensor

from recon.analytic.coverage import consistency_warnings, sampling_warnings, view_notes
from recon.analytic.inset import InsetFbp
from recon.least_squares.pwls import PwlsOptions
from recon.least_squares.reconstruct import reconstruct_pwls
from recon.mbir.reconstruct import reconstruct_mbir
from recon.metal import metal_warnings
from recon.names import split_method
from recon.result import Result, tested
from torchpcct.checks.defects import dead_readings, repair_defects
from torchpcct.checks.readings import reading_warnings
from torchpcct.devices import device_of, same_device
from torchpcct.geometry import Geometry, VolumeGrid
from torchpcct.scan import Scan
from torchpcct.scan_grid import finite_cells
from torchpcct.scan_memory import once
from torchpcct.validate import checked
from torchpcct.vector_geometry import VectorGeometry, check_motion
from torchpcct.volume import Volume, from_hu

if TYPE_CHECKING:
    from recon.least_squares.inset_problem import InsetProblem
    from recon.least_squares.qggmrf import QGGMRF
    from recon.mbir.known import Known
    from recon.mbir.mbir import Mbir
    from recon.mbir.priors import Prior
    from recon.vessel.prior import VesselPrior
    from torchpcct.typing import JsonObject

__all__ = ["MethodOptions", "reconstruct"]

_LOG = logging.getLogger(__name__)

T = TypeVar("T")

_ONE_DIRECTION = 1e-9
"""Views closer than this, over the unit circle or the source's distance, look from one place."""
_STARVED = 0.5
"""More zero counts than this, and the logarithm no longer describes the data: FBP and PWLS would be
guesswork."""


class MethodOptions(PwlsOptions, total=False):
    """Options of :func:`reconstruct`: ``kernel`` of FBP, ``prior``, ``problem`` and ``batch`` of
    PWLS and MBIR, the rest of MBIR. Each is described where its method is, or below; that of
    another method is a ``TypeError``.

    Attributes:
        vessel: of MBIR: fit a model of the inset's contrast-enhanced vessel, with smooth
            outlines, and let the network reconstruct the residual (:mod:`recon.vessel.known`);
            three times as long. Sharper on vessels that are so, wrong on disease that has other
            outlines: ``warnings`` say whether it was used, the report holds what it changed. Where
            no vessel is found, or its outlines do not explain the data, the volume is the one
            without.
        tissues: fit the tissues' values and a core as well, at full contrast where the data prove
            it; a few seconds a volume longer. Where they do not explain the data, the volume is the
            one without, with a warning. The report holds under ``tissues`` what was read of them.
        point: ``(z, y, x)`` mm where a reader sees the plaque, for ``tissues``; None: in the
            largest vessel.
        vessel_prior: what is believed of the vessel's tissues before the data; None: a coronary
            artery.
    """

    kernel: str
    prior: QGGMRF | Prior | str | None
    problem: InsetProblem | None
    batch: int
    network: Mbir | None
    fidelity: float | None
    noise_map: bool
    vessel: bool
    tissues: bool
    point: Sequence[float] | None
    vessel_prior: VesselPrior | None
    known: Known | None


def require_light(zero_fraction: float) -> None:
    """Refuse a scan of which more than half the readings are zero (ValueError)."""
    if zero_fraction > _STARVED:
        raise ValueError(
            f"{100 * zero_fraction:.0f} % of the readings are zero: too few photons for a "
            "line-integral method; raise the exposure or bin the readings"
        )


def require_directions(geometry: Geometry) -> None:
    """Refuse a scan all of whose views look from one direction (ValueError): they are one picture,
    of which iterative methods would make a volume of streaks without a word."""
    rays = geometry.poses[:, 0] if isinstance(geometry, VectorGeometry) else None
    if rays is None:
        period = math.pi if geometry.parallel else 2.0 * math.pi
        turns = np.exp((2j * math.pi / period) * geometry.angles)
        spread = float(np.abs(turns - turns[0]).max())
    else:
        if geometry.parallel:
            rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        spread = float(np.abs(rays - rays[0]).max()) / float(np.abs(rays).max())
    if spread <= _ONE_DIRECTION:
        count = f"all {geometry.views} views look" if geometry.views > 1 else "one view looks"
        raise ValueError(
            f"{count} from one direction, from which no volume follows: give the angle of every "
            "view (a step of 0 or of a whole turn puts all at one)"
        )


@overload
def reconstruct(
    scan: Scan,
    grid: VolumeGrid,
    method: str = ...,
    *,
    progress: Callable[[float], None] | None = ...,
    device: str | torch.device | None = ...,
    motion: object = ...,
    **options: Unpack[MethodOptions],
) -> Volume: ...
@overload
def reconstruct(
    scan: Sequence[Scan],
    grid: VolumeGrid,
    method: str = ...,
    *,
    progress: Callable[[float], None] | None = ...,
    device: str | torch.device | None = ...,
    motion: object = ...,
    **options: Unpack[MethodOptions],
) -> list[Volume]: ...


@checked
def reconstruct(
    scan: Scan | Sequence[Scan],
    grid: VolumeGrid,
    method: str = "fbp",
    *,
    progress: Callable[[float], None] | None = None,
    device: str | torch.device | None = None,
    motion: object = None,
    **options: Unpack[MethodOptions],
) -> Volume | list[Volume]:
    """Reconstruct a scan on a grid, in HU (water reads 0).

    Args:
        scan: one scan, or several realisations of one scan (same geometry, window and exposure).
        grid: ``(z, y, x)`` grid inside the field of view; of a parallel or fan-beam scan ``(y, x)``
            or, of several slices, ``(slices, y, x)``.
        method: ``"fbp"`` (FDK; option ``kernel``) or ``"pwls"`` (penalised weighted least squares
            with a q-GGMRF prior, of an inset or a whole field; options of
            :func:`recon.least_squares.reconstruct.reconstruct_pwls`; a volume that did not converge
            carries ``warnings`` in its report) or ``"mbir"`` (unrolled steps with the learned prior
            that ships with the package, of an inset or a whole field; options of
            :func:`recon.mbir.reconstruct.reconstruct_mbir`, and models of a vessel, see
            :class:`MethodOptions`; what the training has not seen is named in ``warnings``).
            Options may follow, as an evaluation has them
            (:mod:`recon.evaluate.methods`): ``"fbp:soft"``,
            ``"mbir:fidelity=1,prior=perona-malik"``.
        progress: called with the finished fraction, 0…1.
        device: where it is computed and where the volumes lie, a name such as ``"cuda"``; None:
            where the scan lies (:meth:`torchpcct.Scan.to`). On another device than the CPU the
            report says under ``device`` which one, and under ``on_cpu`` what was computed on the
            CPU all the same: tests and repair of the readings, tests of what a volume leaves of
            them, the fit of an inset's FFT model, and the vessel model. All else runs on
            the device, with Triton's kernels.
        motion: of an inset whose exterior is known (``acquire(…, region=)``), which stands still:
            its displacement in every view, ``(views, 3)`` z, y, x mm; ``"estimate"``: from the
            readings themselves (:func:`recon.motion.estimate_motion`), with the path, its errors
            and whether the readings hold it under ``motion`` in the report, scan by scan; or what
            that found. The volume shows the inset at rest, where its displacement is zero; the
            tests of the scan look at its readings as they would be then, so that a motion that is
            not theirs is named.
        options: of the method (:class:`MethodOptions`).

    Readings that no object can cause (dead or hot cells, dead views, lost readings:
    :mod:`torchpcct.checks.defects`) are interpolated before; the report's ``warnings`` say so, and
    what else the readings say against their description (an offset, saturation, transmissions, no
    light: :mod:`torchpcct.checks.readings`). Scans that contradict themselves or their description
    (centre, fan angles, steps between views, roll, rows that end inside the object, readings that
    are no line integrals) are named there, too
    (:func:`recon.analytic.coverage.consistency_warnings`); PWLS and MBIR test what they leave of
    the data besides. Metal is named (:mod:`recon.metal`), not corrected.

    The number of threads does not change a bit of an inset's FBP and PWLS. FBP of whole rows and
    MBIR, where torch's matrix products and convolutions decide about the order of sums, agree
    within 0.01 HU.

    Returns:
        A :class:`torchpcct.Volume` (a list of them for a sequence of scans), float32 HU; its
        ``report`` says how it was made: method, options, seconds, ``warnings``, how many
        ``dead_readings`` were interpolated, ``cells_mm`` of the detector as they are seen at the
        axis ([z,] y, x), and for iterative methods iterations and residual. In mm⁻¹ if
        ``scan.unit`` says so.

    Raises:
        ValueError: an unknown method, kernel or option value, a grid outside the field of view, a
            starved scan, one whose views all look from one direction; a device that does not
            exist, has too little memory, or has no kernels for the scan; scans or a ``problem`` on
            another device; a motion of another shape, beside a ``problem``, or of a scan whose
            motion cannot be found.
        TypeError: ``scan`` is no :class:`torchpcct.Scan`, or an option does not exist.

    Example:
        >>> import numpy as np, torch
        >>> from torchpcct import ParallelBeam, Projector, Scan, VolumeGrid
        >>> geometry = ParallelBeam(np.arange(60) * np.pi / 60, 48, 1.0)
        >>> grid = VolumeGrid((32, 32), 1.0)
        >>> water = torch.zeros(grid.shape).index_put([torch.tensor([16])], torch.tensor(0.02))
        >>> lines = Projector(geometry, grid)(water)
        >>> scan = Scan.from_line_integrals(lines, geometry, photons=1e6, mu_water=0.02)
        >>> volume = reconstruct(scan, grid, "fbp", kernel="soft")
        >>> volume.data.shape, volume.unit, volume.report["kernel"]
        (torch.Size([32, 32]), 'HU', 'soft')
    """
    scans = [scan] if isinstance(scan, Scan) else list(scan) if isinstance(scan, Sequence) else []
    if not scans or not all(isinstance(s, Scan) for s in scans):
        raise TypeError(
            f"scan must be a Scan or a non-empty sequence of scans, got {type(scan).__name__}"
        )
    if not isinstance(grid, VolumeGrid) or (grid.ndim != 3 and scans[0].geometry.has_rows):
        raise ValueError(f"grid must be a (z, y, x) VolumeGrid, got {grid!r}")
    if motion is not None and not isinstance(scan, Scan):
        given: dict[str, Any] = {"progress": progress, "device": device, "motion": motion}
        return [reconstruct(s, grid, method, **given, **options) for s in scans]
    there = _device(scans, device)
    for s in scans:
        require_light(s.zero_fraction)
        if motion is None:
            require_directions(s.geometry)
    name, named = split_method(method)
    twice = sorted(named.keys() & options.keys())
    if twice:
        raise TypeError(
            f"{', '.join(twice)} is given in the method {method!r} and as an argument: leave out "
            "one of them"
        )
    if "weights" in named:
        from recon.mbir.mbir import Mbir

        if "network" in options:
            raise TypeError(
                f"network is given as well as the weights of the method {method!r}: leave out one"
            )
        named["network"] = Mbir.load(named.pop("weights"), network=named.pop("network", None))
    chosen: dict[str, Any] = {**named, **options}
    whole = [_prepared(_here(s)) for s in scans]
    scans = [_there(s, there) for s, _ in whole]
    for text in {text for _, texts in whole for text in texts}:
        _LOG.warning("%s", text)
    methods: dict[str, Any] = {"fbp": _fbp, "pwls": reconstruct_pwls, "mbir": _mbir}
    volumes: list[Volume] = []
    logged: set[str] = set()
    began = time.perf_counter()
    moves: dict[str, Any] = {}
    if motion is not None:
        warned, moves = _moving(motion, name, scans[0], grid, chosen)
        whole = [(s, [*texts, *warned]) for s, texts in whole]
    path = chosen.get("motion", getattr(chosen.get("problem"), "motion", None))
    found_of = methods[name](scans, grid, progress or (lambda _: None), **chosen)
    for batch in _within_memory(found_of, there):
        seconds = round((time.perf_counter() - began) / len(batch), 3)
        for solution in batch:
            s, before = whole[len(volumes)]
            volume, report, found = _finished(s, grid, solution, path)
            report |= moves | {
                "seconds": seconds,
                "cells_mm": finite_cells(s.geometry),
                "dead_readings": dead_readings(s),
            }
            if there.type != "cpu":
                report |= {"device": str(there), "on_cpu": _on_cpu(name, s, report)}
            report["warnings"] = [*before, *found]
            for text in found:
                if text not in logged:
                    _LOG.warning("%s", text)
            logged.update(found)
            volumes.append(Volume(volume, grid, report, unit=s.unit))
        began = time.perf_counter()
    return volumes[0] if isinstance(scan, Scan) else volumes


def _moving(
    motion: object, method: str, scan: Scan, grid: VolumeGrid, chosen: dict[str, Any]
) -> tuple[list[str], dict[str, Any]]:
    """Put the inset's path into the options of a method; its warnings, and its report."""
    from recon.motion import path_of

    if chosen.get("problem") is not None:
        raise ValueError(
            "problem and motion are both given: give problem.with_motion(path), or motion alone"
        )
    if scan.window is None:
        raise ValueError(
            "motion needs the exterior of the inset, which stands still: acquire the scan with "
            "region="
        )
    path, found = path_of(motion, _here(scan), grid)
    warned, report = ([], {}) if found is None else (found.warnings, {"motion": found.report()})
    if found is not None and not found.held:
        return warned, report
    if method == "fbp":
        chosen["motion"] = path
        return warned, report
    from recon.least_squares.inset_problem import InsetProblem

    if method == "mbir":
        from recon.mbir.mbir import Mbir, working_grid

        chosen["network"] = chosen.get("network") or Mbir.load()
        grid = working_grid(grid, chosen["network"].voxel_mm)
    chosen["problem"] = InsetProblem(scan, grid).with_motion(path)
    return warned, report


def _device(scans: Sequence[Scan], device: str | int | torch.device | None) -> torch.device:
    """Where to compute: on the device that is named, else where the scans lie."""
    if device is not None:
        return device_of(device)
    return same_device(**{f"scan {i}": s.counts for i, s in enumerate(scans)})


def _here(scan: Scan) -> Scan:
    """The scan on the CPU, where its readings are tested and repaired."""
    if scan.device.type == "cpu":
        return scan
    return once(scan, "on the CPU", lambda: scan.to("cpu"))


def _there(scan: Scan, device: torch.device) -> Scan:
    """The scan on a device, kept with the one that it is a copy of."""
    if scan.device == device:
        return scan
    return once(scan, "moved", lambda: scan.to(device), str(device))


def _within_memory(batches: Iterator[T], device: torch.device) -> Iterator[T]:
    """The same batches; a full device is reported in one sentence."""
    try:
        yield from batches
    except torch.OutOfMemoryError as error:
        reason = str(error).partition(". ")[0]
        raise ValueError(
            f"{device} has too little memory ({reason}): take larger or fewer voxels, fewer "
            'volumes at a time, or device="cpu"'
        ) from error


def _on_cpu(method: str, scan: Scan, report: JsonObject) -> list[str]:
    """What was computed on the CPU although the rest was not."""
    found = ["tests and repair of the readings"]
    if method != "fbp":
        if scan.geometry.has_rows and "work_grid" not in report:
            found.append("fit of the FFT model of an inset")
        if "vessel" in report or "tissues" in report:
            found.append("the vessel model")
        if not scan.noise_free:
            found.append("test of what the volume leaves of the readings")
    return found


def _prepared(scan: Scan) -> tuple[Scan, list[str]]:
    """A scan with its readings repaired, and what they say against their description; the work of
    the first method on it."""

    def inspect_readings() -> tuple[Scan | None, list[str]]:
        repaired, texts = repair_defects(scan)
        return None if repaired is scan else repaired, [*texts, *reading_warnings(repaired)]

    repaired, texts = once(scan, "readings", inspect_readings)
    return scan if repaired is None else repaired, texts


def _consistency(scan: Scan, grid: VolumeGrid, motion: object) -> list[str]:
    path = None if motion is None else check_motion(motion, scan.geometry.views, 3)
    key = None if path is None else path.tobytes()
    return once(scan, "consistency", lambda: consistency_warnings(scan, grid, path), grid, key)


def _finished(
    scan: Scan, grid: VolumeGrid, solution: Result, motion: object
) -> tuple[Tensor, JsonObject, list[str]]:
    """The volume in the scan's unit, the report with what the tests of the data say, and all
    warnings; ``motion`` of the inset that the method took into account, or None."""
    values, report, tests = solution.volume.to(torch.float32), dict(solution.report), solution.tests
    if tests:
        report.setdefault("chi2", sum(t.chi2 for t in tests) / len(tests))
        report["residual_p"] = {
            n: min(t.p_values.get(n, 1.0) for t in tests) for n in tests[0].p_values
        }
    failed: list[str] = []
    consistency = tested(
        "the test of the scan against its description", failed, _consistency, scan, grid, motion
    )
    found = [text for texts in consistency for text in texts]
    found += [*solution.warnings, *(text for t in tests for text in t.findings)]
    # MBIR says itself what lies beyond its training.
    if report["method"] != "mbir" and scan.unit == "HU":
        found += [
            text
            for texts in tested("the search for metal", failed, metal_warnings, values)
            for text in texts
        ]
    found += failed
    data = values if scan.unit == "HU" else from_hu(values, scan.linearisation.mu_ref)
    return data, report, list(dict.fromkeys(found))


def _fbp(
    scans: Sequence[Scan],
    grid: VolumeGrid,
    progress: Callable[[float], None],
    *,
    kernel: str = "standard",
    motion: object = None,
) -> Iterator[list[Result]]:
    if not isinstance(kernel, str):
        raise TypeError(
            f"kernel must be one name, got {kernel!r}; recon.analytic.inset.InsetFbp takes "
            "several at once"
        )
    run = InsetFbp(scans[0], [grid], [kernel], motion=motion)
    warnings, notes = [*run.warnings, *sampling_warnings(run.circle)], view_notes(run.circle)
    report = {"method": "fbp", "kernel": kernel, **({"notes": notes} if notes else {})}
    for i, s in enumerate(scans):
        yield [Result(run(s)[0][0], report, warnings)]
        progress((i + 1) / len(scans))


def _mbir(
    scans: Sequence[Scan],
    grid: VolumeGrid,
    progress: Callable[[float], None],
    *,
    known: Known | None = None,
    vessel: bool = False,
    tissues: bool = False,
    point: Sequence[float] | None = None,
    vessel_prior: VesselPrior | None = None,
    **options: Any,
) -> Iterator[list[Result]]:
    """MBIR, with the applications that model what is known of the object: a vessel's outlines or
    tissues."""
    if vessel or tissues or point is not None or vessel_prior is not None:
        # Loaded where somebody asks for it alone.
        from recon.vessel.known import known_vessel

        if known is not None:
            raise TypeError("known is given as well as vessel or tissues: leave out one of them")
        known = known_vessel(vessel, tissues, point, vessel_prior)
    return reconstruct_mbir(scans, grid, progress, known=known, **options)
