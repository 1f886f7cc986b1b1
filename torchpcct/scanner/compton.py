"""Klein–Nishina scattering off free electrons: the energy of the recoil electron."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchpcct.validate import checked

Floats = NDArray[np.float64]

ELECTRON_REST_KEV = 510.99895
"""Rest energy of the electron (CODATA 2018)."""

_NODES = 96
"""Scattering angles of the quadrature."""


@functools.cache
def _gauss_legendre() -> tuple[Floats, Floats]:
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    return nodes, weights


@checked
def recoil(energies_kev: ArrayLike) -> tuple[Floats, Floats]:
    """Recoil-electron energies and their probabilities (Klein and Nishina 1929; binding is
    neglected).

    Gauss–Legendre quadrature over the cosine of the scattering angle: ``Σ_k p_k f(T_k)`` integrates
    smooth ``f``.

    Args:
        energies_kev: ``(E,)`` photon energies in keV.

    Returns:
        ``T`` (E, nodes) in keV, from 0 up to the Compton edge 2E²/(mc² + 2E); ``p`` (E, nodes),
        summing to 1 over the nodes.
    """
    energies = np.atleast_1d(np.asarray(energies_kev, dtype=np.float64))[:, None]
    cosine, weight = _gauss_legendre()
    # scattered over incident energy
    ratio = 1.0 / (1.0 + energies / ELECTRON_REST_KEV * (1.0 - cosine))
    density = weight * ratio**2 * (ratio + 1.0 / ratio - (1.0 - cosine**2))
    return energies * (1.0 - ratio), density / density.sum(axis=1, keepdims=True)


@checked
def mean_recoil_fraction(energies_kev: ArrayLike) -> Floats:
    """Mean share of the photon's energy that a Compton interaction gives to the electron,
    ``(E,)``."""
    energies = np.atleast_1d(np.asarray(energies_kev, dtype=np.float64))
    t, p = recoil(energies)
    return np.asarray((t * p).sum(axis=1) / energies)
