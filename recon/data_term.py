"""The data term: what a scan says about a volume, a quadratic function for PWLS and MBIR.

Readings y of a volume x with inverse variances W give

    ½ ‖y − A x‖²_W  =  ½ xᵀH x − bᵀx + ½ e,        H = AᵀWA,    b = AᵀW y,    e = yᵀW y,

so H and b are all that a solver needs. x is attenuation in mm⁻¹ above that of the surroundings
(``level``), which have been taken off the readings before. A change of unit, x = c u, leaves the
form as it is: b becomes c b, and H becomes c² H.

**Noise units.** With the data's information I at 0.5 lp/mm (1/(HU² mm³), see
:meth:`NormalOperator.information`) and the voxel volume V, the noise scale is c = (I V)^(−1/2) HU.
In units of c, H is about 1 at 0.5 lp/mm and b = H u + noise of covariance H: the same tissue at
four times the dose looks like twice the contrast at the same noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from torchpcct.volume import from_hu, to_hu

if TYPE_CHECKING:
    from torchpcct.projector import Projector


__all__ = ["NormalOperator", "Projected", "Quadratic"]


@runtime_checkable
class NormalOperator(Protocol):
    """AᵀWA of a scan, exact or a model of it: all that PWLS and MBIR ask of the data beside AᵀW y.

    Exact it is :class:`Projected`; of an inset :class:`recon.gram.gram.Gram` models it, of a whole
    field MBIR uses :class:`recon.mbir.field.FieldGram`.
    """

    def apply(self, x: Tensor, /) -> Tensor:
        """AᵀWA x, ``(..., *grid.shape)``."""
        ...

    def periodic_spectrum(self) -> Tensor:
        """Eigenvalues of a circulant approximation on the frequencies of ``rfftn``."""
        ...

    def information(self, mu_per_hu: float, frequency: float = ...) -> float:
        """On a wave of ``frequency`` lp/mm (0.5), 1/(HU² mm³) (2-D: mm²); ``mu_per_hu`` is 1 HU
        in mm⁻¹."""
        ...


class Projected:
    """AᵀWA by one projection and one backprojection: exact.

    Args:
        projector: A, with ``A.T``.
        weigh: y ↦ W y of readings ``(..., *A.range_shape)``.
        model: of AᵀWA, cheaper to apply: what a solver asks beside (``periodic_spectrum``,
            ``information``), and what may propose its steps.
    """

    def __init__(self, projector: Projector, weigh: Callable[[Tensor], Tensor], model: Any) -> None:
        self.projector, self.weigh, self.model = projector, weigh, model

    def apply(self, x: Tensor) -> Tensor:
        """AᵀWA x, ``(..., *A.domain_shape)``."""
        out: Tensor = self.projector.T(self.weigh(self.projector(x)))
        return out

    def periodic_spectrum(self) -> Tensor:
        """That of the model."""
        spectrum: Tensor = self.model.periodic_spectrum()
        return spectrum

    def information(self, mu_per_hu: float, frequency: float = 0.5) -> float:
        """That of the model."""
        return float(self.model.information(mu_per_hu, frequency))


@dataclass(frozen=True, eq=False)
class Quadratic:
    """½ uᵀHu − bᵀu of a batch of volumes u, H = scale · operator.

    Args:
        operator: AᵀWA at unit exposure, of volumes in mm⁻¹; that of all volumes of the batch.
        b: ``(batch, [channels,] *grid.shape)``, in units of 1/u.
        scale: ``(batch,)``: exposures, with the square of the unit.
        spacing: voxel size per axis in mm.
        mu_ref: attenuation of water in mm⁻¹, which reads 0 HU.
        level: attenuation where u is 0, mm⁻¹; None: that of water.
        unit: ``(batch,)``: HU of one unit of u; None: u is in mm⁻¹.
        energy: ``(batch,)`` float64, yᵀW y of the readings; None: not known.
        readings: how many readings of positive weight there are.
    """

    operator: NormalOperator
    b: Tensor
    scale: Tensor
    spacing: tuple[float, ...]
    mu_ref: float
    level: float | None = None
    unit: Tensor | None = None
    energy: Tensor | None = None
    readings: int = 0

    @property
    def shape(self) -> tuple[int, ...]:
        """Of a volume."""
        return tuple(self.b.shape[1:])

    @property
    def voxel_mm(self) -> float:
        """Size of cubic voxels."""
        return self.spacing[-1]

    @property
    def mu_per_hu(self) -> float:
        """1 HU in mm⁻¹."""
        return self.mu_ref / 1000.0

    @property
    def unit_hu(self) -> Tensor:
        """``(batch,)``: HU of one unit of u.

        Raises:
            ValueError: u is in mm⁻¹.
        """
        if self.unit is None:
            raise ValueError("this data term is in mm⁻¹: in_noise_units or in_units changes it")
        return self.unit

    @property
    def zero_mm(self) -> float:
        """Attenuation where u is 0, mm⁻¹."""
        return self.mu_ref if self.level is None else self.level

    @property
    def zero_hu(self) -> float:
        """HU where u is 0."""
        if self.level is None:
            return 0.0
        return float(to_hu(torch.tensor(self.level, dtype=torch.float64), self.mu_ref))

    def to(self, device: torch.device | str) -> Quadratic:
        """The same on a device; its operator must be able to move, as
        :class:`recon.gram.gram.Gram` is."""
        operator: Any = self.operator
        if self.b.device == torch.device(device):
            return self
        moved: dict[str, Any] = {
            name: None if value is None else value.to(device)
            for name, value in (
                ("b", self.b),
                ("scale", self.scale),
                ("unit", self.unit),
                ("energy", self.energy),
            )
        }
        return replace(self, operator=operator.to(device), **moved)

    def apply(self, u: Tensor) -> Tensor:
        """H u, ``(batch, *grid.shape)``."""
        return self.operator.apply(u) * self._each(self.scale)

    def spectrum(self) -> Tensor:
        """Eigenvalues of the circulant approximation of H, ``(batch, z, y, x//2 + 1)``."""
        return self.operator.periodic_spectrum().to(self.b) * self._each(self.scale)

    def _each(self, factor: Tensor) -> Tensor:
        """A factor of every volume, ready to multiply them."""
        return factor.to(self.b).reshape(-1, *[1] * (self.b.dim() - 1))

    def in_units(self, unit_hu: Tensor) -> Quadratic:
        """The same in units of so many HU, ``(batch,)``.

        Raises:
            ValueError: it is in units of HU already.
        """
        if self.unit is not None:
            raise ValueError("this data term is in units of HU already: change that of mm⁻¹")
        times = unit_hu * self.mu_per_hu
        scale = self.scale.to(self.b) * times**2
        return replace(self, b=self.b * self._each(times), scale=scale, unit=unit_hu)

    def in_noise_units(self) -> Quadratic:
        """The same in units of the noise scale of each volume, see the module."""
        information = self.operator.information(self.mu_per_hu)
        return self.in_units((information * self.scale.to(self.b) * self.voxel_mm**3).rsqrt())

    def mm(self, u: Tensor) -> Tensor:
        """Volumes in mm⁻¹ above ``level``."""
        if self.unit is None:
            return u
        return u * self._each(self.unit_hu * self.mu_per_hu)

    def hu(self, u: Tensor) -> Tensor:
        """HU of volumes."""
        return to_hu(self.mm(u) + self.zero_mm, self.mu_ref)

    def of_hu(self, hu: Tensor) -> Tensor:
        """The inverse of :meth:`hu`."""
        above = from_hu(hu, self.mu_ref) - self.zero_mm
        if self.unit is None:
            return above
        return above / self._each(self.unit_hu * self.mu_per_hu)

    def left(self, u: Tensor) -> Tensor:
        """b − H u: minus the gradient, what of the data ``u`` does not explain."""
        return self.b - self.apply(u)

    def less(self, u: Tensor) -> Quadratic:
        """The data term of what is to be added to ``u``."""
        left = self.left(u)
        return replace(self, b=left, energy=self._energy(u, left))

    def _energy(self, u: Tensor, left: Tensor) -> Tensor | None:
        """(y − A u)ᵀW (y − A u): yᵀW y less uᵀ (2 b − H u)."""
        if self.energy is None:
            return None
        axes = tuple(range(1, u.dim()))
        return self.energy - (u * (left + self.b)).sum(axes, dtype=torch.float64)

    def chi2(self, u: Tensor, left: Tensor) -> Tensor:
        """Weighted squared residual per reading, ``(batch,)`` float64; ``left`` is that of ``u``.

        Raises:
            ValueError: the readings' own yᵀW y is not known.
        """
        energy = self._energy(u, left)
        if energy is None:
            raise ValueError("this data term does not know yᵀW y of its readings")
        return energy / self.readings

    def times(self, factor: float) -> Quadratic:
        """That of ``factor`` times the exposure, with the same relative noise: of noise-free
        readings what a scan of that exposure gives on average."""
        energy = None if self.energy is None else self.energy * factor
        return replace(self, b=self.b * factor, scale=self.scale * factor, energy=energy)

    def part(self, which: Sequence[int] | Tensor) -> Quadratic:
        """That of some volumes of the batch."""
        return replace(
            self,
            b=self.b[which],
            scale=self.scale[which],
            unit=None if self.unit is None else self.unit[which],
            energy=None if self.energy is None else self.energy[which],
        )

    @staticmethod
    def joined(terms: Sequence[Quadratic]) -> Quadratic:
        """One batch of data terms that share all but b, scale and energy."""
        energies = [t.energy for t in terms if t.energy is not None]
        return replace(
            terms[0],
            b=torch.cat([t.b for t in terms]),
            scale=torch.cat([t.scale for t in terms]),
            energy=torch.cat(energies) if len(energies) == len(terms) else None,
        )
