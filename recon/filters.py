"""Edge-preserving filters of a finished volume: tools, and what a reconstruction has to beat.

Each is called as ``filter(volume, noise_hu, **settings)`` with a volume ``(z, y, x)`` of FBP or
PWLS in HU, on cubic voxels, and gives one of the same shape, dtype and kind (tensor or array).
Lengths are in voxels. ``noise_hu`` is the standard deviation of flat tissue that the filter's
threshold refers to, as :func:`flat_noise` measures it:

* of the volume itself for :func:`gaussian` (which ignores it), :func:`nlm`, :func:`tv` and
  :func:`bm4d`;
* of the volume that the edges are looked for in, smoothed by ``sigma`` voxels, for
  :func:`perona_malik` and :func:`bilateral`. CT noise is correlated, and after smoothing by a given
  width its level depends on the kernel.

:func:`denoised` measures that level in a flat region and calls a filter by its name. Constants pass
through all of them, a constant that is added to a volume is added to the result, and twice the
volume with twice the noise gives twice the result; so none has a zero that it shrinks towards. What
they take away with the noise is the contrast of small weak things: judge them by contrast and its
slope, too, not by smoothness alone (:mod:`recon.evaluate.rivals` has settings that were tuned). In
the place of MBIR's network: :mod:`recon.mbir.priors`.
"""

from __future__ import annotations

import importlib
import inspect
import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor, nn
from torch.nn import functional as F

from torchpcct.validate import checked, choice, number, whole

__all__ = [
    "FILTERS",
    "SMOOTHED_BY",
    "bilateral",
    "bm4d",
    "deepinv_denoiser",
    "denoised",
    "flat_noise",
    "gaussian",
    "nlm",
    "perona_malik",
    "tv",
]

Image = TypeVar("Image", Tensor, NDArray[np.generic])

_REACH = 4.0
"""Standard deviations to which a Gaussian is summed."""


@checked
def gaussian(volume: Image, noise_hu: float = 0.0, *, sigma: float = 1.0) -> Image:
    """The volume smoothed by a Gaussian, which keeps no edges: what the others must do better than.

    Args:
        volume: ``(z, y, x)`` HU.
        noise_hu: not used.
        sigma: standard deviation in voxels; 0 gives the volume back.

    Raises:
        ValueError, TypeError: a volume that is not 3-D, real and finite; a negative ``sigma``.
    """
    u, back = _opened(volume)
    return back(_smoothed(u, number("sigma", sigma, low=0.0, unit="voxels")))


@checked
def perona_malik(
    volume: Image,
    noise_hu: float,
    *,
    sigma: float = 0.7,
    edge: float = 1.3,
    steps: int = 15,
    rate: float = 1 / 7,
) -> Image:
    """Regularised anisotropic diffusion in 3-D (Catté, Lions, Morel, Coll 1992, SIAM J. Numer.
    Anal. 29:182).

    ``steps`` times u ← u + rate Σ (u_q − u) exp(−((Gu_q − Gu) / (edge · noise_hu))²) over the six
    neighbours q, with a Gaussian G: voxels are mixed with neighbours from which they differ by no
    more than noise, once it is smoothed. The mean of the volume stays what it was.

    Args:
        volume: ``(z, y, x)`` HU.
        noise_hu: standard deviation in flat tissue of the volume smoothed by ``sigma``.
        sigma: of G in voxels; 0 is the filter of Perona and Malik 1990, which takes noise for
            edges.
        edge: differences beyond ``edge · noise_hu`` are kept.
        steps: more smooth farther.
        rate: of a step, at most 1/6, where it stays stable.

    Raises:
        ValueError, TypeError: a volume that is not 3-D, real and finite; a setting out of range.
    """
    u, back = _opened(volume)
    scale = _noise(noise_hu) * number("edge", edge, positive=True)
    sigma, rate = (
        number("sigma", sigma, low=0.0, unit="voxels"),
        number("rate", rate, low=0.0, high=1 / 6),
    )
    for _ in range(whole("steps", steps, low=0)):
        guide, change = _smoothed(u, sigma), torch.zeros_like(u)
        for axis in range(3):
            n = u.shape[axis]
            if n == 1:
                continue
            flow = torch.exp(-(guide.diff(dim=axis) / scale).square()) * u.diff(dim=axis)
            change.narrow(axis, 0, n - 1).add_(flow)
            change.narrow(axis, 1, n - 1).sub_(flow)
        u = u + rate * change
    return back(u)


@checked
def bilateral(
    volume: Image, noise_hu: float, *, sigma: float = 1.4, edge: float = 2.0, reach: float = 2.5
) -> Image:
    """Joint bilateral filter in 3-D: a mean over the neighbourhood of what looks alike in the
    smoothed volume.

    Weights are exp(−d² / (2 reach²) − ((Gu_q − Gu) / (edge · noise_hu))² / 2) at the distance d
    (Tomasi, Manduchi 1998, ICCV; guided by the volume's own smooth version, as Petschnigg et al.
    2004, ACM Trans. Graph. 23:664, by another). The defaults have the least error in vessels of any
    direction on 0.2 mm voxels of FBP with the detail kernel.

    Args:
        volume: ``(z, y, x)`` HU.
        noise_hu: standard deviation in flat tissue of the volume smoothed by ``sigma``.
        sigma: of G in voxels; 0 is the plain bilateral filter.
        edge: differences beyond a few times ``edge · noise_hu`` are kept.
        reach: standard deviation of the neighbourhood in voxels; it ends at twice that.

    Raises:
        ValueError, TypeError: a volume that is not 3-D, real and finite; a setting out of range.
    """
    u, back = _opened(volume)
    scale = _noise(noise_hu) * number("edge", edge, positive=True)
    reach = number("reach", reach, positive=True, unit="voxels")
    radius = math.ceil(2.0 * reach - 1e-9)
    guide = _padded(_smoothed(u, number("sigma", sigma, low=0.0, unit="voxels")), radius)
    values = _padded(u, radius)
    middle = _window(guide, (radius,) * 3, u.shape)
    total, sums = torch.zeros_like(u), torch.zeros_like(u)
    for offset in itertools.product(range(2 * radius + 1), repeat=3):
        d2 = sum((k - radius) ** 2 for k in offset)
        if d2 > (2.0 * reach) ** 2:
            continue
        unlike = (_window(guide, offset, u.shape) - middle).div_(scale).square_()
        weight = unlike.add_(d2 / reach**2).mul_(-0.5).exp_()
        total.add_(weight)
        # Differences to the voxel itself, so that a large constant costs no digits.
        sums.addcmul_(weight, _window(values, offset, u.shape) - u)
    return back(u + sums / total)


@checked
def nlm(
    volume: Image,
    noise_hu: float,
    *,
    strength: float = 0.6,
    patch: int = 1,
    search: int = 4,
    noise_factor: float = 1.0,
) -> Image:
    """Non-local means in 3-D: a mean over voxels whose neighbourhoods are alike (Buades, Coll,
    Morel 2005, CVPR).

    Weights are exp(−max(D² − 2 (noise_factor · noise_hu)², 0) / (strength · noise_hu)²), D² the
    mean squared difference of two cubes. (scikit-image's fast mode compares cubes that are not
    centred: there a mirrored volume gives another result.)

    Args:
        volume: ``(z, y, x)`` HU.
        noise_hu: standard deviation in flat tissue.
        strength: differences count from ``strength · noise_hu``.
        patch: the compared cubes reach so many voxels to each side.
        search: how far alike cubes are looked for, in voxels to each side.
        noise_factor: noise between like cubes over ``noise_hu``; it is subtracted from their
            difference. 0: nothing is.

    Raises:
        ValueError, TypeError: a volume that is not 3-D, real and finite; a setting out of range.
    """
    u, back = _opened(volume)
    noise = _noise(noise_hu)
    h = number("strength", strength, positive=True) * noise
    expected = 2.0 * (number("noise_factor", noise_factor, low=0.0) * noise) ** 2
    patch, search = whole("patch", patch, low=0), whole("search", search, low=0)
    wide = _padded(u, search + patch)
    middle = _window(wide, (search,) * 3, torch.Size(n + 2 * patch for n in u.shape))
    total, sums = torch.zeros_like(u), torch.zeros_like(u)
    for offset in itertools.product(range(2 * search + 1), repeat=3):
        other = _window(wide, offset, middle.shape)
        unlike = (other - middle).square_()
        for axis, n in enumerate(u.shape):
            unlike = sum(
                (unlike.narrow(axis, k, n) for k in range(1, 2 * patch + 1)),
                unlike.narrow(axis, 0, n),
            )
        weight = (
            unlike.div_((2 * patch + 1) ** 3).sub_(expected).clamp_(min=0.0).div_(-(h**2)).exp_()
        )
        total.add_(weight)
        sums.addcmul_(weight, _window(other, (patch,) * 3, u.shape) - u)
    return back(u + sums / total)


@checked
def tv(volume: Image, noise_hu: float, *, strength: float = 1.0, steps: int = 100) -> Image:
    """Total variation in 3-D (Rudin, Osher, Fatemi 1992, Physica D 60:259), solved by scikit-image
    (Chambolle 2004).

    Args:
        volume: ``(z, y, x)`` HU.
        noise_hu: standard deviation in flat tissue.
        strength: ``strength · noise_hu`` is the weight of the total variation against half of the
            squared distance to the volume.
        steps: of the solver.

    Raises:
        ValueError, TypeError: a volume that is not 3-D, real and finite; a setting out of range.
    """
    from skimage.restoration import denoise_tv_chambolle

    u, back = _opened(volume)
    weight = number("strength", strength, positive=True) * _noise(noise_hu)
    level = float(u.mean())
    found = denoise_tv_chambolle(
        _array(u - level), weight=weight, eps=1e-6, max_num_iter=whole("steps", steps)
    )
    return back(torch.from_numpy(np.ascontiguousarray(found)).to(u) + level)


@checked
def bm4d(
    volume: Image, noise_hu: float, *, strength: float = 1.0, covariance: ArrayLike | None = None
) -> Image:
    """BM4D: collaborative filtering of groups of like blocks, for correlated noise (Mäkinen,
    Azzari, Foi 2020, IEEE Trans. Image Process. 29:8339; Maggioni et al. 2013).

    It needs the package ``bm4d`` of Tampere University (extra ``rivals``), whose licence allows
    NON-COMMERCIAL use only; nothing of it is part of this package.

    Args:
        volume: ``(z, y, x)`` HU.
        noise_hu: standard deviation in flat tissue.
        strength: factor on the noise that it is given.
        covariance: of a voxel's noise with those around it, HU² or any multiple of it, the voxel
            itself in the middle; odd numbers of voxels, at most the volume's
            (:func:`recon.analytic.exact_noise.voxel_covariance` gives FBP's). None: white noise.

    Raises:
        ImportError: the package is not installed, or does not run with this NumPy (4.2.5 needs less
            than 2.4).
        ValueError, TypeError: a volume that is not 3-D, real and finite; a setting out of range; a
            covariance of another kind.
    """
    u, back = _opened(volume)
    noise = _noise(noise_hu) * number("strength", strength, positive=True)
    try:
        package = importlib.import_module("bm4d")
    except ImportError:
        raise ImportError(
            'BM4D needs its authors\' package: pip install "torchpcct[rivals]" (its licence '
            "allows non-commercial use "
            "only), or use another filter"
        ) from None
    level = float(u.mean())
    noise_spectrum = (
        noise if covariance is None else noise**2 * _spectrum(covariance, tuple(u.shape))
    )
    try:
        found = np.asarray(package.bm4d(_array(u - level).astype(np.float64), noise_spectrum))
    except AttributeError as error:
        # Release 4.2.5 calls a function that NumPy 2.4 has dropped.
        raise ImportError(
            f"this release of bm4d does not run with NumPy {np.__version__} ({error})"
        ) from error
    return back(torch.from_numpy(found.reshape(u.shape)).to(u) + level)


FILTERS: dict[str, Callable[..., Any]] = {
    "gaussian": gaussian,
    "perona_malik": perona_malik,
    "bilateral": bilateral,
    "nlm": nlm,
    "tv": tv,
    "bm4d": bm4d,
}
"""By name."""

SMOOTHED_BY: Mapping[str, float] = {"perona_malik": 0.7, "bilateral": 1.4}
"""Filters whose ``noise_hu`` is that of the volume smoothed by ``sigma``, with the default of
that."""


@checked
def denoised(name: str, volume: Image, flat: object, **settings: Any) -> Image:
    """A volume filtered, with the noise measured in a region of it.

    Args:
        name: of :data:`FILTERS`.
        volume: ``(z, y, x)`` HU.
        flat: bool mask of its shape, True in flat tissue: some hundred voxels or more of one
            tissue, clear of edges.
        settings: of the filter.

    Raises:
        ValueError, TypeError: an unknown name, a mask of another shape or of fewer than 8 voxels,
            no noise in the region, and what the filter refuses.
    """
    run = FILTERS[choice("filter", name, FILTERS)]
    sigma = settings.get("sigma", SMOOTHED_BY[name]) if name in SMOOTHED_BY else 0.0
    return run(volume, flat_noise(volume, flat, sigma=sigma), **settings)


@checked
def flat_noise(volume: Image, flat: object, *, sigma: float = 0.0) -> float:
    """Standard deviation in HU of a region that is flat in truth, of the volume smoothed by
    ``sigma`` voxels.

    Args:
        volume: ``(z, y, x)`` HU.
        flat: bool mask of its shape.
        sigma: as the filter has it.

    Raises:
        ValueError, TypeError: as for :func:`denoised`.
    """
    u, _ = _opened(volume)
    mask = torch.as_tensor(flat, device=u.device)
    if mask.dtype != torch.bool or mask.shape != u.shape:
        raise ValueError(
            f"flat must be a bool mask of the volume's shape {tuple(u.shape)}, got "
            f"{tuple(mask.shape)} {mask.dtype}"
        )
    if int(mask.sum()) < 8:
        raise ValueError(
            f"the flat region has {int(mask.sum())} voxels: 8 are the least, some hundred are good"
        )
    found = float(_smoothed(u, number("sigma", sigma, low=0.0, unit="voxels"))[mask].double().std())
    if found <= 0:
        raise ValueError(
            "the flat region has no noise at all: give a region inside the object, or noise_hu "
            "yourself"
        )
    return found


def denoiser_of(function: Callable[..., object]) -> Callable[[Tensor, Callable[[], float]], object]:
    """A user's denoiser in the form ``(volume, noise)``: ``noise()`` gives the noise in HU, where
    it is asked for.

    Args:
        function: of ``(volume)`` or ``(volume, sigma)``: HU ``(z, y, x)`` float32, and the standard
            deviation of a voxel's noise in HU; it gives the same shape. Or a denoiser of deepinv
            itself, whose images have axes for batch and channel: that becomes
            :func:`deepinv_denoiser`, of slices unless it convolves in 3-D.
    """
    if any(kind.__module__.partition(".")[0] == "deepinv" for kind in type(function).__mro__):
        whole_volumes = isinstance(function, nn.Module) and any(
            isinstance(m, nn.Conv3d) for m in function.modules()
        )
        function = deepinv_denoiser(function, slices=not whole_volumes)
    if len(places_of(function)) > 1:
        return lambda volume, noise: function(volume, noise())
    return lambda volume, noise: function(volume)


def places_of(function: Callable[..., object]) -> list[inspect.Parameter]:
    """Arguments of a function, or of a module's ``forward``, that may be given by place."""
    try:
        signature = inspect.signature(
            function.forward if isinstance(function, nn.Module) else function
        )
    except (TypeError, ValueError):  # of a compiled function that does not tell: it gets a volume
        return []
    named = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return [p for p in signature.parameters.values() if p.kind in named]


@checked
def deepinv_denoiser(
    model: Callable[..., Any], *, unit_hu: float = 1000.0, slices: bool = False
) -> Callable[[Tensor, float], Tensor]:
    """A denoiser of deepinv (``model(x, sigma)`` of images with batch and channel) as
    :func:`denoiser_of` takes it.

    Args:
        model: denoises images ``(batch, 1, …)`` with values of about 0 … 1.
        unit_hu: the CT number that is scaled to 1, HU; 0 HU stays 0.
        slices: True for a 2-D model, whose batch are the slices. Otherwise the volume is one 3-D
            image.

    Returns:
        A function of a volume ``(z, y, x)`` in HU and the standard deviation of its noise in HU;
        it returns HU of the same shape.

    Raises:
        ValueError: a ``unit_hu`` that is not positive.
    """
    unit = number("unit_hu", unit_hu, positive=True, unit="HU")

    def run(volume: Tensor, sigma: float) -> Tensor:
        x = (volume[:, None] if slices else volume[None, None]) / unit
        with torch.no_grad():
            found: Tensor = model(x, sigma / unit)
        return found.reshape(volume.shape) * unit

    run.__name__ = type(model).__name__
    return run


def _opened(volume: Image) -> tuple[Tensor, Callable[[Tensor], Image]]:
    """The volume as a floating tensor without gradient, and the way back to its own kind and
    dtype."""
    if isinstance(volume, Tensor):
        u = volume.detach()
    elif isinstance(volume, np.ndarray) and volume.dtype.kind in "fiu":
        u = torch.from_numpy(
            np.ascontiguousarray(volume, dtype=np.result_type(volume.dtype, np.float32))
        )
    else:
        kind = getattr(volume, "dtype", type(volume).__name__)
        raise TypeError(
            f"volume must be a real tensor or array (z, y, x) in HU, got {kind}: of a Volume take "
            "its .data"
        )
    if u.is_complex() or u.dtype == torch.bool:
        raise TypeError(f"volume must be real, got {u.dtype}")
    if u.ndim != 3 or u.numel() == 0:
        raise ValueError(
            f"volume must be (z, y, x) with voxels in it, got the shape {tuple(u.shape)}"
        )
    u = u.to(torch.promote_types(u.dtype, torch.float32))
    bad = int((~torch.isfinite(u)).sum())
    if bad:
        raise ValueError(f"{bad} voxels of the volume are NaN or infinite: fill them before")

    def back(found: Tensor) -> Image:
        if isinstance(volume, Tensor):
            return found.to(volume.dtype) if volume.is_floating_point() else found
        out = found.numpy()
        return out.astype(volume.dtype) if volume.dtype.kind == "f" else out

    return u, back


def _noise(noise_hu: float) -> float:
    return number("noise_hu", noise_hu, positive=True, unit="HU")


def _array(u: Tensor) -> NDArray[np.generic]:
    return np.ascontiguousarray(u.cpu().numpy())


def _padded(u: Tensor, width: int) -> Tensor:
    """With the outermost voxels repeated on every side."""
    return F.pad(u[None, None], (width,) * 6, mode="replicate")[0, 0]


def _window(u: Tensor, start: tuple[int, ...], shape: torch.Size) -> Tensor:
    return u[tuple(slice(k, k + n) for k, n in zip(start, shape, strict=True))]


def _smoothed(u: Tensor, sigma: float) -> Tensor:
    """Gaussian along each axis, edges repeated; far below a voxel the volume itself."""
    if sigma < 0.05:
        return u
    found = gaussian_filter(_array(u), sigma, mode="nearest", radius=math.ceil(_REACH * sigma))
    return torch.from_numpy(found).to(u.device)


def _spectrum(covariance: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Power spectrum of noise of variance 1 on a volume of a shape, as ``bm4d`` counts it: its
    sum is voxels²."""
    cov = np.asarray(covariance, dtype=np.float64)
    if cov.ndim != 3 or any(n % 2 == 0 or n > m for n, m in zip(cov.shape, shape, strict=False)):
        raise ValueError(
            f"covariance must be 3-D with odd numbers of voxels, at most the volume's {shape}, "
            f"got {cov.shape}"
        )
    middle = tuple(n // 2 for n in cov.shape)
    if not np.isfinite(cov).all() or not cov[middle] > 0:
        raise ValueError(
            "covariance must be finite and positive in its middle, where the voxel itself is"
        )
    whole_ = np.zeros(shape)
    whole_[tuple(slice(n) for n in cov.shape)] = cov / cov[middle]
    whole_ = np.roll(whole_, [-k for k in middle], axis=(0, 1, 2))
    power = np.clip(np.fft.fftn(whole_).real, 0.0, None)
    found: NDArray[np.float64] = power * (math.prod(shape) ** 2 / power.sum())
    return found
