"""What a wrong calibration of the decomposition costs: noise-free scans decomposed with a model
that is not theirs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from recon.analytic.inset import InsetFbp
from recon.study.paper import published as paper
from recon.study.spectral.scan import BODIES, SpectralScan, Tissues
from torchpcct.scan import NOISE_FREE_EXPOSURE_S
from torchpcct.scanner import Scanner, SiliconDetector, TransportedSilicon
from torchpcct.spectral import (
    MMD_TISSUES,
    SpectralModel,
    decompose_exterior,
    decompose_scan,
    vmi,
)

if TYPE_CHECKING:
    from torchpcct.typing import JsonObject

SHOWN_KEV = (52.0, 70.0)
"""Energies at which wrong calibrations are compared: the paper's best, and one where contrasts
are usual."""
_PURE = 0.999
"""Volume fraction of blood in the voxels that count as lumen."""


@dataclass(frozen=True)
class CalibrationError:
    """How a calibration is wrong: a decomposition knows tube, filters and detector only by it.

    The scan is always the true one and the model is wrong, never the other way round. Thresholds
    lower than assumed are the energy axis of a counting detector: pulse heights drift with the
    electronics' gain and offset. These and a softer spectrum are seen by the air scan of every
    calibration, which sets the assumed counts in air to the measured ones bin by bin; what is left
    is the wrong *shape* of the spectra. Without that scan the error is larger: both are given.

    Args:
        name: in tables.
        threshold_kev: assumed less true thresholds.
        voltage_kv: assumed less true tube voltage.
        gain: relative error of the counts since the air scan.
        bin: the energy bin that has it; None: all.
        air_scan: whether the assumed counts in air are those that the true scanner measures.
        transported: whether the scan's photons interact more than once: 1, and the decomposition
            does not know: 2, and it does, from other photons; 0: they do not.
    """

    name: str
    threshold_kev: float = 0.0
    voltage_kv: float = 0.0
    gain: float = 0.0
    bin: int | None = None
    air_scan: bool = True
    transported: int = 0

    def assumed(self, scanner: Scanner) -> Scanner:
        """The scanner that the decomposition believes in, if ``scanner`` is the calibrated one."""
        detector = scanner.detector
        assert isinstance(detector, SiliconDetector)
        thresholds = tuple(t + self.threshold_kev for t in detector.thresholds_kev)
        source = replace(scanner.source, kvp=scanner.source.kvp + self.voltage_kv)
        return scanner.replace(detector=replace(detector, thresholds_kev=thresholds), source=source)


def calibration_cases(s: Any, bins: int) -> list[CalibrationError]:
    """The errors of a study's settings, none first."""
    kev, kv, gain = s.threshold_error_kev, s.voltage_error_kv, s.gain_error
    errors = [
        CalibrationError("none"),
        CalibrationError(f"thresholds {kev:g} keV lower", threshold_kev=kev),
        CalibrationError(
            f"thresholds {kev:g} keV lower, no air scan", threshold_kev=kev, air_scan=False
        ),
        CalibrationError(f"tube voltage {kv:g} kV lower", voltage_kv=kv),
        CalibrationError(
            f"tube voltage {kv:g} kV lower, no air scan", voltage_kv=kv, air_scan=False
        ),
        CalibrationError(f"{100 * gain:g} % more counts in all bins", gain=gain),
    ]
    errors += [
        CalibrationError(f"{100 * gain:g} % more counts in bin {k + 1}", gain=gain, bin=k)
        for k in range(bins)
    ]
    if s.transport_photons:
        errors += [
            CalibrationError("photons interact repeatedly", transported=1),
            CalibrationError(
                "photons interact repeatedly, no air scan", transported=1, air_scan=False
            ),
            CalibrationError(
                "photons interact repeatedly, known from other photons", transported=2
            ),
        ]
    return errors


def decomposed(
    scan: SpectralScan, error: CalibrationError, calibrated: Scanner
) -> tuple[Tensor, float]:
    """Noise-free basis images of the true scan, ``(2, z, y, x)``, and the share of its rays that
    found no solution; ``calibrated``: the scanner that the decomposition knew before the error."""
    model = SpectralModel.of(error.assumed(calibrated), NOISE_FREE_EXPOSURE_S)
    air = torch.from_numpy(model.air).to(scan.clean.air)
    factor = air / scan.clean.air if error.air_scan else torch.ones_like(air)
    factor[slice(None) if error.bin is None else error.bin] *= 1.0 + error.gain
    true = scan.clean
    assert true.exterior is not None
    counts = true.counts * scan.window.take(factor).to(true.counts)
    # The model's own counts in air, so that it takes the scan for its own.
    believed = replace(
        true, counts=counts, exterior=true.exterior * factor.to(true.exterior), air=air
    )
    found = decompose_scan(believed, model, tolerance=1e-3)
    fbp = InsetFbp(
        true, [scan.grid], [scan.settings.kernel], exterior=decompose_exterior(believed, model)
    )
    return fbp.images(found.line_integrals)[0][0], float((~found.converged).double().mean())


def calibration_costs(s: Any, tissues: Tissues, progress: Callable[[float], None]) -> JsonObject:
    """HU of the tissues, contrast and tissue maps with every wrong calibration; the noise of the
    study's own scan, of which ``tissues`` are, is the unit of the maps' distances.

    Returns:
        JSON values: ``cases``, one row per error (the first is none) with HU by energy and tissue,
        contrast, Dice, and their costs, the difference to the first.
    """
    few = replace(s, views=s.calibration_views)
    # Fewer views stand for the paper's scan, thinned out: each sees as much of the gantry's turn.
    full = max(paper.FULL_VIEWS["PCCT"], s.calibration_views)
    scans = {0: SpectralScan(few, lambda f: progress(0.3 * f), full_views=full)}
    if s.transport_photons:
        silicon = TransportedSilicon("spectral", photons=s.transport_photons, transport_seed=s.seed)
        scans[1] = SpectralScan(few, lambda f: progress(0.3 + 0.3 * f), silicon, full)
    plain = scans[0].scanner
    other = (
        plain.replace(detector=replace(silicon, transport_seed=s.seed + 1))
        if s.transport_photons
        else plain
    )
    errors, rows = calibration_cases(s, plain.detector.bins), []
    for k, error in enumerate(errors):
        scan, calibrated = (
            scans[min(error.transported, 1)],
            other if error.transported == 2 else plain,
        )
        images, failed = decomposed(scan, error, calibrated)
        rows.append({**asdict(error), "failed": failed, **_read(scan, tissues, images)})
        progress(0.6 + 0.4 * (k + 1) / len(errors))
    base = rows[0]
    for row in rows:
        row["cost_hu"] = {
            e: {t: v - base["hu"][e][t] for t, v in hu.items()} for e, hu in row["hu"].items()
        }
        row["cost_dice"] = {t: v - base["dice"][t] for t, v in row["dice"].items()}
    return {"views": s.calibration_views, "energies_kev": list(SHOWN_KEV), "cases": rows}


def _read(scan: SpectralScan, tissues: Tissues, images: Tensor) -> JsonObject:
    """HU of the tissues and of the contrast by energy, and Dice coefficients of the tissue map."""
    lumen = torch.from_numpy(
        scan.scene.volume_fractions(scan.grid)[scan.scene.index(BODIES["blood_iodine"])] > _PURE
    )
    hu = {}
    for energy in SHOWN_KEV:
        volume = vmi(images, scan.basis, [energy])[0].double()
        core, fibrous = (float(roi(volume)) for roi in scan.rois.on(scan.grid))
        hu[f"{energy:g}"] = {
            "blood": float(volume[lumen].mean()),
            "core": core,
            "fibrous": fibrous,
            "fat": float(volume[scan.fat].mean()),
            "contrast": fibrous - core,
        }
    return {"hu": hu, "dice": dict(zip(MMD_TISSUES, tissues.dice(images), strict=True))}
