"""What a spectral scan is expected to count behind given lengths of the two basis materials.

    λ_i(a) = s · Σ_E S_i(column, E) exp(−a₁ μ₁(E) − a₂ μ₂(E))

with S the spectra that the simulator itself uses (tube, filters, the column's bowtie, detector
response, tube load) and s the relative intensity of the detector row. Nothing is tabulated or
fitted, so expected counts of the two materials are inverted exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpcct.scan import Scan
from torchpcct.scanner import Scanner
from torchpcct.scene.materials import material
from torchpcct.spectral.basis import Basis, pe_pvc
from torchpcct.spectral.decompose_kernels import expected
from torchpcct.threads import run
from torchpcct.validate import reals, shaped

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from torchpcct.typing import Ints


__all__ = ["SpectralModel"]

Floats = NDArray[np.float64]

START_MATERIAL = "water"
"""The iteration starts at the path of this material that explains the summed counts."""

START_MAX_MM = 600.0
"""Thickest start material of the first estimate, mm."""
COARSE_PATH_MM = 80.0
"""Path through the start material, mm, behind which grouped energies are exact; elsewhere they are
nearly so."""

COARSE_GROUPS = 16
"""Groups of energies of the coarse model."""
_NODES = 64
"""Nodes of the table of the first estimate."""
_LOWEST = -4.0
"""Lower bound of the estimates, as line integrals at 60 keV."""
_HIGHEST = 16.0
"""Upper bound."""

_NEGLIGIBLE = 1e-12
"""Energies with a smaller fraction of the signal are left out."""
ONE_BIN = (100.0, 5.0)
"""Where one bin counts this much or more, and all others together less than the second number, a
ray says nothing of two materials: its estimate hangs on single photons."""
_ALIKE = 1e-7
"""Spectra of two bins that differ by less are one: their information is singular in float64."""


@dataclass(frozen=True, eq=False)
class SpectralModel:
    """Forward model of a spectral scan.

    Args:
        energies: ``(E,)`` keV.
        spectra: ``(columns, bins, E)`` expected counts of a reading in air per energy, in the
            central detector row.
        row_factor: ``(rows,)`` intensity of the rows relative to the central one.
        basis: the two materials; default: PE and PVC.

    Raises:
        ValueError: shapes that do not fit, negative or non-finite spectra, a column without counts,
            fewer than 2 bins, a column whose bins all have one spectrum, or of which one alone
            counts in air (they cannot tell two materials apart).
    """

    energies: Floats
    spectra: Floats
    row_factor: Floats = field(default_factory=lambda: np.ones(1))
    basis: Basis = field(default_factory=pe_pvc)

    def __post_init__(self) -> None:
        energies = np.ascontiguousarray(reals("energies", self.energies))
        spectra = reals("spectra", self.spectra)
        if spectra.ndim != 3 or energies.shape != spectra.shape[-1:]:
            raise ValueError(
                f"spectra must have the shape (columns, bins, {energies.size} energies), got "
                f"{spectra.shape}"
            )
        if spectra.shape[1] < 2:
            raise ValueError(
                f"two basis materials need at least 2 energy bins, got {spectra.shape[1]}: use a "
                "spectral detector, such as presets.pcct(mode='spectral')"
            )
        if not (
            np.isfinite(spectra).all() and (spectra >= 0).all() and (spectra.sum((1, 2)) > 0).all()
        ):
            raise ValueError(
                "spectra must be finite, ≥ 0 and not all 0 in any column: leave dead columns out"
            )
        if (alike := _one_spectrum(spectra)).any():
            raise ValueError(
                f"the bins of column {int(alike.argmax())} have one spectrum but for its height, "
                "or counts in one bin only: they cannot tell two materials apart; set other "
                "thresholds, or leave dead columns out"
            )
        if (starved := one_bin(spectra.sum(-1).T)).any():
            column = int(starved.argmax())
            strongest, others = (
                spectra[column].sum(-1).max(),
                np.sort(spectra[column].sum(-1))[:-1].sum(),
            )
            raise ValueError(
                f"of column {column} one bin is expected to count {strongest:.3g} photons in air "
                f"and all others together {others:.2g}: they cannot tell two materials apart; set "
                "lower thresholds, or a higher tube voltage"
            )
        # Energies that no column detects cost time, and where the model is asked for negative
        # lengths they matter.
        share = (spectra / spectra.sum((1, 2), keepdims=True)).max((0, 1))
        kept = share > _NEGLIGIBLE
        set_ = object.__setattr__
        set_(self, "energies", energies[kept])
        set_(self, "spectra", np.ascontiguousarray(spectra[:, :, kept]))
        set_(self, "row_factor", reals("row_factor", self.row_factor))
        shaped("row_factor", self.row_factor, (None,))
        if not (np.isfinite(self.row_factor).all() and (self.row_factor > 0).all()):
            raise ValueError(
                "row_factor must be finite and > 0: the intensity of each row relative to the "
                "central one"
            )

    @classmethod
    def of(cls, scanner: Scanner, exposure_s: float, basis: Basis | None = None) -> SpectralModel:
        """The model of a scanner.

        Args:
            scanner: with a photon-counting detector of two bins or more.
            exposure_s: duration of the scan in s; for a noise-free scan
                :data:`torchpcct.scan.NOISE_FREE_EXPOSURE_S`.
            basis: default PE and PVC.

        Raises:
            ValueError: a detector with one bin or one that integrates energy, ``exposure_s`` ≤ 0.
        """
        if scanner.detector.energy_integrating or scanner.detector.bins < 2:
            raise ValueError(
                f"{scanner.name!r} reads {scanner.detector.bins} bin(s): material decomposition "
                "needs photon counts in at least 2 energy bins, such as "
                "presets.pcct(mode='spectral')"
            )
        energies, weights = scanner.weights()
        spectra = np.moveaxis(weights, 0, 1) * scanner.mas_per_view(exposure_s)
        return cls(energies, spectra, scanner.row_factor, pe_pvc() if basis is None else basis)

    @property
    def bins(self) -> int:
        """Number of energy bins."""
        return self.spectra.shape[1]

    @property
    def columns(self) -> int:
        """Number of detector columns."""
        return self.spectra.shape[0]

    @cached_property
    def air(self) -> Floats:
        """``(bins, rows, columns)`` expected counts without object."""
        return np.asarray(self.spectra.sum(-1).T[:, None] * self.row_factor[:, None])

    @cached_property
    def attenuation(self) -> Floats:
        """``(2, E)`` of the basis in mm⁻¹."""
        return self.basis.attenuation(self.energies)

    @cached_property
    def bounds(self) -> Floats:
        """``(2, 2)`` default lowest and highest line integral of each basis material in mm.

        −4…16 attenuation lengths at 60 keV: far beyond any body, so that only starved rays meet
        them.
        """
        lengths = 1.0 / self.basis.attenuation(60.0)
        return np.outer(lengths, (_LOWEST, _HIGHEST))

    @cached_property
    def start(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Table of the first guess: air counts, step and path in mm over ln(air / Σ counts),
        direction of the path."""
        total = self.spectra.sum(1)
        air = total.sum(1)
        t = np.linspace(0.0, START_MAX_MM, 4 * _NODES)
        mu = material(START_MATERIAL).attenuation(self.energies)
        p = -np.log(total @ np.exp(-np.outer(mu, t)) / air[:, None])
        step = p[:, -1] / (_NODES - 1)
        table = np.stack(
            [np.interp(s * np.arange(_NODES), row, t) for s, row in zip(step, p, strict=True)]
        )
        direction = self.basis.coefficients(START_MATERIAL, self.energies, total.mean(0))
        return air, step, table, direction

    @cached_property
    def coarse(self) -> tuple[Floats, Floats]:
        """Attenuation ``(2, G)`` and spectra ``(columns, bins, G)`` of grouped energies: fast, for
        the first steps.

        Neighbouring energies share one attenuation, that of the photons behind ``COARSE_PATH_MM``
        of the start material; their weights make all counts behind it exact. They stay positive, so
        the coarse model is as well behaved as the full one.
        """
        if self.energies.size <= COARSE_GROUPS:
            return self.attenuation, self.spectra
        behind = np.exp(-material(START_MATERIAL).attenuation(self.energies) * COARSE_PATH_MM)
        detected = self.spectra * behind
        mean = detected.sum((0, 1))
        first = np.linspace(0, self.energies.size, COARSE_GROUPS + 1).astype(np.int64)[:-1]
        mu = np.add.reduceat(self.attenuation * mean, first, axis=1) / np.add.reduceat(mean, first)
        path = self.start[3] * COARSE_PATH_MM
        spectra = np.add.reduceat(detected, first, axis=2) * np.exp(path @ mu)
        return np.ascontiguousarray(mu), np.ascontiguousarray(spectra)

    def cells(self, scan: Scan) -> tuple[Tensor, Tensor]:
        """Column index and row factor of the readings stored in a scan, to broadcast to ``(views,
        rows, columns)``.

        Raises:
            ValueError: the scan has other bins, cells or air counts than this model.
        """
        air = torch.from_numpy(self.air)
        if tuple(scan.air.shape) != tuple(air.shape):
            raise ValueError(
                f"the scan's air readings have the shape {tuple(scan.air.shape)}, the model's "
                f"(bins, rows, columns) are {tuple(air.shape)}: build the model from the scanner "
                "of the scan"
            )
        error = float((scan.air / air - 1).abs().max())
        if error > 1e-3:
            raise ValueError(
                f"air counts of scan and model differ by up to {100 * error:.3g} %: build the "
                "model with the scanner of the scan and its exposure (for a noise-free scan "
                "NOISE_FREE_EXPOSURE_S)"
            )
        w = scan.window
        factor = torch.from_numpy(self.row_factor)[:, None]
        if w is None:
            return torch.arange(self.columns), factor
        return torch.from_numpy(w.column_indices)[:, None, :], factor[
            w.first_row : w.first_row + w.rows
        ]

    def rays(
        self,
        shape: tuple[int, ...],
        columns: object = None,
        scale: object = None,
    ) -> tuple[Ints, Floats]:
        """Column indices (int64) and intensities (float64) of rays of a shape, flat arrays.

        Args:
            shape: of the rays.
            columns: whole numbers that broadcast to ``shape``; None: the last axis is the
                detector's columns.
            scale: relative intensities > 0 that broadcast to ``shape``; None: 1.

        Raises:
            ValueError: indices outside the detector, scales ≤ 0 or not finite, shapes that do not
                broadcast.
        """
        if columns is None:
            if not shape or shape[-1] != self.columns:
                raise ValueError(
                    f"the last axis must be the detector's {self.columns} columns, got the shape "
                    f"{shape}: give columns"
                )
            columns = np.arange(self.columns)
        index = np.asarray(columns)
        if index.dtype.kind not in "iu":
            raise ValueError(f"columns must be whole numbers, got {index.dtype}")
        if index.size and not (index.min() >= 0 and index.max() < self.columns):
            raise ValueError(
                f"columns must lie in 0…{self.columns - 1}, got {index.min()}…{index.max()}"
            )
        factor = np.asarray(1.0 if scale is None else scale, np.float64)
        if not ((factor > 0) & np.isfinite(factor)).all():
            raise ValueError(
                "scale must be finite and > 0: it is the relative intensity of a ray (row factor)"
            )
        # Copies: a read-only view would make numba compile its kernels once more.
        column = np.array(np.broadcast_to(index, shape), np.int64, order="C").reshape(-1)
        intensity = np.array(np.broadcast_to(factor, shape), np.float64, order="C").reshape(-1)
        return column, intensity

    def expected(
        self,
        line_integrals: Tensor,
        *,
        columns: ArrayLike | None = None,
        scale: ArrayLike | None = None,
    ) -> Tensor:
        """Expected counts.

        Args:
            line_integrals: ``(2, ...)`` mm of the basis materials, float32 or float64, on the CPU.
            columns, scale: see :meth:`rays`.

        Returns:
            ``(bins, ...)`` of the dtype of ``line_integrals``; not differentiable.

        Raises:
            ValueError: a wrong shape, indices outside the detector.
        """
        if line_integrals.ndim < 1 or line_integrals.shape[0] != 2:
            raise ValueError(
                f"line_integrals must have the shape (2, ...), got {tuple(line_integrals.shape)}"
            )
        column, intensity = self.rays(tuple(line_integrals.shape[1:]), columns, scale)
        counts = torch.from_numpy(evaluate(self, line_integrals, column, intensity)[0])
        return counts.reshape(-1, *line_integrals.shape[1:]).to(line_integrals.dtype)


def evaluate(
    model: SpectralModel, line_integrals: Tensor, column: Ints, intensity: Floats
) -> tuple[Floats, Floats]:
    """Expected counts ``(bins, rays)`` and their derivatives, float64.

    The derivatives λ₁, λ₂ (per mm), λ₁₁, λ₁₂, λ₂₂ (per mm²) stand in ``(5, bins, rays)``.
    """
    a = line_integrals.detach().to(torch.float64).reshape(2, -1).numpy()
    counts = np.empty((model.bins, column.size))
    slopes = np.empty((5, model.bins, column.size))
    run(
        expected,
        column.size,
        np.ascontiguousarray(a),
        column,
        intensity,
        model.attenuation,
        model.spectra,
        counts,
        slopes,
        operations=6 * model.spectra[0].size,
    )
    return counts, slopes


def one_bin(counts: Floats) -> NDArray[np.bool_]:
    """Rays of which one bin alone counts, see :data:`ONE_BIN`; ``counts`` ``(bins, ...)``."""
    strongest = counts.max(0)
    return np.asarray((strongest >= ONE_BIN[0]) & (counts.sum(0) - strongest < ONE_BIN[1]))


def _one_spectrum(spectra: Floats) -> NDArray[np.bool_]:
    """Which columns have bins that do not differ but in height, ``(columns,)``; ``spectra``
    ``(columns, bins, E)``."""
    heights = spectra.sum(-1, keepdims=True)
    strongest = np.take_along_axis(spectra, heights.argmax(1)[:, None], axis=1)
    # With the heights of the bins and not their shapes: a bin that sees next to nothing says next
    # to nothing.
    apart = np.abs(spectra - strongest * (heights / strongest.sum(-1, keepdims=True))).sum((1, 2))
    return np.asarray(apart <= _ALIKE * spectra.sum((1, 2)))
