"""The spectrum that a scan's readings sum: all of its energies, or a few nodes that stand for
them.

The transmissions ``exp(−Σ path · μ(E))`` of a scene's materials are smooth in the paths, so as
functions of the energy they span few dimensions: a reading is a weighted sum of the transmission at
few energies, with weights that depend on the spectrum alone. The nodes are found by interpolation
in the space of sampled transmissions (Q-DEIM: Drmač and Gugercin, SIAM J. Sci. Comput. 38 (2016)
A631), as many as keep the error of every reading below a bound that is tried out on other samples.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchpcct.scan import NOISE_FREE_EXPOSURE_S
from torchpcct.scanner.scanner import Scanner

__all__ = ["energy_nodes", "signal_spectra"]

Floats = NDArray[np.float64]

NODE_ERROR = 1e-8
"""Largest relative error of a reading by the nodes: a sixth of what float32 rounds it to."""
_SAMPLES = 400
"""Sampled transmissions that the nodes are made for, and as many others that they are tried on."""
_COLUMNS = 24
"""Columns whose spectra the nodes are made for and tried on."""
_FEW = 4
"""Nodes of the first trial; each next one has two more."""


class Nodes(NamedTuple):
    """Energies that stand for a spectrum.

    Attributes:
        indices: ``(nodes,)`` indices of the energies.
        spectra: ``(bins, columns, nodes)`` weights of the transmissions there.
        error: largest relative error of a reading that was found; 0 of all energies.
    """

    indices: NDArray[np.int64]
    spectra: Floats
    error: float

    @classmethod
    def all_of(cls, spectra: Floats) -> Nodes:
        """Every energy, with its own weight."""
        return cls(np.arange(spectra.shape[-1]), spectra, 0.0)


def signal_spectra(scanner: Scanner) -> tuple[Floats, Floats, Floats]:
    """Energies, ``(bins, columns, energies)`` signal per energy in air, and the air readings
    ``(bins, rows, columns)``.

    Of an energy-integrating detector the variance follows as one more "bin": the same transmission,
    weighted by the squared signal.
    """
    energies, spectra = scanner.weights()
    if scanner.detector.energy_integrating:
        spectra = np.concatenate([spectra, scanner.noise_weights()[1]])
    spectra = spectra * scanner.mas_per_view(NOISE_FREE_EXPOSURE_S)
    return energies, spectra, np.einsum("bce,r->brc", spectra, scanner.row_factor)


def energy_nodes(attenuation: Floats, longest_mm: Floats, spectra: Floats) -> Nodes:
    """Few energies that stand for all, where there are such; else all of them.

    Args:
        attenuation: ``(materials, energies)`` in mm⁻¹.
        longest_mm: ``(materials,)`` longest path in each that a ray can have.
        spectra: ``(bins, columns, energies)``.
    """
    from scipy.linalg import qr  # late: importing the package stays quick

    whole = Nodes.all_of(spectra)
    every = spectra.reshape(-1, spectra.shape[-1])
    columns = np.unique(np.linspace(0, spectra.shape[1] - 1, _COLUMNS).astype(int))
    some = spectra[:, columns].reshape(-1, spectra.shape[-1])
    some = some[some.sum(-1) > 0]
    if not len(some):
        return whole
    some = some / some.sum(-1, keepdims=True)
    used = np.flatnonzero(some.max(0) > 0)
    some = some[:, used]
    rng = np.random.default_rng(0)
    materials = len(longest_mm)
    ends = np.concatenate([np.zeros((1, materials)), np.eye(materials), np.ones((1, materials))])
    paths = np.concatenate([rng.random((_SAMPLES, materials)), ends]) * longest_mm
    made_for = np.exp(-paths @ attenuation[:, used])
    # Relative to the reading that it changes most.
    made_for /= (made_for @ some.T).min(-1, keepdims=True)
    size = np.sqrt(some.max(0))
    directions = np.linalg.svd((made_for * size).T, full_matrices=False)[0]
    # Short paths, too, of which there are few among the first.
    tried = rng.random((_SAMPLES, 1)) * rng.random((_SAMPLES, materials)) * longest_mm
    tried_on = np.exp(-tried @ attenuation[:, used])
    exact = tried_on @ some.T
    for count in range(_FEW, min(len(used) // 2, directions.shape[1]), 2):
        space = directions[:, :count]
        chosen = np.sort(qr(space.T, pivoting=True, mode="economic")[2][:count])
        # From the values at the nodes to those at all energies.
        spread = (space @ np.linalg.inv(space[chosen])) * size[chosen] / size[:, None]
        error = float(np.abs(tried_on[:, chosen] @ (some @ spread).T / exact - 1.0).max())
        if error <= NODE_ERROR:
            weights = (every[:, used] @ spread).reshape(*spectra.shape[:-1], count)
            return Nodes(used[chosen], weights, error)
    return whole
