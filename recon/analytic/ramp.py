"""Apodisation windows and the ramp filter of filtered backprojection.

The named kernels are the reconstruction kernels published with the CatSim / XCIST simulator, given
as five points against the fraction of the detector's Nyquist frequency and joined by a quadratic
spline, as CatSim joins them.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import next_fast_len

from recon.names import KERNELS
from torchpcct.validate import checked, choice

if TYPE_CHECKING:
    from scipy.interpolate import PPoly


__all__ = ["apodization", "ramp_kernel"]

Floats = NDArray[np.float64]

_STANDARD = (1.0, 0.9338, 0.7441, 0.4425, 0.0531)
"""CatSim's kernel of that name, at 0, ¼, ½, ¾ and 1 of the Nyquist frequency."""
_BONE = (1.0, 1.0485, 1.17, 1.2202, 0.9201)
"""The same."""
_POINTS: dict[str, tuple[float, ...]] = {
    "soft": (1.0, 0.815, 0.4564, 0.1636, 0.0),
    "standard": _STANDARD,
    # No public definition of "detail" exists: midway between its neighbours is an assumption.
    "detail": tuple((s + b) / 2.0 for s, b in zip(_STANDARD, _BONE, strict=True)),
    "bone": _BONE,
    "ram-lak": (1.0, 1.0, 1.0, 1.0, 1.0),
}
"""Kernel → its window at the five frequencies."""


def _points(kernel: object) -> tuple[float, ...]:
    if not isinstance(kernel, str):
        raise TypeError(
            f"kernel must be one of {', '.join(map(repr, KERNELS))}, got {type(kernel).__name__}"
        )
    return _POINTS[choice("kernel", kernel, KERNELS)]


@cache
def _window(kernel: str) -> PPoly:
    """The window as ``scipy.interpolate.PPoly``."""
    from scipy.interpolate import PPoly, make_interp_spline

    points = _points(kernel)
    spline = PPoly.from_spline(make_interp_spline(np.linspace(0.0, 1.0, len(points)), points, k=2))
    keep = np.diff(spline.x) > 0.0
    return PPoly(spline.c[:, keep], np.append(spline.x[:-1][keep], spline.x[-1]))


@checked
def apodization(kernel: str, fraction: ArrayLike) -> Floats:
    """Value of a kernel's apodisation window.

    Args:
        kernel: ``"soft"``, ``"standard"``, ``"detail"``, ``"bone"`` or ``"ram-lak"``.
        fraction: frequency divided by the Nyquist frequency of the detector columns, any shape; the
            sign is ignored.

    Returns:
        float64 of the same shape: 1 at frequency 0, 0 above the Nyquist frequency.

    Raises:
        ValueError: an unknown kernel name.
        TypeError: a kernel that is not a string.
    """
    _points(kernel)
    x = np.abs(np.asarray(fraction, dtype=np.float64))
    return np.asarray(np.where(x > 1.0, 0.0, _window(kernel)(x)))


@lru_cache(maxsize=64)
def _unit_kernel(n: int, kernel: str) -> Floats:
    """``½ ∫₀¹ x W(x) cos(π m x) dx`` for m = 0 … n−1: the apodised ramp at unit pitch, in closed
    form."""
    window = _window(kernel)
    omega = np.pi * np.arange(1, n, dtype=np.float64)
    out = np.zeros(n)
    for left, right, piece in zip(window.x[:-1], window.x[1:], window.c.T, strict=True):
        p = np.poly1d(piece) * np.poly1d([1.0, left])  # x·W(x) in the local variable x − left
        out[0] += p.integ()(right - left)
        derivatives = [p, p.deriv(), p.deriv(2), p.deriv(3)]
        for x, sign in ((right, 1.0), (left, -1.0)):
            # ∫ p cos(ωx) = p sin/ω + p′ cos/ω² − p″ sin/ω³ − p‴ cos/ω⁴ between the ends of the
            # piece
            d = [float(q(x - left)) for q in derivatives]
            s, co = np.sin(omega * x), np.cos(omega * x)
            out[1:] += sign * (
                d[0] * s / omega + d[1] * co / omega**2 - d[2] * s / omega**3 - d[3] * co / omega**4
            )
    out *= 0.5
    if kernel == "ram-lak":
        out[2::2] = 0.0  # exact zeros instead of rounding
    out.setflags(write=False)
    return out


@checked
def ramp_kernel(
    n: int, pitch: float, kernel: str = "ram-lak", *, equiangular: bool = False
) -> Floats:
    """Spatial samples of the band-limited, apodised ramp (Kak and Slaney, chapter 3, equations 61
    and 103).

    Args:
        n: number of samples; sample m belongs to the lags ±m columns.
        pitch: column pitch, mm at the isocentre, or rad when ``equiangular``.
        kernel: name of the apodisation window, see :func:`apodization`.
        equiangular: multiply by ``(γ / sin γ)²`` with γ = m · pitch: columns at equal fan angles
            (curved detector).

    Returns:
        ``(n,)`` float64, in pitch⁻². Convolution sums still need a factor ``pitch``.

    Raises:
        ValueError: n < 1, a pitch ≤ 0, an unknown kernel, or equiangular lags that reach 180°.
    """
    if n < 1:
        raise ValueError(f"n must be at least 1 sample, got {n}")
    if not pitch > 0:
        raise ValueError(f"pitch must be greater than 0, got {pitch}")
    _points(kernel)
    h = _unit_kernel(int(n), kernel) / pitch**2
    if equiangular:
        gamma = np.arange(n) * pitch
        if gamma[-1] >= np.pi:
            raise ValueError(
                f"{n} columns × {pitch} rad reach {np.degrees(gamma[-1]):.0f}°, 180° or more: "
                "reduce them"
            )
        h[1:] *= (gamma[1:] / np.sin(gamma[1:])) ** 2
    return h


@checked
def fast_length(n: int) -> int:
    """The smallest length ≥ ``n`` whose only prime factors are 2, 3 and 5 and that is even (fast
    real FFTs)."""
    return 2 * int(next_fast_len((n + 1) // 2, real=True))
