"""Consistency checks of a scan, made once when it is constructed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import ConeBeam, Geometry
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.validate import UNITS, checked, choice, number, whole

__all__ = ["check_exposure", "check_scan"]


@checked
def check_exposure(exposure_s: float | None) -> None:
    """Raise ``ValueError`` unless the exposure is a finite time > 0 s, or None (noise free)."""
    if exposure_s is not None:
        number("exposure_s", exposure_s, positive=True, unit="s")


@checked
def check_scan(scan: Any) -> None:
    """Refuse a scan whose members do not fit together; see :class:`torchpcct.scan.Scan`.

    Raises:
        ValueError, TypeError: see there.
    """
    _check_kinds(scan)
    g, w = scan.geometry, scan.window
    axes = len(g.shape)
    if w is not None and not isinstance(g, ConeBeam):
        raise TypeError(f"geometry must be a ConeBeam in a scan with a window, got {type(g).__name__}")
    cells = g.shape if w is None else w.shape
    if tuple(scan.counts.shape[-axes:]) != cells or scan.counts.ndim not in (axes, axes + 1):
        raise ValueError(f"counts have shape {tuple(scan.counts.shape)}, expected (…, {cells})")
    expected_air = (*scan.counts.shape[:-axes], *g.shape[1:])
    if tuple(scan.air.shape) != expected_air:
        raise ValueError(f"air has shape {tuple(scan.air.shape)}, expected {expected_air}")
    if (w is None) != (scan.surround is None):
        raise ValueError("a windowed scan needs the readings of its surround, a full scan has none")
    if w is not None and w.views != g.views:
        raise ValueError(f"the window has {w.views} views, the geometry {g.views}")
    if w is not None and not DetectorWindow.full(g).holds(w):
        raise ValueError(f"the window reaches beyond the detector of {g.rows} rows × {g.columns} columns")
    if scan.linearisation.scale.size != g.columns:
        raise ValueError(
            f"the water correction is that of {scan.linearisation.scale.size} columns, the detector has {g.columns}"
        )
    if scan.surround is not None and scan.surround.shape != scan.air.shape:
        raise ValueError(f"surround has shape {tuple(scan.surround.shape)}, air {tuple(scan.air.shape)}")
    check_exposure(scan.exposure_s)
    low, high = (float(v) for v in torch.aminmax(scan.counts)) if scan.counts.numel() else (0.0, 0.0)
    if not (np.isfinite(low) and np.isfinite(high)):  # aminmax propagates NaN
        bad = int((~torch.isfinite(scan.counts)).sum())
        raise ValueError(f"{bad} readings are NaN or Inf: mask dead cells and interpolate them before")
    # Electronic noise and dark frames make readings of starved rays negative.
    noiseless = scan.quantum is not None and scan.electronic_noise == 0
    if low < 0 and (scan.counting or scan.noise_free or noiseless):
        raise ValueError(f"counts must not be negative, the lowest is {low}: give raw counts, not line integrals")
    if high == 0:
        raise ValueError("all counts are zero: the scan holds no signal (exposure too low, or beam blocked)")
    for name, readings in (("air", scan.air), ("surround", scan.surround)):
        if readings is not None and not bool(((readings > 0) & torch.isfinite(readings)).all()):
            raise ValueError(f"{name} readings must be finite and greater than 0 in every cell: mask dead cells before")
    choice("unit", scan.unit, UNITS)
    if scan.dead is not None and scan.dead.shape != scan.counts.shape:
        raise ValueError(f"dead has shape {tuple(scan.dead.shape)}, counts {tuple(scan.counts.shape)}")
    if scan.flux is not None and tuple(scan.flux.shape) != (g.views,):
        raise ValueError(f"flux has shape {tuple(scan.flux.shape)}, expected ({g.views},)")
    _check_noise_model(scan)


def _check_kinds(scan: Any) -> None:
    for name, kind in (("geometry", Geometry), ("linearisation", WaterLinearisation)):
        if not isinstance(getattr(scan, name), kind):
            raise TypeError(f"{name} must be a {kind.__name__}, got {type(getattr(scan, name)).__name__}")
    if scan.window is not None and not isinstance(scan.window, DetectorWindow):
        raise TypeError(f"window must be a DetectorWindow or None, got {type(scan.window).__name__}")
    for name in ("counts", "air", "surround", "quantum"):
        values = getattr(scan, name)
        if values is None and name in ("surround", "quantum"):
            continue
        if not isinstance(values, Tensor) or not values.is_floating_point():
            found = values.dtype if isinstance(values, Tensor) else type(values).__name__
            raise TypeError(f"{name} must be a floating point tensor, got {found}: use torch.as_tensor(…).float()")
    if scan.seed is not None:
        whole("seed", scan.seed, low=0)
    if not isinstance(scan.info, Mapping):
        raise TypeError(f"info must be a mapping of JSON values, got {type(scan.info).__name__}")


def _check_noise_model(scan: Any) -> None:
    number("electronic_noise", scan.electronic_noise, low=0.0, unit="keV")
    if scan.quantum is None:
        return
    if scan.counting:
        raise ValueError("quantum belongs to energy-integrating scans (counting=False): counts are Poisson")
    if scan.quantum.shape != scan.counts.shape:
        raise ValueError(f"quantum has shape {tuple(scan.quantum.shape)}, counts {tuple(scan.counts.shape)}")
    if not bool(((scan.quantum > 0) & torch.isfinite(scan.quantum)).all()):
        raise ValueError("quantum must be finite and greater than 0 keV in every reading")
