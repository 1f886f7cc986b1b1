"""Photon histories in a slice that continues along z: Woodcock tracking through a map of materials.

Each history is a pure function of (seed, history), each batch has a tally of its own: the result is
the same bit for bit for any number of threads.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numba

from torchpcct.counting_noise import draw, stream
from torchpcct.kernel_cache import forget_outdated
from torchpcct.scanner.compton import ELECTRON_REST_KEV

if TYPE_CHECKING:
    import numpy as np

    from torchpcct.typing import Floats, Ints

BATCHES = 16
"""Independent parts of the histories, whose spread is the statistical error."""
_KEV_ANGSTROM = 12.398419843
"""hc in keV Å: an energy times its wavelength (CODATA 2018)."""


@numba.njit(inline="always", cache=True)
def _find(cumulative: Floats, value: float) -> int:
    """Smallest k with ``cumulative[k] > value``."""
    low, high = 0, cumulative.size - 1
    while low < high:
        middle = (low + high) // 2
        if cumulative[middle] > value:
            high = middle
        else:
            low = middle + 1
    return low


@numba.njit(inline="always", cache=True)
def _compton(energy: float, state: np.uint64) -> tuple[np.uint64, float, float]:
    """Scattered energy and cosine after Klein and Nishina (Kahn's rejection, as in Butcher and
    Messel)."""
    k = energy / ELECTRON_REST_KEV
    low = 1.0 / (1.0 + 2.0 * k)
    a1, a2 = -math.log(low), 0.5 * (1.0 - low * low)
    while True:
        state, u1 = draw(state)
        state, u2 = draw(state)
        state, u3 = draw(state)
        ratio = (
            math.exp(-a1 * u2)
            if u1 * (a1 + a2) < a1
            else math.sqrt(low * low + (1.0 - low * low) * u2)
        )
        t = (1.0 - ratio) / (k * ratio)
        sine2 = t * (2.0 - t)
        if u3 <= 1.0 - ratio * sine2 / (1.0 + ratio * ratio):
            return state, energy * ratio, 1.0 - t


@numba.njit(inline="always", cache=True)
def _rayleigh(
    energy: float, squares: Floats, cumulative: Floats, state: np.uint64
) -> tuple[np.uint64, float]:
    """Cosine of coherent scatter: x² from the squared form factor up to its kinematic end, then
    (1 + cos²) / 2."""
    end = (energy / _KEV_ANGSTROM) ** 2
    k = min(_find(squares, end), squares.size - 1)
    part = (end - squares[k - 1]) / (squares[k] - squares[k - 1])
    top = cumulative[k - 1] + min(part, 1.0) * (cumulative[k] - cumulative[k - 1])
    while True:
        state, u1 = draw(state)
        state, u2 = draw(state)
        value = u1 * top
        k = max(_find(cumulative, value), 1)
        width = cumulative[k] - cumulative[k - 1]
        x2 = squares[k - 1] + (value - cumulative[k - 1]) / width * (squares[k] - squares[k - 1])
        cosine = 1.0 - 2.0 * min(x2 / end, 1.0)
        if 2.0 * u2 <= 1.0 + cosine * cosine:
            return state, cosine


@numba.njit(inline="always", cache=True)
def _turned(
    dx: float, dy: float, dz: float, cosine: float, phi: float
) -> tuple[float, float, float]:
    """Unit direction at the polar angle arccos(cosine) and the azimuth phi about another."""
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    cp, sp = sine * math.cos(phi), sine * math.sin(phi)
    across = math.sqrt(max(0.0, 1.0 - dz * dz))
    if across > 1e-6:
        x = dx * cosine + (dx * dz * cp - dy * sp) / across
        y = dy * cosine + (dy * dz * cp + dx * sp) / across
        z = dz * cosine - across * cp
    else:
        x, y, z = cp, sp * math.copysign(1.0, dz), cosine * math.copysign(1.0, dz)
    norm = 1.0 / math.sqrt(x * x + y * y + z * z)
    return x * norm, y * norm, z * norm


@numba.njit(nogil=True, cache=True, error_model="numpy")
def transport(
    begin: int,
    end: int,
    histories: int,
    key: np.uint64,
    labels: Ints,
    x0: float,
    y0: float,
    step: float,
    radius: float,
    half_z: float,
    score_z: float,
    sod: float,
    half_fan: float,
    fan_cdf: Floats,
    energy_cdf: Floats,
    energies: Floats,
    table_low: float,
    table_step: float,
    attenuation: Floats,
    photo: Floats,
    compton: Floats,
    absorption: Floats,
    largest: Floats,
    squares: Floats,
    form: Floats,
    cutoff: float,
    tally: Floats,
) -> None:
    """Energy deposited per map pixel by unscattered (tally[:, 0]) and scattered (tally[:, 1])
    photons, keV.

    Estimator: every tentative collision of the Woodcock walk scores E μ_en / μ_max of the tissue
    there.
    """
    ny, nx = labels.shape
    batches = tally.shape[0]
    share = histories // batches
    nodes = fan_cdf.size
    last = largest.size - 2
    for batch in range(begin, end):
        for history in range(batch * share, (batch + 1) * share):
            state = stream(key, history)
            state, u = draw(state)
            # Views are stratified: history k of n lies in the k-th part of the turn, shuffled by
            # the golden ratio.
            beta = 2.0 * math.pi * ((history * 0.6180339887498949) % 1.0)
            k = _find(fan_cdf, u)
            state, u = draw(state)
            gamma = half_fan * (2.0 * (k + u) / nodes - 1.0)
            state, u = draw(state)
            energy = energies[_find(energy_cdf[k], u)]
            cb, sb = math.cos(beta), math.sin(beta)
            lx, ly = -math.cos(gamma), math.sin(gamma)
            dx, dy, dz = lx * cb - ly * sb, lx * sb + ly * cb, 0.0
            x, y, z = sod * cb, sod * sb, 0.0
            # Straight on to the circle around the object.
            along = -(x * dx + y * dy)
            miss2 = x * x + y * y - along * along
            if miss2 >= radius * radius:
                continue
            enter = along - math.sqrt(radius * radius - miss2)
            x += enter * dx
            y += enter * dy
            scattered = 0
            while True:
                place = (energy - table_low) / table_step
                i = min(max(int(place), 0), last)
                f = place - i
                biggest = max(largest[i], largest[i + 1])
                state, u = draw(state)
                flight = -math.log(u) / biggest
                x += flight * dx
                y += flight * dy
                z += flight * dz
                if x * x + y * y > radius * radius * (1.0 + 1e-12) or abs(z) > half_z:
                    break
                column, row = math.floor((x - x0) / step), math.floor((y - y0) / step)
                if column < 0 or column >= nx or row < 0 or row >= ny:
                    continue
                m = labels[row, column]
                if m < 0:
                    continue
                if abs(z) <= score_z:
                    absorbed = (1.0 - f) * absorption[m, i] + f * absorption[m, i + 1]
                    tally[batch, scattered, row, column] += energy * absorbed / biggest
                state, u = draw(state)
                u *= biggest
                if u > (1.0 - f) * attenuation[m, i] + f * attenuation[m, i + 1]:
                    continue
                absorbed = (1.0 - f) * photo[m, i] + f * photo[m, i + 1]
                if u < absorbed:
                    break
                if u < absorbed + (1.0 - f) * compton[m, i] + f * compton[m, i + 1]:
                    state, energy, cosine = _compton(energy, state)
                else:
                    state, cosine = _rayleigh(energy, squares, form[m], state)
                scattered = 1
                if energy < cutoff:
                    break
                state, u = draw(state)
                phi = 2.0 * math.pi * u
                dx, dy, dz = _turned(dx, dy, dz, cosine, phi)


forget_outdated(__name__)
