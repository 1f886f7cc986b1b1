"""Ramp filtering of detector rows, from one window of columns to another, and its exact transpose.

Filtering is a linear convolution along the columns with the closed-form apodised kernel, so that
the result does not depend on how it is computed: as a matrix product where few columns go in or
out, by FFT otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon.analytic.ramp import fast_length, ramp_kernel
from torchpcct.detector_window import DetectorWindow
from torchpcct.geometry import Geometry, ParallelBeam, beam
from torchpcct.threads import run
from torchpcct.validate import shaped

if TYPE_CHECKING:
    from torchpcct.typing import Reals


CHUNK_BYTES = 48 * 2**20
"""Intermediate results of filtering are kept near this size; larger scans are processed in chunks
of views."""
_GEMM_FLOPS = 40.0
"""Operations of matrix products per nanosecond on a common core, only used to choose the faster of
these and FFTs."""
_FFT_FLOPS = 4.0
"""Operations of FFTs per nanosecond."""


def _lookup(kernels: NDArray[np.float64], lag: NDArray[np.int64]) -> NDArray[np.float64]:
    """``kernels[:, lag]``, zero where the lag lies beyond the samples (no data at that
    distance)."""
    inside = lag < kernels.shape[1]
    return np.where(inside, kernels[:, np.where(inside, lag, 0)], 0.0)


@dataclass(frozen=True)
class FilterPlan:
    """Weights and kernels of one filtering task: ``(..., V, rows_in, width_in) → (..., K, V,
    rows_out, width_out)``.

    Data of 2-D geometries have one row here.
    """

    geometry: Geometry
    kernels: tuple[str, ...]
    angular: NDArray[np.float64]
    window_in: DetectorWindow
    window_out: DetectorWindow
    samples: NDArray[np.float64] = field(init=False)
    cosine: NDArray[np.float64] = field(init=False)
    by_matrix: bool = field(init=False)
    """Whether a matrix product is cheaper than FFTs."""
    _offset: NDArray[np.int64] = field(init=False)
    """Position of the data of every view in a frame in which the results start at the same
    place."""
    _length: int = field(init=False)
    """Width of that frame."""
    _fft_size: int = field(init=False)

    def __post_init__(self) -> None:
        g, a, b = beam(self.geometry), self.window_in, self.window_out
        for name, w in (("window_in", a), ("window_out", b)):
            w.check(g, name)
        shaped(
            "angular",
            self.angular,
            (g.views, 1 if np.shape(self.angular)[-1:] == (1,) else g.columns),
        )
        if b.first_row < a.first_row or b.first_row + b.rows > a.first_row + a.rows:
            raise ValueError(
                f"the window to fill has rows {b.first_row}…{b.first_row + b.rows - 1}, but the "
                f"data only rows {a.first_row}…{a.first_row + a.rows - 1}: filtering needs every "
                "row that it returns"
            )
        if isinstance(g, ParallelBeam):
            pitch, curved = g.column_pitch, False
            cosine = np.ones((1, g.columns))
        else:
            curved = g.detector == "curved"
            pitch = g.column_pitch / g.sdd if curved else g.column_pitch * g.sod / g.sdd
            u, v = g.column_positions, g.row_positions[b.first_row : b.first_row + b.rows]
            # Kak & Slaney eq. 3.97: R′ = R · D · cos γ; one D goes into the distance weight D²/L²
            if curved:
                cosine = np.cos(u / g.sdd) * (g.sdd / np.hypot(g.sdd, v))[:, None] / g.sod
            else:
                cosine = g.sdd / np.sqrt(g.sdd**2 + u**2 + v[:, None] ** 2)
        samples = np.stack(
            [ramp_kernel(g.columns, pitch, k, equiangular=curved) * pitch for k in self.kernels]
        )
        shift = a.first_column - b.first_column
        offset = shift - shift.min()
        length = int(offset.max()) + a.columns
        fft_size = fast_length(length + b.columns - 1)
        count = len(self.kernels)
        by_matrix_ns = 2.0 * length * b.columns * count / _GEMM_FLOPS
        by_fft_ns = (1 + count) * 2.5 * fft_size * math.log2(fft_size) / _FFT_FLOPS
        for name, value in (
            ("samples", samples),
            ("cosine", cosine),
            ("by_matrix", by_matrix_ns <= by_fft_ns),
            ("_offset", offset),
            ("_length", length),
            ("_fft_size", fft_size),
        ):
            object.__setattr__(self, name, value)

    @property
    def chunk(self) -> int:
        """Views whose intermediate results in float64 stay near :data:`CHUNK_BYTES`."""
        width = self._length if self.by_matrix else self._length + 6 * self._fft_size
        return max(1, min(self.window_in.views, CHUNK_BYTES // (8 * self.window_out.rows * width)))

    def _responses(self, like: Tensor) -> Tensor:
        """Matrices ``(K, length, width_out)``, or frequency responses ``(K, size // 2 + 1)``."""
        low = int((self.window_in.first_column - self.window_out.first_column).min())
        if self.by_matrix:
            lag = np.arange(self._length)[:, None] + low - np.arange(self.window_out.columns)
            return torch.from_numpy(_lookup(self.samples, np.abs(lag))).to(like)
        size = self._fft_size
        lag = np.arange(size)
        lag = np.where(lag < size - (self._length - 1), lag, lag - size) - low
        response = torch.from_numpy(np.fft.rfft(_lookup(self.samples, np.abs(lag))))
        return response.to(
            dtype=torch.promote_types(like.dtype, torch.complex32), device=like.device
        )

    def _weights(self, like: Tensor) -> list[Reals]:
        number = np.float64 if like.dtype == torch.float64 else np.float32
        rows = np.broadcast_to(self.cosine, (self.window_out.rows, self.geometry.columns))
        return [self.angular.astype(number), np.ascontiguousarray(rows, dtype=number)]

    def _placed(self, v0: int, v1: int, like: Tensor) -> tuple[Tensor, Tensor]:
        """Of the views ``v0 … v1 - 1`` the place of every reading in the common frame, ``(v, 1,
        width_in)``, and its weight, ``(v, R, width_in)``, on the device of ``like``."""
        a = self.window_in
        angular, cosine = self._weights(like)
        columns = a.column_indices[v0:v1]
        views = np.arange(v0, v1)[:, None]
        factor = torch.from_numpy(angular[views, columns if angular.shape[1] > 1 else 0])
        rows = torch.from_numpy(np.array(cosine)).to(like.device)
        at = torch.from_numpy(columns).to(like.device)
        weight = factor.to(like.device)[:, None] * rows[:, at].transpose(0, 1)
        place = self._offset[v0:v1, None] + np.arange(a.columns)
        return torch.from_numpy(place).to(like.device)[:, None], weight

    def _forward_there(self, data: Tensor) -> Tensor:
        """:meth:`forward` with torch alone, on any device."""
        a, b = self.window_in, self.window_out
        lead = data.shape[:-3]
        data = data.reshape(math.prod(lead), *data.shape[-3:])
        out = data.new_empty((data.shape[0], len(self.kernels), a.views, b.rows, b.columns))
        responses, r0 = self._responses(data), b.first_row - a.first_row
        for v0 in range(0, a.views, self.chunk):
            v1 = min(v0 + self.chunk, a.views)
            place, weight = self._placed(v0, v1, data)
            for source, target in zip(data, out, strict=True):
                frame = data.new_zeros((v1 - v0, b.rows, self._length))
                rows = source[v0:v1, r0 : r0 + b.rows] * weight
                frame.scatter_(-1, place.expand_as(rows), rows)
                self._convolve(frame, responses, target[:, v0:v1])
        return out.view(*lead, *out.shape[1:])

    def _transpose_there(self, gradient: Tensor) -> Tensor:
        """:meth:`transpose` with torch alone, on any device."""
        a, b = self.window_in, self.window_out
        lead = gradient.shape[:-4]
        gradient = gradient.reshape(math.prod(lead), *gradient.shape[-4:])
        out = gradient.new_zeros((gradient.shape[0], a.views, a.rows, a.columns))
        responses, r0 = self._responses(gradient), b.first_row - a.first_row
        for v0 in range(0, a.views, self.chunk):
            v1 = min(v0 + self.chunk, a.views)
            place, weight = self._placed(v0, v1, gradient)
            for source, target in zip(gradient, out, strict=True):
                frame = self._correlate(source[:, v0:v1], responses)
                rows = frame.gather(-1, place.expand(*frame.shape[:-1], a.columns))
                target[v0:v1, r0 : r0 + b.rows] += rows * weight
        return out.view(*lead, *out.shape[1:])

    def forward(self, data: Tensor) -> Tensor:
        """Weight and filter: ``(..., V, rows_in, width_in)`` to ``(..., K, V, rows_out,
        width_out)``, by numba's kernels on the CPU and by torch on any other device."""
        if data.device.type != "cpu":
            return self._forward_there(data)
        from recon.analytic.align_kernels import align  # numba loads with its first use

        a, b = self.window_in, self.window_out
        lead = data.shape[:-3]
        data = data.reshape(math.prod(lead), *data.shape[-3:])
        out = data.new_empty((data.shape[0], len(self.kernels), a.views, b.rows, b.columns))
        responses, (angular, cosine), offset = (
            self._responses(data),
            self._weights(data),
            self._offset,
        )
        r0, first, chunk = b.first_row - a.first_row, a.first_column, self.chunk
        buffer = data.new_empty((chunk, b.rows, self._length))
        for v0 in range(0, a.views, chunk):
            v1 = min(v0 + chunk, a.views)
            frame = buffer[: v1 - v0]
            for source, target in zip(data, out, strict=True):
                rows = source[v0:v1, r0 : r0 + b.rows]
                views = angular[v0:v1], cosine, first[v0:v1], offset[v0:v1]
                run(
                    align, v1 - v0, rows.numpy(), *views, frame.numpy(), operations=frame[0].numel()
                )
                self._convolve(frame, responses, target[:, v0:v1])
        return out.view(*lead, *out.shape[1:])

    def _convolve(self, frame: Tensor, responses: Tensor, out: Tensor) -> None:
        """``frame (v, R, length)`` into ``out (K, v, R, width_out)``."""
        width = self.window_out.columns
        if self.by_matrix:
            for matrix, target in zip(responses, out, strict=True):
                torch.mm(frame.view(-1, self._length), matrix, out=target.view(-1, width))
            return
        spectrum = torch.fft.rfft(frame, n=self._fft_size)
        for response, target in zip(responses, out, strict=True):
            target.copy_(torch.fft.irfft(spectrum * response, n=self._fft_size)[..., :width])

    def transpose(self, gradient: Tensor) -> Tensor:
        """Transpose of :meth:`forward`: ``(..., K, V, rows_out, width_out)`` to ``(..., V,
        rows_in, width_in)``."""
        if gradient.device.type != "cpu":
            return self._transpose_there(gradient)
        from recon.analytic.align_kernels import unalign  # numba loads with its first use

        a, b = self.window_in, self.window_out
        lead = gradient.shape[:-4]
        gradient = gradient.reshape(math.prod(lead), *gradient.shape[-4:])
        out = gradient.new_zeros((gradient.shape[0], a.views, a.rows, a.columns))
        responses, (angular, cosine), offset = (
            self._responses(gradient),
            self._weights(gradient),
            self._offset,
        )
        r0, first, chunk = b.first_row - a.first_row, a.first_column, self.chunk
        for v0 in range(0, a.views, chunk):
            v1 = min(v0 + chunk, a.views)
            for source, target in zip(gradient, out, strict=True):
                frame = self._correlate(source[:, v0:v1], responses)
                rows = target[v0:v1, r0 : r0 + b.rows]
                views = angular[v0:v1], cosine, first[v0:v1], offset[v0:v1]
                run(
                    unalign,
                    v1 - v0,
                    frame.numpy(),
                    *views,
                    rows.numpy(),
                    operations=frame[0].numel(),
                )
        return out.view(*lead, *out.shape[1:])

    def _correlate(self, gradient: Tensor, responses: Tensor) -> Tensor:
        """Transpose of :meth:`_convolve`: ``(K, v, R, width_out)`` to ``(v, R, length)``."""
        if self.by_matrix:
            return torch.einsum("kvrj,kij->vri", gradient, responses)
        spectrum = torch.fft.rfft(gradient, n=self._fft_size)
        total = (spectrum * responses[:, None, None, :].conj()).sum(dim=0)
        return torch.fft.irfft(total, n=self._fft_size)[..., : self._length].contiguous()


def kernel_names(kernel: str | Sequence[str]) -> tuple[tuple[str, ...], bool]:
    """The kernels asked for and whether there were several."""
    if isinstance(kernel, str):
        return (kernel,), False
    if not isinstance(kernel, Sequence) or len(kernel) == 0:
        raise TypeError(f"kernel must be a name or a non-empty sequence of names, got {kernel!r}")
    return tuple(kernel), True
