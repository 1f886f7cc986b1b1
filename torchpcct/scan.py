"""A scan: what the detector read, what it reads in air, and how to turn the two into line
integrals."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchpcct import counting_noise as noise
from torchpcct.detector_window import DetectorWindow
from torchpcct.devices import device_of, same_device
from torchpcct.files import read_hdf5
from torchpcct.geometry import ConeBeam, Geometry, VolumeGrid
from torchpcct.readings import (
    counted,
    interpolate_dead,
    inverse_variance,
    log_bias,
    logged,
    many,
    smoothed,
)
from torchpcct.scan_file import scan_fields, write_scan
from torchpcct.scan_grid import grid_of
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.validate import UNITS, checked, choice, now_called, number, whole

if TYPE_CHECKING:
    from torchpcct.readings import ReadingFields
    from torchpcct.scanner.scanner import Scanner
    from torchpcct.typing import Ints, Views

__all__ = ["Scan"]

_LONGEST_S = 1e12
"""Exposures at most: 30 000 years."""
NOISE_FREE_EXPOSURE_S = 1.0
"""The exposure that the expected readings of a noise-free scan stand for."""
_FOLLOWED = 1000.0
"""Photons of a reading below which a weight that follows its noise moves the mean of a fit: the
reading is a fifth of the mean about it, so the line integral is off by -0.2 / photons: of 100 by
0.4 HU behind 20 cm of water."""
_TENSORS = ("counts", "air", "exterior", "quantum", "flux", "dead")
"""Members that lie on a device."""


@dataclass(frozen=True)
class Scan:
    """Readings of one scan.

    Args:
        counts: ``(views, rows, columns)``, spectral ``(bins, views, rows, columns)``, float32; of a
            detector without rows ``(views, columns)`` or, of several slices, ``(slices, views,
            columns)``. Counts if noisy (``exposure_s`` given); else expected counts for
            :data:`NOISE_FREE_EXPOSURE_S`. With a window, only its cells: ``(..., views,
            window.rows, window.columns)``.
        air: ``counts`` without the axis of views: expected readings without the object, same
            exposure.
        geometry: the scan geometry of the WHOLE detector.
        linearisation: water beam-hardening correction of the scanner.
        exposure_s: duration of the scan in s; None: noise free.
        seed: seed of the noise; None: noise free.
        window: the part of the detector that was kept; None: all of it.
        exterior: ``air``-shaped expected readings of every cell outside the window, the same in all
            views; given if and only if ``window`` is.
        counting: True: readings are photon counts with Poisson noise. False: an energy-integrating
            detector's signal, or energy bins summed with weights (:meth:`weighted`).
        info: provenance (scanner, plan, versions), JSON values.
        quantum: without Poisson noise only: variance over expectation of every stored reading
            without electronic noise, in keV (Σ s² N̄ / Σ s N̄ over the quanta that reach the
            detector behind the object) or, of weighted bins, in counts (Σ w² N̄ / Σ w N̄), the shape
            of ``counts``. None: the noise of this signal is not known.
        electronic_noise: energy integrating only: standard deviation in keV that the electronics
            add to every reading, whatever the exposure.
        flux: ``(views,)`` relative intensity of the source in each view; None: the same in all.
        dead: bool, the shape of ``counts``: readings that say nothing; None: there are none. They
            are interpolated from their neighbours in line integrals, and weigh nothing.
        logged: the readings come from given line integrals: their logarithm is taken as it is.
        unit: of volumes, "HU" or, where the attenuation of water is not known or means nothing,
            "mm^-1". "pixel^-1": the size of a cell is not known, all lengths are in cells.

    Scans of other scanners: :meth:`from_counts`, :meth:`from_line_integrals`,
    :mod:`torchpcct.formats`.

    Raises:
        ValueError: NaN, Inf or negative counts, no counts at all, readings in air or of the
            exterior that are NaN, infinite or ≤ 0, an exposure ≤ 0, shapes that do not fit the
            geometry, a water correction of another detector, a window beyond the detector.
        TypeError: a member of the wrong kind.
    """

    counts: Tensor
    air: Tensor
    geometry: Any  # a Geometry; most users know which
    linearisation: WaterLinearisation
    exposure_s: float | None = None
    seed: int | None = None
    window: DetectorWindow | None = None
    exterior: Tensor | None = None
    counting: bool = True
    info: Mapping[str, Any] = field(default_factory=dict)
    quantum: Tensor | None = None
    electronic_noise: float = 0.0
    flux: Tensor | None = None
    dead: Tensor | None = None
    logged: bool = False
    unit: str = "HU"
    region: VolumeGrid | None = None

    if not TYPE_CHECKING:  # to mypy every attribute would exist

        def __new__(cls, *args: object, **kwargs: object) -> Scan:
            if former := now_called(kwargs):
                raise TypeError(f"unknown argument of Scan{former}")
            return super().__new__(cls)

        def __getattr__(self, name: str) -> object:
            if former := now_called([name]):
                raise AttributeError(f"Scan has no attribute {name}{former}")
            return object.__getattribute__(self, name)  # Python's own error

    def __post_init__(self) -> None:
        _check(self)

    @classmethod
    @checked
    def from_counts(
        cls,
        readings: object,
        geometry: Geometry,
        *,
        air: object,
        dark: object = 0.0,
        gain: float | str | None = None,
        flux: object = None,
        dead: object = None,
        electronic_noise: float | None = None,
        linearisation: object = None,
        mu_water: float | None = None,
        exposure_s: float = 1.0,
        info: Mapping[str, object] | None = None,
    ) -> Scan:
        """A scan from the readings of any detector.

        ``(readings − dark) / gain`` are photons, with Poisson noise and the electronics'. Readings
        are dead if they are NaN or Inf or ``dead`` says so; cells if they read nothing in all
        views, or no more in air than in the dark.

        Args:
            readings: raw, the shape of ``counts``, any real dtype.
            geometry: parallel, fan or cone beam, or view by view
                (:class:`~torchpcct.vector_geometry.VectorGeometry`).
            air: readings without the object: one frame, the shape of ``readings`` without views, or
                several ``(frames, …)``, or one number.
            dark: readings without beam, as ``air``.
            gain: reading of one photon. None: from the variance of four air frames or more (photon
                transfer), else 1. "noise", and None where the frames do not differ: what explains
                the noise between neighbouring columns. None, and readings with far less noise than
                photons: they are transmissions; the same.
            flux: ``(views,)`` intensity of the source relative to ``air``; None: the same.
            dead: bool mask of cells or of readings, True where dead.
            electronic_noise: standard deviation in photons; None: from three dark frames or more,
                else 0.
            linearisation: None: line integrals as they are. ``(c₁, c₂, …)``: c₁ p + c₂ p² + …, a
                beam-hardening correction. Or a
                :class:`~torchpcct.scanner.linearisation.WaterLinearisation`.
            mu_water: attenuation of water in mm⁻¹ (0.02 for a clinical beam): volumes in HU. None:
                in mm⁻¹.
            exposure_s: duration of the scan in s.
            info: provenance.

        Raises:
            ValueError: shapes that do not fit, negative counts without ``dark``, values out of
                range.
            TypeError: values of the wrong kind.
        """
        fields = counted(
            readings,
            geometry,
            air,
            dark,
            gain,
            flux,
            dead,
            electronic_noise,
            linearisation,
            mu_water,
        )
        fields["info"] |= dict(info or {})
        fields |= {"geometry": geometry, "exposure_s": exposure_s}
        return cls(**fields)

    @classmethod
    @checked
    def from_line_integrals(
        cls,
        lines: object,
        geometry: Geometry,
        *,
        photons: object = None,
        flux: object = None,
        dead: object = None,
        linearisation: object = None,
        mu_water: float | None = None,
        exposure_s: float = 1.0,
        info: Mapping[str, object] | None = None,
    ) -> Scan:
        """A scan from line integrals −ln(transmission) that another software made.

        Args:
            lines: the shape of ``counts``; NaN and Inf are dead.
            geometry: as for :meth:`from_counts`.
            photons: of an unattenuated reading, one number or one per cell; it sets the statistical
                weights. None: estimated from the noise between neighbouring columns.
            flux: ``(views,)`` intensity of the source relative to ``photons`` (tube current
                modulation), for the weights; None: the same in all views.
            dead, linearisation, mu_water, exposure_s, info: of :meth:`from_counts`.

        Raises:
            ValueError: shapes that do not fit, values that cannot be line integrals, values out of
                range.
            TypeError: values of the wrong kind.
        """
        fields = logged(lines, geometry, photons, flux, dead, linearisation, mu_water)
        fields["info"] |= dict(info or {})
        fields |= {"geometry": geometry, "exposure_s": exposure_s}
        return cls(**fields)

    def __repr__(self) -> str:
        what = "line integrals" if self.logged else "counts" if self.counting else "readings"
        size = " × ".join(map(str, self.counts.shape))
        dead = 0 if self.dead is None else int(self.dead.sum())
        noise = (
            "noise free"
            if self.noise_free
            else f"{self.exposure_s:g} s, mean {float(self.counts.mean()):.4g}"
        )
        part = "" if self.window is None else ", a part of the detector"
        return (
            f"Scan({size} {what}, {noise}, {dead} dead{part}, volumes in {self.unit}\n     "
            f"{self.geometry!r})"
        )

    @property
    def device(self) -> torch.device:
        """Where the readings lie, and where reconstructions of them compute."""
        return self.counts.device

    @checked
    def to(self, device: str | torch.device) -> Scan:
        """The same scan with its tensors on a device; itself where they lie there already.

        Raises:
            ValueError: no such device. TypeError: no name of one.
        """
        target = device_of(device)
        if self.device == target:
            return self
        moved = {name: getattr(self, name) for name in _TENSORS}
        return replace(self, **{k: v.to(target) for k, v in moved.items() if v is not None})

    @property
    def noise_free(self) -> bool:
        """Whether the readings are expectations."""
        return self.exposure_s is None

    @property
    def zero_fraction(self) -> float:
        """Share of readings that registered nothing (energy integrating: 0 or less)."""
        return float((self.counts <= 0).float().mean())

    @checked
    def with_noise(self, exposure_s: float, seed: int) -> Scan:
        """A noisy realisation of a noise-free scan.

        The noise of a reading depends only on ``seed`` and the reading's place on the full
        detector, so a windowed scan carries the same noise as the full one. Counts are Poisson; an
        energy-integrating signal is compound Poisson with the second moment of the transmitted
        spectrum (:func:`torchpcct.counting_noise.compound_poisson`), and electronic noise is added.

        Raises:
            ValueError: the scan is noisy already; ``exposure_s`` ≤ 0; a negative seed; an
                energy-integrating scan that does not hold ``quantum``.
        """
        if not self.noise_free:
            raise ValueError(
                "with_noise needs a noise-free scan (acquire with exposure_s=None), this one is "
                "noisy"
            )
        self._require_noise_model()
        check_exposure(exposure_s)
        scale = exposure_s / NOISE_FREE_EXPOSURE_S
        index = self._first_index()
        if self.quantum is None:
            readings = noise.poisson(self.counts, index, seed, scale)
        else:
            readings = noise.compound_poisson(
                self.counts, self.quantum, index, seed, scale, self.electronic_noise
            )
        return replace(
            self,
            counts=readings,
            air=self.air * scale,
            exterior=None if self.exterior is None else self.exterior * scale,
            exposure_s=float(exposure_s),
            seed=int(seed),
        )

    @checked
    def at_dose(self, fraction: float, seed: int = 0) -> Scan:
        """The same scan as if it had been taken with a fraction of its dose: a measured scan, its
        noise included.

        Photon counts are thinned: each photon stays with the probability ``fraction``, which makes
        Poisson counts of the lower dose exactly, whatever the object; every energy bin by itself.
        Air readings and exposure scale, dead readings stay dead. Counts that are no whole numbers
        (a gain), line integrals of a known number of photons and the signal of an
        energy-integrating detector get the right mean and variance
        (:func:`torchpcct.counting_noise.thinned`), and ``info["lower_dose"]`` says that this is
        approximate.

        Args:
            fraction: of the dose, in (0, 1].
            seed: realisation number, ≥ 0; a reading's noise depends on it and on the reading's
                place alone.

        Raises:
            ValueError: a noise-free scan; a fraction outside of (0, 1]; line integrals whose number
                of photons was not given; an energy-integrating scan that does not hold ``quantum``.
        """
        fraction = number("fraction", fraction, positive=True, high=1.0)
        if self.noise_free:
            raise ValueError(
                "at_dose thins noisy readings, and this scan is noise-free: use "
                "with_noise(exposure_s, seed)"
            )
        if self.logged and self.info.get("photons") != "given":
            raise ValueError(
                "these are line integrals of an unknown number of photons: give photons= to "
                "Scan.from_line_integrals or open_scan, or use the raw counts"
            )
        self._require_noise_model()
        readings = noise.thinned(
            self.counts, self._first_index(), seed, fraction, self.quantum, self.electronic_noise
        )
        exact = (
            self.counting and not self.logged and bool((self.counts == self.counts.round()).all())
        )
        note = {"fraction": fraction, "seed": int(seed), "exact": exact}
        return replace(
            self,
            counts=readings,
            air=self.air * fraction,
            exterior=None if self.exterior is None else self.exterior * fraction,
            exposure_s=float(self.exposure_s or 0.0) * fraction,
            logged=False,
            info={**self.info, "lower_dose": note},
        )

    def weighted(self, weights: object, scanner: Scanner | None = None) -> Scan:
        """The energy bins summed with weights: one channel, which shows a contrast better than the
        plain sum (:func:`torchpcct.spectral.bin_weights`).

        The readings Σ w_k N_k are not Poisson: their variance Σ w_k² N̄_k is exact in ``quantum``,
        of a noisy scan from the local mean of its own counts. Water reads 0 HU by a correction of
        its own; what other materials read depends on the weights, as it does on a tube voltage.
        FBP, PWLS, MBIR, files and :meth:`at_dose` take such a scan as any other. Noise that is
        added afterwards (:meth:`with_noise`, :meth:`at_dose`) has the right mean and variance;
        exact in all moments is the noise of the bins, weighted afterwards.

        Args:
            weights: ``(bins, columns)`` ≥ 0.
            scanner: whose spectra make the water correction; None: that of weights of
                :func:`~torchpcct.spectral.bin_weights`.

        Raises:
            ValueError: a scan without energy bins, weights of another scanner or another shape,
                negative, not finite or all 0 in a column; no scanner; a bin that has counted
                nothing.
            TypeError: weights that are no numbers.
        """
        from torchpcct.spectral.weighting import weighted_scan  # it knows scanners, and scans

        return weighted_scan(self, weights, scanner)

    def with_added(self, lines: Tensor) -> Scan:
        """The scan with more in its object: readings times the transmission of what is added.

        Of a noise-free scan the readings stay exact, but for the curvature of the water correction
        over what is added (a few per cent of what is there). Of a noisy one the noise is scaled
        with the readings: right to first order in what is added.

        Args:
            lines: water-linearised line integrals of what is added, the shape of ``counts``.

        Raises:
            ValueError: another shape.
        """
        if tuple(lines.shape) != tuple(self.counts.shape):
            raise ValueError(
                f"lines have shape {tuple(lines.shape)}, the scan's readings "
                f"{tuple(self.counts.shape)}"
            )
        p = self._logarithm()
        half = p + 0.5 * lines / self.linearisation.slope(p, self.window)
        factor = (-lines / self.linearisation.slope(half, self.window)).exp()
        return replace(self, counts=self.counts * factor)

    def crop(self, window: DetectorWindow) -> Scan:
        """The same scan on a part of its window; its noise is that of the whole. A smaller one has
        no region.

        Raises:
            ValueError: the scan is not windowed, or ``window`` reaches beyond its window.
        """
        if self.window is None:
            raise ValueError("only a windowed scan can be cropped: acquire it with region=")
        outer = self.window
        region = self.region if window == outer else None
        return replace(
            self,
            window=window,
            region=region,
            **self.each(lambda readings: outer.crop(readings, window)),
        )

    def each(self, change: Callable[[Tensor], Tensor]) -> ReadingFields:
        """What has a value for each reading (``counts``, ``quantum``, ``dead``), changed alike;
        None stays."""
        return {
            "counts": change(self.counts),
            "quantum": None if self.quantum is None else change(self.quantum),
            "dead": None if self.dead is None else change(self.dead),
        }

    def seen_grid(
        self, voxel: float | None = None, extent: object = None, center: object = None
    ) -> VolumeGrid:
        """The grid that :meth:`torchpcct.VolumeGrid.of` returns for this scan, with the same
        arguments: voxel size, edge lengths and centre in mm, None for the scan's own."""
        return grid_of(self, voxel, extent, center)

    def select(self, views: Views) -> Scan:
        """The same scan with a subset (or reordering) of the views: an index array, mask or
        slice."""
        at = views if isinstance(views, slice) else torch.as_tensor(views)
        axes = (..., at, *(slice(None),) * (len(self.geometry.shape) - 1))
        return replace(
            self,
            geometry=self.geometry.select(views),
            window=None if self.window is None else self.window.select(views),
            flux=None if self.flux is None else self.flux[at],
            **self.each(lambda readings: readings[axes].contiguous()),
        )

    def _require_noise_model(self) -> None:
        if not self.counting and self.quantum is None:
            raise ValueError(
                "this energy-integrating scan does not hold the energy of its quanta, so its "
                "noise is not known: simulate it with acquire(), or give quantum="
            )

    def relative_variance(self, exposure_s: float) -> Tensor:
        """Variance over squared expectation of every reading at an exposure, shape and dtype of
        ``counts``.

        It is the variance of ``ln`` of the reading (delta method). Counting: 1 / N̄. Energy
        integrating: q / S̄ + (electronic noise / S̄)².

        Raises:
            ValueError: the scan is noisy (its expectations are needed); ``exposure_s`` ≤ 0; an
                energy-integrating scan that does not hold ``quantum``.
        """
        if not self.noise_free:
            raise ValueError(
                "the variance follows from expected readings: give the noise-free scan"
            )
        number("exposure_s", exposure_s, positive=True, unit="s")
        self._require_noise_model()
        inverse = (self.counts * (exposure_s / NOISE_FREE_EXPOSURE_S)).reciprocal_()
        if self.quantum is None:
            return inverse
        variance = inverse * self.quantum
        return (
            variance.add_(inverse.mul_(self.electronic_noise).square_())
            if self.electronic_noise
            else variance
        )

    def _first_index(self) -> Ints:
        """Global index of the first reading of every detector row held in ``counts``."""
        g, w = self.geometry, self.window or DetectorWindow.full(self.geometry)
        if not (g.on_circle and g.has_rows):  # all of the detector, cells in the order in memory
            return np.arange(math.prod(self.counts.shape[:-1])) * g.columns
        line = np.arange(g.views)[:, None] * g.rows + w.first_row + np.arange(w.rows)
        index = line * g.columns + w.first_column[:, None]
        bins = self.counts.shape[0] if self.counts.ndim == 4 else 1
        return (np.arange(bins)[:, None, None] * math.prod(g.shape) + index).reshape(-1)

    def _at_window(self, cells: Tensor) -> Tensor:
        """``(..., rows, columns)`` values of the cells as seen by the stored readings, ``(...,
        views | 1, r, c)``."""
        if self.window is None:
            return cells.unsqueeze(-len(self.geometry.shape))
        return self.window.take(cells)

    def line_integrals(self) -> Tensor:
        """Water-linearised line integrals of the stored readings, shape and dtype of ``counts``,
        dimensionless.

        ``ln(air) − ln(counts + ½)`` for counts (½ removes the bias of the logarithm to second order
        in 1 / counts and keeps zero counts finite; below three counts the rest follows from the
        neighbours' mean, :func:`torchpcct.readings.log_bias`), ``ln(air) − ln(counts)`` for
        expectations; then the scanner's water correction, so that a path through t mm of water
        reads ``mu_ref · t``. The shift of an energy-integrating signal S is variance / (2 S) = q /
        2 + electronic noise² / (2 S); starved readings are held at q / 2, which a counting detector
        with quanta of q would read at zero counts.

        Raises:
            ValueError: a noisy energy-integrating scan that does not hold ``quantum``.
        """
        p = self._logarithm()
        if not (self.noise_free or self.logged):
            self._unbias(p)
        p = self.linearisation.apply(p, self.window, overwrite=True)
        return p if self.dead is None else interpolate_dead(p, self.dead, self.geometry.has_rows)

    def _unbias(self, p: Tensor) -> None:
        """Add to ``p``, in place, what few counts leave of the logarithm's bias."""
        quanta = self.counts if self.quantum is None else self.counts / self.quantum
        noise = self._noise_in_quanta()
        if float(quanta.amin()) < many(noise):
            p += log_bias(self._expected(quanta), noise)

    def _noise_in_quanta(self) -> float:
        """Electronic noise over the median reading of a quantum."""
        if not self.electronic_noise or self.quantum is None:
            return 0.0
        return self.electronic_noise / float(self.quantum.median())

    def _expected(self, readings: Tensor) -> Tensor:
        """Expected readings: those of a known exterior, or the mean over the neighbours of each."""
        if self.exterior is not None:
            return self._at_window(self.exterior).expand(readings.shape)
        return smoothed(readings, self.dead, self.geometry.has_rows)

    def _logarithm(self) -> Tensor:
        """``ln(air) − ln(readings)`` before the water correction; dead readings hold anything
        finite."""
        positive = self._positive()
        if self.dead is not None:
            positive.masked_fill_(self.dead, 1.0)
        p = positive.log_()
        if self.window is None:
            p.sub_(self._at_window(self.air.log())).neg_()
        else:
            self.window.less(p, self.air.log(), out=p).neg_()
        return p if self.flux is None else p.add_(self._per_view(self.flux.log()))

    def _per_view(self, values: Tensor) -> Tensor:
        return values.view(-1, *(1,) * (len(self.geometry.shape) - 1))

    def weights(self) -> Tensor:
        """Statistical weights of :meth:`line_integrals`: inverse variances, shape and dtype of
        ``counts``.

        Of expected readings, not of the noisy ones, which would bias a weighted fit: the readings'
        local mean (:func:`torchpcct.readings.smoothed`), where electronics add noise or photons are
        few without the reading itself, whose weight would follow its noise (three photons behind
        20 cm of water: -13 HU); expectations of a noise-free scan as they are. Dead readings weigh
        0.

        Raises:
            ValueError: an energy-integrating scan that does not hold ``quantum``.
        """
        self._require_noise_model()
        rows = self.geometry.has_rows
        quantum = self.counts.new_ones(1) if self.quantum is None else self.quantum
        if self.noise_free or self.window is not None:
            mean = self.counts
        else:
            mean = smoothed(self.counts, self.dead, rows, own=not self.electronic_noise)
            few = mean < _FOLLOWED * quantum
            if not self.electronic_noise and bool(few.any()):
                mean = torch.where(few, smoothed(self.counts, self.dead, rows, own=False), mean)
        p = (self._at_window(self.air) / torch.maximum(mean, quantum / 2)).log_()
        if self.flux is not None:
            p += self._per_view(self.flux.log())
        weights = inverse_variance(mean, quantum, self.electronic_noise)
        weights /= self.linearisation.slope(p, self.window).square_()
        return weights if self.dead is None else weights.masked_fill_(self.dead, 0.0)

    def _positive(self) -> Tensor:
        """A copy of the readings, shifted so that the logarithm is finite and nearly unbiased."""
        if self.noise_free or self.logged:
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

    def exterior_line_integrals(self) -> Tensor:
        """Water-linearised line integrals of the exterior (noise free), ``(..., rows, columns)``.

        Raises:
            ValueError: the scan is not windowed.
        """
        if self.exterior is None:
            raise ValueError("a full scan has no exterior: use line_integrals()")
        return self.linearisation.apply(torch.log(self.air) - torch.log(self.exterior))

    def exterior_weights(self) -> Tensor:
        """Statistical weights of :meth:`exterior_line_integrals`, as if every cell were read:
        inverse variances at the exposure of the scan, ``(rows, columns)``.

        What a quantum signals is that behind the object, the mean over the views in which the cell
        was read (of cells that were never read: over all).

        Raises:
            ValueError: the scan is not windowed, has several channels, does not hold ``quantum``,
                or electronic noise, whose share of the variance changes with the exposure.
        """
        if self.exterior is None or self.window is None or self.counts.ndim != 3:
            raise ValueError("weights of the exterior need a windowed scan of one channel")
        self._require_noise_model()
        if self.electronic_noise:
            raise ValueError(
                "the electronic noise of this scan does not scale with the exposure, as the "
                "weights of an inset do: use fbp"
            )
        slope = self.linearisation.slope(self.air.log() - self.exterior.log())
        weights = self.exterior / slope.square_()
        return weights if self.quantum is None else weights / self._mean_per_cell(self.quantum)

    def _mean_per_cell(self, readings: Tensor) -> Tensor:
        """Mean over the views of readings ``(views, r, c)`` on the window, ``(rows, columns)``."""
        w, g = self.window, self.geometry
        assert w is not None
        total = readings.new_zeros((w.rows, g.columns), dtype=torch.float64)
        read = readings.new_zeros(g.columns, dtype=torch.float64)
        columns = torch.from_numpy(w.column_indices).to(readings.device)
        for values, at in zip(readings, columns, strict=True):
            total.index_add_(-1, at, values.double())
            read.index_add_(0, at, read.new_ones(len(at)))
        out = read.new_full((g.rows, g.columns), float(readings.double().mean()))
        rows = slice(w.first_row, w.first_row + w.rows)
        out[rows] = torch.where(read > 0, total / read.clamp(min=1.0), out[rows])
        return out.to(readings.dtype)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write HDF5, which :meth:`load` reads; the file appears under its name only when it is
        complete, and replaces one of that name."""
        write_scan(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str], slices: slice | None = None) -> Scan:
        """Read a scan written by :meth:`save`; with ``slices`` no more than these slices, or rows
        of a cone beam.

        Raises:
            FileNotFoundError: no such file.
            ValueError: the file is truncated or altered (its checksum is verified), is no torchpcct
                scan, or is of a newer format.
        """
        with read_hdf5(path, "scan") as file:
            return cls(**scan_fields(file, path, slices))


@checked
def check_exposure(exposure_s: float | None) -> None:
    """Raise ``ValueError`` unless the exposure is a time > 0 s that a scan can take, or None (noise
    free)."""
    if exposure_s is not None:
        number("exposure_s", exposure_s, positive=True, high=_LONGEST_S, unit="s")


def _check(scan: Scan) -> None:
    """Refuse a scan whose members do not fit together."""
    _check_kinds(scan)
    g, w = scan.geometry, scan.window
    axes = len(g.shape)
    if w is not None and not isinstance(g, ConeBeam):
        raise TypeError(
            f"geometry must be a ConeBeam in a scan with a window, got {type(g).__name__}"
        )
    cells = g.shape if w is None else w.shape
    if tuple(scan.counts.shape[-axes:]) != cells or scan.counts.ndim not in (axes, axes + 1):
        raise ValueError(f"counts have shape {tuple(scan.counts.shape)}, expected (…, {cells})")
    expected_air = (*scan.counts.shape[:-axes], *g.shape[1:])
    if tuple(scan.air.shape) != expected_air:
        raise ValueError(f"air has shape {tuple(scan.air.shape)}, expected {expected_air}")
    if (w is None) != (scan.exterior is None):
        raise ValueError(
            "a windowed scan needs exterior=, the readings of what lies outside its region; a scan "
            "of the whole detector must have none"
        )
    if scan.region is not None and (w is None or scan.region.ndim != 3):
        raise ValueError(
            "region must be the (z, y, x) grid that a windowed scan was kept for; a full scan has "
            "none"
        )
    if w is not None:
        w.check(g)
    if scan.linearisation.scale.size != g.columns:
        raise ValueError(
            f"the water correction is that of {scan.linearisation.scale.size} columns, the "
            f"detector has {g.columns}"
        )
    if scan.exterior is not None and scan.exterior.shape != scan.air.shape:
        raise ValueError(
            f"exterior has shape {tuple(scan.exterior.shape)}, air {tuple(scan.air.shape)}"
        )
    check_exposure(scan.exposure_s)
    low, high = (
        (float(v) for v in torch.aminmax(scan.counts)) if scan.counts.numel() else (0.0, 0.0)
    )
    if not (np.isfinite(low) and np.isfinite(high)):  # aminmax propagates NaN
        bad = int((~torch.isfinite(scan.counts)).sum())
        raise ValueError(
            f"{bad} readings are NaN or Inf: mask dead cells and interpolate them before"
        )
    # Electronic noise and dark frames make readings of starved rays negative.
    noiseless = scan.quantum is not None and scan.electronic_noise == 0
    if low < 0 and (scan.counting or scan.noise_free or noiseless):
        raise ValueError(
            f"counts must not be negative, the lowest is {low}: give raw counts, not line integrals"
        )
    if high == 0:
        raise ValueError(
            "all counts are zero: the scan holds no signal (exposure too low, or beam blocked)"
        )
    for name, readings in (("air", scan.air), ("exterior", scan.exterior)):
        if readings is not None and not bool(((readings > 0) & torch.isfinite(readings)).all()):
            raise ValueError(
                f"{name} readings must be finite and greater than 0 in every cell: mask dead "
                "cells before"
            )
    choice("unit", scan.unit, UNITS)
    same_device(**{name: getattr(scan, name) for name in _TENSORS})
    if scan.dead is not None and scan.dead.shape != scan.counts.shape:
        raise ValueError(
            f"dead has shape {tuple(scan.dead.shape)}, counts {tuple(scan.counts.shape)}"
        )
    if scan.flux is not None and tuple(scan.flux.shape) != (g.views,):
        raise ValueError(f"flux has shape {tuple(scan.flux.shape)}, expected ({g.views},)")
    _check_noise_model(scan)


def _check_kinds(scan: Scan) -> None:
    for name, kind in (("geometry", Geometry), ("linearisation", WaterLinearisation)):
        if not isinstance(getattr(scan, name), kind):
            raise TypeError(
                f"{name} must be a {kind.__name__}, got {type(getattr(scan, name)).__name__}"
            )
    if scan.window is not None and not isinstance(scan.window, DetectorWindow):
        raise TypeError(
            f"window must be a DetectorWindow or None, got {type(scan.window).__name__}"
        )
    if scan.region is not None and not isinstance(scan.region, VolumeGrid):
        raise TypeError(f"region must be a VolumeGrid or None, got {type(scan.region).__name__}")
    for name in ("counts", "air", "exterior", "quantum"):
        values = getattr(scan, name)
        if values is None and name in ("exterior", "quantum"):
            continue
        if not isinstance(values, Tensor) or values.dtype not in (torch.float32, torch.float64):
            found = values.dtype if isinstance(values, Tensor) else type(values).__name__
            raise TypeError(
                f"{name} must be a tensor of float32 or float64, got {found}: use "
                "torch.as_tensor(…).float()"
            )
    if scan.seed is not None:
        whole("seed", scan.seed, low=0)
    if not isinstance(scan.info, Mapping):
        raise TypeError(f"info must be a mapping of JSON values, got {type(scan.info).__name__}")


def _check_noise_model(scan: Scan) -> None:
    number("electronic_noise", scan.electronic_noise, low=0.0, unit="keV")
    if scan.quantum is None:
        return
    if scan.counting:
        raise ValueError(
            "quantum belongs to scans without Poisson noise (counting=False): counts are Poisson"
        )
    if scan.quantum.shape != scan.counts.shape:
        raise ValueError(
            f"quantum has shape {tuple(scan.quantum.shape)}, counts {tuple(scan.counts.shape)}"
        )
    if not bool(((scan.quantum > 0) & torch.isfinite(scan.quantum)).all()):
        raise ValueError("quantum must be finite and greater than 0 keV in every reading")
