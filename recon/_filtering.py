"""Ramp filtering of detector rows, from one window of columns to another, and its exact transpose.

Filtering is a linear convolution along the columns with the closed-form apodised kernel, so that the result does not
depend on how it is computed: as a matrix product where few columns go in or out, by FFT otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.windows import fast_length, ramp_kernel
from torchpcct.geometry import ConeBeam, FanBeam, Geometry, ParallelBeam
from torchpcct.window import DetectorWindow

__all__ = ["CHUNK_BYTES", "FilterPlan"]

#: Intermediate results of filtering are kept near this size; larger scans are processed in chunks of views.
CHUNK_BYTES = 48 * 2**20
#: Matrix products and FFTs per nanosecond on a common core, only used to choose the faster of the two.
_GEMM_FLOPS, _FFT_FLOPS = 40.0, 4.0


def _convolve(
    data: Tensor,
    first_in: NDArray[np.int64],
    kernels: NDArray[np.float64],
    first_out: NDArray[np.int64],
    width_out: int,
) -> Tensor:
    """Convolve rows that are zero outside their window.

    Args:
        data: ``(V, M, width_in)``; row i of view v starts at column ``first_in[v]``.
        kernels: ``(K, N)``, samples for lags 0 … N−1 of even kernels.
        first_out: ``(V,)`` first column wanted in each view.

    Returns:
        ``(V, M, K, width_out)``.
    """
    views, rows, width_in = data.shape
    count = kernels.shape[0]
    shift = first_in - first_out  # lag of the first reading relative to the first result
    low, high = int(shift.min()), int(shift.max())
    size = fast_length(high - low + width_in + width_out - 1)
    gemm = 2.0 * width_in * width_out * count / _GEMM_FLOPS
    fft = (1 + count) * 2.5 * size * math.log2(size) / _FFT_FLOPS
    if gemm <= fft:
        # strip[q, k, j] = h_k(|q + low − j|): the rows of view v start at q = shift[v] − low
        lag = np.abs(np.arange(high - low + width_in)[:, None] + low - np.arange(width_out))
        strip_np = np.ascontiguousarray(np.moveaxis(_lookup(kernels, lag), 0, 1)).reshape(lag.shape[0], -1)
        strip = torch.from_numpy(strip_np).to(data)
        out = data.new_empty((views, rows, count * width_out))
        for v0, v1 in _runs(shift):
            q = int(shift[v0]) - low
            torch.mm(
                data[v0:v1].reshape(-1, width_in),
                strip[q : q + width_in],
                out=out[v0:v1].view(-1, count * width_out),
            )
        return out.view(views, rows, count, width_out)
    # result column j of view v needs lag j − shift[v] − i, from −high − (width_in − 1) on
    lag = np.arange(size)
    base = -high
    lag = np.where(lag < size - (width_in - 1), lag, lag - size) + base
    circular = torch.from_numpy(np.fft.rfft(_lookup(kernels, np.abs(lag)))).to(
        dtype=torch.complex128 if data.dtype == torch.float64 else torch.complex64, device=data.device
    )
    spectrum = torch.fft.rfft(data, n=size)
    result = torch.fft.irfft(spectrum[:, :, None, :] * circular, n=size)
    if low == high:
        return result[..., :width_out].contiguous()
    index = torch.from_numpy((high - shift)[:, None] + np.arange(width_out)).to(data.device)
    return torch.gather(result, 3, index[:, None, None, :].expand(views, rows, count, width_out))


def _lookup(kernels: NDArray[np.float64], lag: NDArray[np.int64]) -> NDArray[np.float64]:
    """``kernels[:, lag]``, zero where the lag lies beyond the samples (no data at that distance)."""
    inside = lag < kernels.shape[1]
    return np.where(inside, kernels[:, np.where(inside, lag, 0)], 0.0)


def _runs(values: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Stretches of equal neighbours."""
    ends = np.flatnonzero(np.diff(values)) + 1
    yield from zip([0, *ends.tolist()], [*ends.tolist(), values.size], strict=True)


def full_window(geometry: Geometry) -> DetectorWindow:
    """The window that is the whole detector."""
    rows = geometry.rows if isinstance(geometry, ConeBeam) else 1
    return DetectorWindow(np.zeros(geometry.views, np.int64), geometry.columns, 0, rows)


@dataclass(frozen=True)
class FilterPlan:
    """Weights and kernels of one filtering task: ``(..., V, rows_in, width_in) → (..., K, V, rows_out, width_out)``.

    Data of 2-D geometries have one row here.
    """

    geometry: Geometry
    kernels: tuple[str, ...]
    angular: NDArray[np.float64]
    window_in: DetectorWindow
    window_out: DetectorWindow
    samples: NDArray[np.float64] = field(init=False)
    cosine: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        g, a, b = self.geometry, self.window_in, self.window_out
        rows = g.rows if isinstance(g, ConeBeam) else 1
        for name, w in (("window_in", a), ("window_out", b)):
            if w.views != g.views:
                raise ValueError(f"{name} has {w.views} views, but the geometry has {g.views}")
            if int(w.first_column.max()) + w.columns > g.columns or w.first_row + w.rows > rows:
                raise ValueError(f"{name} reaches beyond the detector of {rows} rows × {g.columns} columns")
        if b.first_row < a.first_row or b.first_row + b.rows > a.first_row + a.rows:
            raise ValueError(
                f"the window to fill has rows {b.first_row}…{b.first_row + b.rows - 1}, but the data only rows "
                f"{a.first_row}…{a.first_row + a.rows - 1}: filtering needs every row that it returns"
            )
        if isinstance(g, ParallelBeam):
            pitch, curved = g.pitch, False
            cosine = np.ones((1, g.columns))
        elif isinstance(g, FanBeam | ConeBeam):
            column_pitch = g.pitch if isinstance(g, FanBeam) else g.pitch[1]
            curved = g.detector == "curved"
            pitch = column_pitch / g.sdd if curved else column_pitch * g.sod / g.sdd
            u, v = g.column_positions, np.zeros(1)
            if isinstance(g, ConeBeam):
                v = g.row_positions[b.first_row : b.first_row + b.rows]
            if curved:  # Kak & Slaney eq. 3.97: R′ = R · D · cos γ; one D goes into the distance weight D²/L²
                cosine = np.cos(u / g.sdd) * (g.sdd / np.hypot(g.sdd, v))[:, None] / g.sod
            else:
                cosine = g.sdd / np.sqrt(g.sdd**2 + u**2 + v[:, None] ** 2)
        else:
            raise TypeError(f"geometry must be a ParallelBeam, FanBeam or ConeBeam, got {type(g).__name__}")
        samples = np.stack([ramp_kernel(g.columns, pitch, k, equiangular=curved) * pitch for k in self.kernels])
        object.__setattr__(self, "samples", samples)
        object.__setattr__(self, "cosine", cosine)

    def _weights(self, v0: int, v1: int, like: Tensor) -> Tensor:
        """``(v, rows_out, width_in)`` weights of the readings of views v0 … v1−1."""
        columns = self.window_in.column_indices[v0:v1]
        angular = self.angular[v0:v1]
        if angular.shape[1] > 1:
            angular = np.take_along_axis(angular, columns, axis=1)
        if self.window_in.columns == self.geometry.columns:
            cosine = self.cosine[None]
        else:
            cosine = self.cosine[:, columns].swapaxes(0, 1)
        # two factors in the data's precision: much less memory traffic than a float64 product
        return torch.from_numpy(np.ascontiguousarray(angular[:, None, :])).to(like) * torch.from_numpy(
            np.ascontiguousarray(cosine)
        ).to(like)

    def _chunk(self, batch: int, itemsize: int) -> int:
        a, b, k = self.window_in, self.window_out, len(self.kernels)
        widest = int((a.first_column - b.first_column).max() - (a.first_column - b.first_column).min())
        reach = widest + a.columns + b.columns
        per_view = batch * b.rows * itemsize * (a.columns + (1 + 3 * k) * reach)
        return max(1, min(a.views, CHUNK_BYTES // max(per_view, 1)))

    def forward(self, data: Tensor) -> Tensor:
        """Weight and filter: ``(..., V, rows_in, width_in)`` to ``(..., K, V, rows_out, width_out)``."""
        a, b, k = self.window_in, self.window_out, len(self.kernels)
        lead = data.shape[:-3]
        data = data.reshape(-1, *data.shape[-3:])
        batch = data.shape[0]
        out = data.new_empty((batch, k, a.views, b.rows, b.columns))
        if batch == 0:
            return out.view(*lead, *out.shape[1:])
        r0 = b.first_row - a.first_row
        chunk = self._chunk(batch, data.element_size())
        for v0 in range(0, a.views, chunk):
            v1 = min(v0 + chunk, a.views)
            part = data[:, v0:v1, r0 : r0 + b.rows].transpose(0, 1)
            weighted = part.new_empty((v1 - v0, batch, b.rows, a.columns))
            torch.mul(part, self._weights(v0, v1, data)[:, None], out=weighted)
            filtered = _convolve(
                weighted.view(v1 - v0, -1, a.columns),
                a.first_column[v0:v1],
                self.samples,
                b.first_column[v0:v1],
                b.columns,
            )
            filtered = filtered.view(v1 - v0, batch, b.rows, k, b.columns)
            out[:, :, v0:v1] = filtered.permute(1, 3, 0, 2, 4)
        return out.view(*lead, *out.shape[1:])

    def transpose(self, gradient: Tensor) -> Tensor:
        """Transpose of :meth:`forward`: ``(..., K, V, rows_out, width_out)`` to ``(..., V, rows_in, width_in)``."""
        a, b, k = self.window_in, self.window_out, len(self.kernels)
        lead = gradient.shape[:-4]
        gradient = gradient.reshape(-1, *gradient.shape[-4:])
        batch = gradient.shape[0]
        out = gradient.new_zeros((batch, a.views, a.rows, a.columns))
        if batch == 0:
            return out.view(*lead, *out.shape[1:])
        r0 = b.first_row - a.first_row
        chunk = self._chunk(batch, gradient.element_size())
        for v0 in range(0, a.views, chunk):
            v1 = min(v0 + chunk, a.views)
            total = out.new_zeros((v1 - v0, batch, b.rows, a.columns))
            for i in range(k):
                part = gradient[:, i, v0:v1].transpose(0, 1).reshape(v1 - v0, batch * b.rows, b.columns)
                spread = _convolve(
                    part, b.first_column[v0:v1], self.samples[i : i + 1], a.first_column[v0:v1], a.columns
                )
                total += spread.view(v1 - v0, batch, b.rows, a.columns)
            total *= self._weights(v0, v1, gradient)[:, None]
            out[:, v0:v1, r0 : r0 + b.rows] = total.transpose(0, 1)
        return out.view(*lead, *out.shape[1:])


def kernel_names(kernel: str | Sequence[str]) -> tuple[tuple[str, ...], bool]:
    """The kernels asked for and whether there were several."""
    if isinstance(kernel, str):
        return (kernel,), False
    if not isinstance(kernel, Sequence) or len(kernel) == 0:
        raise TypeError(f"kernel must be a name or a non-empty sequence of names, got {kernel!r}")
    return tuple(kernel), True
