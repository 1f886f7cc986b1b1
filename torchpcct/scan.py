"""A scan: what the detector read, what it reads in air, and how to turn the two into line integrals."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpcct import counting_noise as noise
from torchpcct.detector_window import DetectorWindow
from torchpcct.files import VERSION, read_hdf5, written_whole
from torchpcct.geometry import ConeBeam
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.validate import number

__all__ = ["NOISE_FREE_EXPOSURE_S", "Scan"]

NOISE_FREE_EXPOSURE_S = 1.0
"""The exposure that the expected readings of a noise-free scan stand for."""

_VERSION = 2
"""2: energy-integrating scans with their noise model. Counting scans are still written as version 1."""
# Compress in blocks of whole views: fast to write, and a window of views can be read without the rest.
_HDF5_COMPRESSION = {"compression": "lzf", "shuffle": True}


@dataclass(frozen=True)
class Scan:
    """Readings of one scan.

    Args:
        counts: ``(views, rows, columns)``, spectral ``(bins, views, rows, columns)``, float32. Counts if noisy
            (``exposure_s`` given); else expected counts for :data:`NOISE_FREE_EXPOSURE_S`. With a window, only its
            cells: ``(..., views, window.rows, window.columns)``.
        air: ``(rows, columns)`` or ``(bins, rows, columns)`` expected readings without the object, same exposure.
        geometry: the scan geometry of the WHOLE detector.
        linearisation: water beam-hardening correction of the scanner.
        exposure_s: duration of the scan in s; None: noise free.
        seed: seed of the noise; None: noise free.
        window: the part of the detector that was kept; None: all of it.
        surround: ``air``-shaped expected readings of every cell outside the window, the same in all views; given if
            and only if ``window`` is.
        counting: True: readings are photon counts with Poisson noise. False: an energy-integrating detector's signal.
        info: provenance (scanner, plan, versions), JSON values.
        quantum: energy integrating only: variance over expectation of every stored reading without electronic noise,
            in keV (Σ s² N̄ / Σ s N̄ over the quanta that reach the detector behind the object), the shape of ``counts``.
            None: the noise of this signal is not known.
        electronic_noise: energy integrating only: standard deviation in keV that the electronics add to every reading,
            whatever the exposure.

    Raises:
        ValueError: NaN, Inf or negative counts, no counts at all, air readings ≤ 0, an exposure ≤ 0, shapes that do
            not fit the geometry.
    """

    counts: Tensor
    air: Tensor
    geometry: ConeBeam
    linearisation: WaterLinearisation
    exposure_s: float | None = None
    seed: int | None = None
    window: DetectorWindow | None = None
    surround: Tensor | None = None
    counting: bool = True
    info: Mapping[str, Any] = field(default_factory=dict)
    quantum: Tensor | None = None
    electronic_noise: float = 0.0

    def __post_init__(self) -> None:
        g, w = self.geometry, self.window
        cells = g.shape if w is None else w.shape
        if tuple(self.counts.shape[-3:]) != cells or self.counts.ndim not in (3, 4):
            raise ValueError(f"counts have shape {tuple(self.counts.shape)}, expected (…, {cells})")
        expected_air = (*self.counts.shape[:-3], g.rows, g.columns)
        if tuple(self.air.shape) != expected_air:
            raise ValueError(f"air has shape {tuple(self.air.shape)}, expected {expected_air}")
        if (w is None) != (self.surround is None):
            raise ValueError("a windowed scan needs the readings of its surround, a full scan has none")
        if w is not None and w.views != g.views:
            raise ValueError(f"the window has {w.views} views, the geometry {g.views}")
        if self.surround is not None and self.surround.shape != self.air.shape:
            raise ValueError(f"surround has shape {tuple(self.surround.shape)}, air {tuple(self.air.shape)}")
        check_exposure(self.exposure_s)
        low, high = (float(v) for v in torch.aminmax(self.counts)) if self.counts.numel() else (0.0, 0.0)
        if not (np.isfinite(low) and np.isfinite(high)):  # aminmax propagates NaN
            bad = int((~torch.isfinite(self.counts)).sum())
            raise ValueError(f"{bad} readings are NaN or Inf: mask dead cells and interpolate them before")
        # Electronic noise makes readings of starved rays negative.
        if low < 0 and not (self.electronic_noise > 0 and not self.noise_free):
            raise ValueError(f"counts must not be negative, the lowest is {low}: give raw counts, not line integrals")
        if high == 0:
            raise ValueError("all counts are zero: the scan holds no signal (exposure too low, or beam blocked)")
        if not bool((self.air > 0).all()):
            raise ValueError("air readings must be greater than 0 in every cell: mask dead cells before")
        self._check_noise_model()

    def _check_noise_model(self) -> None:
        number("electronic_noise", self.electronic_noise, low=0.0, unit="keV")
        if self.quantum is None:
            return
        if self.counting:
            raise ValueError("quantum belongs to energy-integrating scans (counting=False): counts are Poisson")
        if self.quantum.shape != self.counts.shape:
            raise ValueError(f"quantum has shape {tuple(self.quantum.shape)}, counts {tuple(self.counts.shape)}")
        if not bool((self.quantum > 0).all()):
            raise ValueError("quantum must be greater than 0 keV in every reading")

    @property
    def noise_free(self) -> bool:
        """Whether the readings are expectations."""
        return self.exposure_s is None

    @property
    def zero_fraction(self) -> float:
        """Share of readings that registered nothing (energy integrating: 0 or less)."""
        return float((self.counts <= 0).float().mean())

    def with_noise(self, exposure_s: float, seed: int) -> Scan:
        """A noisy realisation of a noise-free scan.

        The noise of a reading depends only on ``seed`` and the reading's place on the full detector, so a windowed
        scan carries the same noise as the full one. Counts are Poisson; an energy-integrating signal is compound
        Poisson with the second moment of the transmitted spectrum (:func:`torchpcct.counting_noise.compound_poisson`),
        and electronic noise is added.

        Raises:
            ValueError: the scan is noisy already; ``exposure_s`` ≤ 0; a negative seed; an energy-integrating scan that
                does not hold ``quantum``.
        """
        if not self.noise_free:
            raise ValueError("with_noise needs a noise-free scan (acquire with exposure_s=None), this one is noisy")
        self._require_noise_model()
        check_exposure(exposure_s)
        scale = exposure_s / NOISE_FREE_EXPOSURE_S
        index = self._first_index()
        if self.quantum is None:
            readings = noise.poisson(self.counts, index, seed, scale)
        else:
            readings = noise.compound_poisson(self.counts, self.quantum, index, seed, scale, self.electronic_noise)
        return replace(
            self,
            counts=readings,
            air=self.air * scale,
            surround=None if self.surround is None else self.surround * scale,
            exposure_s=float(exposure_s),
            seed=int(seed),
        )

    def crop(self, window: DetectorWindow) -> Scan:
        """The same scan on a part of its window; its noise is that of the whole.

        Raises:
            ValueError: the scan is not windowed, or ``window`` reaches beyond its window.
        """
        if self.window is None:
            raise ValueError("only a windowed scan can be cropped: acquire it with region=")
        return replace(
            self,
            counts=self.window.crop(self.counts, window),
            quantum=None if self.quantum is None else self.window.crop(self.quantum, window),
            window=window,
        )

    def _require_noise_model(self) -> None:
        if not self.counting and self.quantum is None:
            raise ValueError(
                "this energy-integrating scan does not hold the energy of its quanta, so its noise is not known: "
                "simulate it with acquire(), or give quantum="
            )

    def relative_variance(self, exposure_s: float) -> Tensor:
        """Variance over squared expectation of every reading at an exposure, shape and dtype of ``counts``.

        It is the variance of ``ln`` of the reading (delta method). Counting: 1 / N̄. Energy integrating:
        q / S̄ + (electronic noise / S̄)².

        Raises:
            ValueError: the scan is noisy (its expectations are needed); ``exposure_s`` ≤ 0; an energy-integrating scan
                that does not hold ``quantum``.
        """
        if not self.noise_free:
            raise ValueError("the variance follows from expected readings: give the noise-free scan")
        number("exposure_s", exposure_s, positive=True, unit="s")
        self._require_noise_model()
        inverse = (self.counts * (exposure_s / NOISE_FREE_EXPOSURE_S)).reciprocal_()
        if self.quantum is None:
            return inverse
        variance = inverse * self.quantum
        return variance.add_(inverse.mul_(self.electronic_noise).square_()) if self.electronic_noise else variance

    def _first_index(self) -> Any:
        """Global index of the first reading of every detector row held in ``counts``."""
        g, w = self.geometry, self.window or DetectorWindow.full(self.geometry)
        line = np.arange(g.views)[:, None] * g.rows + w.first_row + np.arange(w.rows)
        index = line * g.columns + w.first_column[:, None]
        bins = self.counts.shape[0] if self.counts.ndim == 4 else 1
        return (np.arange(bins)[:, None, None] * math.prod(g.shape) + index).reshape(-1)

    def _at_window(self, cells: Tensor) -> Tensor:
        """``(..., rows, columns)`` values of the cells as seen by the stored readings, ``(..., views | 1, r, c)``."""
        if self.window is None:
            return cells.unsqueeze(-3)
        return self.window.take(cells)

    def line_integrals(self) -> Tensor:
        """Water-linearised line integrals of the stored readings, shape and dtype of ``counts``, dimensionless.

        ``ln(air) − ln(counts + ½)`` for counts (½ removes the bias of the logarithm to second order in 1 / counts
        and keeps zero counts finite), ``ln(air) − ln(counts)`` for expectations; then the scanner's water correction,
        so that a path through t mm of water reads ``mu_ref · t``. The shift of an energy-integrating signal S is
        variance / (2 S) = q / 2 + electronic noise² / (2 S); starved readings are held at q / 2, which a counting
        detector with quanta of q would read at zero counts.

        Raises:
            ValueError: a noisy energy-integrating scan that does not hold ``quantum``.
        """
        p = self._positive().log_().neg_().add_(self._at_window(self.air.log()))
        return self.linearisation.apply(p, self.window)

    def _positive(self) -> Tensor:
        """A copy of the readings, shifted so that the logarithm is finite and nearly unbiased."""
        if self.noise_free:
            return self.counts.clone()
        if self.counting:
            return self.counts + 0.5
        self._require_noise_model()
        assert self.quantum is not None
        half = self.quantum / 2
        shifted = self.counts + half
        sigma = self.electronic_noise
        if sigma > 0:
            shifted += (sigma**2 / 2) / self.counts.clamp(min=sigma)
        return torch.maximum(shifted, half)

    def surround_line_integrals(self) -> Tensor:
        """Water-linearised line integrals of the surround (noise free), ``(..., rows, columns)``.

        Raises:
            ValueError: the scan is not windowed.
        """
        if self.surround is None:
            raise ValueError("a full scan has no surround: use line_integrals()")
        return self.linearisation.apply(torch.log(self.air) - torch.log(self.surround))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write HDF5; the file appears under its name only when it is complete."""
        import h5py

        g = self.geometry
        with written_whole(path) as part, h5py.File(part, "w") as file:
            version = 1 if self.counting else _VERSION
            file.attrs.update(format="torchpcct-scan", version=version, software=f"torchpcct {VERSION}")
            file.attrs["counting"] = self.counting
            file.attrs["info"] = json.dumps(dict(self.info), default=str)
            if self.exposure_s is not None:
                file.attrs["exposure_s"] = self.exposure_s
            if self.seed is not None:
                file.attrs["seed"] = self.seed
            chunk = (*(1,) * (self.counts.ndim - 2), *self.counts.shape[-2:])
            # Counts are whole numbers: as integers they compress, and they stay exact.
            whole = self.counting and not self.noise_free and float(self.counts.max()) < 2**31
            data = self.counts.to(torch.int32) if whole else self.counts
            file.create_dataset("counts", data=data.numpy(), chunks=chunk, **_HDF5_COMPRESSION)
            file.create_dataset("air", data=self.air.numpy())
            if self.quantum is not None:
                file.create_dataset("quantum_kev", data=self.quantum.numpy(), chunks=chunk, **_HDF5_COMPRESSION)
            file.attrs["electronic_noise_kev"] = self.electronic_noise
            geometry = file.create_group("geometry")
            geometry["angles_rad"] = g.angles
            geometry.attrs.update(
                sod_mm=g.sod, sdd_mm=g.sdd, columns=g.columns, rows=g.rows, pitch_mm=g.pitch, offset_mm=g.offset
            )
            geometry.attrs["detector"] = g.detector
            self.linearisation.save(file.create_group("linearisation"))
            if self.window is not None and self.surround is not None:
                window = file.create_group("window")
                window["first_column"] = self.window.first_column
                window["surround"] = self.surround.numpy()
                window.attrs.update(columns=self.window.columns, first_row=self.window.first_row, rows=self.window.rows)
            # Written last: a file without it was cut off.
            file.attrs["complete"] = True

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Scan:
        """Read a scan written by :meth:`save`.

        Raises:
            FileNotFoundError: no such file.
            ValueError: the file is truncated, is no torchpcct scan, or is of a newer format.
        """
        with read_hdf5(path, "scan") as file:
            if int(file.attrs["version"]) > _VERSION:
                raise ValueError(
                    f"{path} has format version {file.attrs['version']}, this software reads up to {_VERSION}: "
                    "update torchpcct"
                )
            if not file.attrs.get("complete", False):
                raise ValueError(f"{path} was not written to its end: simulate it again")
            return cls._from_file(file)

    @classmethod
    def _from_file(cls, file: Any) -> Scan:
        a = file["geometry"].attrs
        geometry = ConeBeam(
            file["geometry/angles_rad"][()], float(a["sod_mm"]), float(a["sdd_mm"]), int(a["columns"]),
            int(a["rows"]), tuple(a["pitch_mm"]), tuple(a["offset_mm"]), str(a["detector"]),
        )  # fmt: skip
        window = surround = None
        if "window" in file:
            w = file["window"]
            window = DetectorWindow(
                w["first_column"][()], int(w.attrs["columns"]), int(w.attrs["first_row"]), int(w.attrs["rows"])
            )
            surround = torch.from_numpy(w["surround"][()])
        return cls(
            counts=torch.from_numpy(file["counts"][()]).to(torch.float32),
            air=torch.from_numpy(file["air"][()]),
            geometry=geometry,
            linearisation=WaterLinearisation.load(file["linearisation"]),
            exposure_s=float(file.attrs["exposure_s"]) if "exposure_s" in file.attrs else None,
            seed=int(file.attrs["seed"]) if "seed" in file.attrs else None,
            window=window,
            surround=surround,
            counting=bool(file.attrs["counting"]),
            info=json.loads(file.attrs["info"]),
            quantum=torch.from_numpy(file["quantum_kev"][()]) if "quantum_kev" in file else None,
            electronic_noise=float(file.attrs.get("electronic_noise_kev", 0.0)),
        )


def check_exposure(exposure_s: float | None) -> None:
    """Raise ``ValueError`` unless the exposure is a finite time > 0 s, or None (noise free)."""
    if exposure_s is not None:
        number("exposure_s", exposure_s, positive=True, unit="s")
