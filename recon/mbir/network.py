"""The learned prior: a small 3-D U-Net, blind to the unit of its input, that knows the noise level.

It sees two volumes in noise units (:mod:`recon.data_term`), the estimate so far and what a step
towards the data would make of it, and gives a new estimate. (To give what must be added, the noise
with the other sign, takes ten times as long to learn: the noise passes through every layer then.)
Convolutions have no bias and every nonlinearity is a leaky ReLU, so the network is homogeneous:
twice the input gives twice the output, and a volume of zeros stays zero (Mohan, Kadkhodaie,
Simoncelli, Fernandez-Granda 2020, ICLR: bias-free networks generalise over noise levels). What else
it must know, the noise scale in HU (tissues have their HU), the fidelity and the step, changes
gains of its channels only.

A homogeneous network shrinks what it is unsure of towards 0, and 0 is the level that the volume is
counted from (the fat about a vessel) unless ``local_mm`` is given: then the network works on
differences from a Gaussian mean about each voxel, and a constant that is added to the volume passes
through, so that all tissues are alike to it. With ``turns`` the result is the mean over quarter
turns and mirror images about z, and a scene that is turned gives the turned volume.

Blocks of 2 × 2 × 2 voxels become channels first (Shi et al. 2016, CVPR, sub-voxel convolution), two
more halvings follow (Ronneberger, Fischer, Brox 2015, U-Net): at 0.2 mm the coarsest cells have 1.6
mm, and the network sees 6 mm about each voxel, a whole plaque.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from recon.mbir.bilateral import joint_bilateral
from torchpcct.projector.operator import apply_linear
from torchpcct.validate import number, whole

__all__ = ["REFERENCE_SCALE_HU", "Network", "NetworkConfig", "bilateral_prior"]

CONDITIONS = 3
"""Numbers that steer the gains: logarithm of the noise scale, fidelity, step."""
REFERENCE_SCALE_HU = 200.0
"""Noise scale at which its conditioning variable is 0: about 1 s of the paper's scan."""
GUIDE_VOXELS = 1.4
"""Width of the Gaussian that makes the bilateral filter's guide."""
_FIRST = (2.8, 2.5, 1)
"""The first run of the bilateral filter: difference of the guide, in noise, that counts as an edge;
reach and step in voxels."""
_SECOND = (1.4, 4.0, 2)
"""The second run, guided by what the first has left."""
_SLOPE = 0.1
"""Of the leaky rectifiers below 0."""
_LEAST = 1e-3
"""In noise units: what the gate takes for 0."""
_BLOCK = 2
"""Edge in voxels of the blocks that become channels."""
_MOST_CHANNELS = 2**14
"""Channels of a level at most: two such levels have 7e9 weights."""
_DEPTH = 3
"""Levels of resolution."""


@dataclass(frozen=True)
class NetworkConfig:
    """Size of the network.

    Args:
        channels: of the three levels.
        voxel_mm: size of the cubic voxels that it is for.
        local_mm: standard deviation of the Gaussian mean that it works relative to, mm; 0: relative
            to the level that the volume is counted from.
        bilateral: a third view of the data: the step towards them through a joint bilateral filter,
            twice (:mod:`recon.mbir.bilateral`), to which the network adds what the filter has taken
            away.
        gate: how much of the filtered view is in the result is decided voxel by voxel, else by one
            number. Where tissue is wide and constant the filter is close to ideal, and nothing that
            is added to it would be better.
        extremes: two more views, of which the gate may take a part, too: the highest and the lowest
            value of the filtered view in the voxel and its 26 neighbours. At an edge they are the
            values of its two sides, and to take one or the other sharpens it (Kramer, Bruckner
            1975, Pattern Recognition 7: a toggle between dilation and erosion).
        turns: once trained, average over the eight turns and mirror images about z.
    """

    channels: tuple[int, int, int] = (20, 32, 36)
    voxel_mm: float = 0.2
    local_mm: float = 0.0
    turns: bool = False
    bilateral: bool = False
    gate: bool = False
    extremes: bool = False

    def __post_init__(self) -> None:
        given = self.channels
        if not isinstance(given, list | tuple) or len(given) != _DEPTH:
            raise ValueError(f"channels must name {_DEPTH} levels, got {given!r}")
        channels = tuple(whole("channels", c, 1, _MOST_CHANNELS) for c in given)
        object.__setattr__(self, "channels", channels)
        object.__setattr__(self, "voxel_mm", number("voxel_mm", self.voxel_mm, positive=True))
        object.__setattr__(self, "local_mm", number("local_mm", self.local_mm, low=0.0, unit="mm"))
        for name in ("turns", "bilateral", "gate", "extremes"):
            if not isinstance(getattr(self, name), bool):
                raise TypeError(f"{name} must be true or false, got {getattr(self, name)!r}")
        if self.gate and not self.bilateral:
            raise ValueError("gate needs the filtered view: set bilateral, too")
        if self.extremes and not self.gate:
            raise ValueError("extremes are views for the gate: set gate, too")

    @property
    def filtered_views(self) -> int:
        """How many views are of the filtered image."""
        return (1 if self.bilateral else 0) + (2 if self.extremes else 0)


class Network(nn.Module):
    """A new estimate from an old one and the data.

    Args:
        config: size.

    Attributes:
        half_precision: convolve in bfloat16 while training.
    """

    def __init__(self, config: NetworkConfig | None = None) -> None:
        super().__init__()
        self.config = c = config or NetworkConfig()
        self.half_precision = False
        first, middle, last = c.channels
        self.enter = _convolution((2 + c.filtered_views) * _BLOCK**3, first)
        self.down = nn.ModuleList([_Block(first), _Block(middle), _Block(last)])
        self.narrow = nn.ModuleList([_convolution(first, middle), _convolution(middle, last)])
        self.widen = nn.ModuleList([_convolution(last, middle, 1), _convolution(middle, first, 1)])
        self.up = nn.ModuleList([_Block(middle), _Block(first)])
        # With a gate, weights of the filtered views and of none of them.
        weights = c.filtered_views + 1 if c.gate else 0
        self.leave = _convolution(first, (1 + weights) * _BLOCK**3)
        # Small at the start: volumes are smooth, their blocks' channels nearly equal.
        with torch.no_grad():
            self.leave.weight.mul_(0.2)
        if c.bilateral and not c.gate:
            self.share = nn.Parameter(torch.tensor(0.5))
        # The layout that processors convolve fastest in (the overload is missing in torch's types).
        self.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]

    def forward(
        self,
        estimate: Tensor,
        towards: Tensor,
        condition: Tensor,
        smoothed: Tensor | None = None,
        mirrored: bool = True,
    ) -> Tensor:
        """The new estimate, ``(batch, z, y, x)``.

        Args:
            estimate, towards: ``(batch, z, y, x)`` in noise units.
            condition: ``(batch, 3)``: ln(noise scale / 200 HU), fidelity − ½, number of the step.
            smoothed: :func:`edge_preserved` of ``towards``, for a network with ``bilateral``.
            mirrored: average over the mirror images too, if over turns.
        """
        views = [estimate, towards]
        if self.config.bilateral:
            if smoothed is None:
                raise ValueError(
                    "a network with a bilateral filter needs the smoothed view of the data"
                )
            views.append(smoothed)
            if self.config.extremes:
                views += extremes_nearby(smoothed, 1)
        if not self.config.local_mm:
            return self._symmetric(views, condition, mirrored)
        level = local_mean(estimate, self.config.local_mm / self.config.voxel_mm)
        return level + self._symmetric([v - level for v in views], condition, mirrored)

    def _symmetric(self, views: list[Tensor], condition: Tensor, mirrored: bool) -> Tensor:
        # Scenes of the training are turned at random: it does not need all eight of each.
        if self.training or not self.config.turns:
            return self._convolved(views, condition)
        out = torch.zeros_like(views[0])
        turns = _TURNS if mirrored else _TURNS[:4]
        # Some volumes at a time: one alone convolves at a quarter of the speed.
        for group in (turns[::2], turns[1::2]):
            turned = [torch.cat([there(v) for there, _ in group]) for v in views]
            found = self._convolved(turned, condition.repeat(len(group), 1)).chunk(len(group))
            out += sum(back(v) for (_, back), v in zip(group, found, strict=True))
        return out / len(turns)

    def _convolved(self, views: list[Tensor], condition: Tensor) -> Tensor:
        shape = views[0].shape[-3:]
        period = _BLOCK * 2 ** (_DEPTH - 1)
        extra = [(-n) % period for n in shape]
        pad = (0, extra[2], 0, extra[1], 0, extra[0])
        x = torch.cat([to_blocks(F.pad(v, pad)) for v in views], 1)
        with torch.autocast(
            x.device.type, torch.bfloat16, enabled=self.training and self.half_precision
        ):
            fine = self.down[0](F.leaky_relu(self.enter(x), _SLOPE), condition)
            middle = self.down[1](self.narrow[0](F.avg_pool3d(fine, 2)), condition)
            coarse = self.down[2](self.narrow[1](F.avg_pool3d(middle, 2)), condition)
            middle = self.up[0](middle + _doubled(self.widen[0](coarse)), condition)
            fine = self.up[1](fine + _doubled(self.widen[1](middle)), condition)
            out = self.leave(fine)
        volumes = [
            from_blocks(part)[..., : shape[0], : shape[1], : shape[2]]
            for part in out.to(x.dtype).split(_BLOCK**3, dim=1)
        ]
        made = volumes[0]
        if self.config.bilateral:
            # The last weight is that of none of the views.
            shares = _shares(volumes[1:])[:-1] if self.config.gate else [self.share]
            for share, view in zip(shares, views[2:], strict=True):
                made = made + share * view
        return made


def _shares(weights: list[Tensor]) -> list[Tensor]:
    """|w| of each over the sum of all, equal where all are 0: they do not change with the unit."""
    sizes = [w.abs() + _LEAST for w in weights]
    total = sum(sizes)
    return [size / total for size in sizes]


def edge_preserved(towards: Tensor, guide_noise: Tensor) -> Tensor:
    """Two passes of the joint bilateral filter over a step towards the data, ``(batch, z, y, x)``.

    Args:
        towards: ``(batch, z, y, x)`` in noise units.
        guide_noise: ``(batch,)`` standard deviation of ``towards`` smoothed by
            :data:`GUIDE_VOXELS`.
    """
    once = joint_bilateral(
        towards, local_mean(towards, GUIDE_VOXELS), _FIRST[0] * guide_noise, *_FIRST[1:]
    )
    return joint_bilateral(once, once, _SECOND[0] * guide_noise, *_SECOND[1:])


def bilateral_prior(
    estimate: Tensor, towards: Tensor, condition: Tensor, smoothed: Tensor | None
) -> Tensor:
    """Called as a :class:`Network` with ``bilateral``, and nothing learned:
    :func:`edge_preserved` alone."""
    if smoothed is None:
        raise ValueError(
            "these weights are of a network without the bilateral filter: take those that ship"
        )
    return smoothed


def local_mean(v: Tensor, sigma: float) -> Tensor:
    """Gaussian mean about each voxel of ``v`` ``(..., z, y, x)``, ``sigma`` in voxels; only voxels
    of the volume count.

    A product with a small dense matrix along each axis, whose rows add up to 1: faster than a
    convolution with so wide a kernel on volumes of some 50 voxels, and a constant stays what it is
    up to the border.
    """
    for axis in (-3, -2, -1):
        at = torch.arange(v.shape[axis], dtype=v.dtype, device=v.device)
        weights = torch.exp(-0.5 * ((at[:, None] - at) / sigma).square())
        weights = weights / weights.sum(1, keepdim=True)
        # A linear map with its transpose: autocast would have products, of gradients too, in 8
        # bits.
        v = apply_linear(
            v,
            partial(_along, matrix=weights, axis=axis),
            partial(_along, matrix=weights.T, axis=axis),
        )
    return v


def _along(v: Tensor, matrix: Tensor, axis: int) -> Tensor:
    """A matrix times ``v`` along one axis, counted from the end."""
    return torch.movedim(torch.movedim(v, axis, -1) @ matrix.T, -1, axis)


def largest_nearby(v: Tensor, reach: int) -> Tensor:
    """The largest value within ``reach`` voxels along each axis of ``v`` ``(..., z, y, x)``; only
    voxels of the volume count.

    Maxima over 2, 4 and 8 neighbours, each of two of those before: on a CPU 30 times as fast as
    ``max_pool3d``.
    """
    wanted = 2 * reach + 1
    for axis in (-3, -2, -1):
        beyond = [0, 0] * (-1 - axis) + [reach, reach]
        v, width = F.pad(v, beyond, value=-math.inf), 1
        while width < wanted:
            step = min(width, wanted - width)
            left = v.shape[axis] - step
            v = torch.maximum(v.narrow(axis, 0, left), v.narrow(axis, step, left))
            width += step
    return v


def extremes_nearby(v: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """The largest and the smallest value nearby, as :func:`largest_nearby`."""
    return largest_nearby(v, reach), -largest_nearby(-v, reach)


def _turn(
    quarters: int, mirrored: bool
) -> tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]]:
    def there(v: Tensor) -> Tensor:
        return torch.rot90(v.flip(-1) if mirrored else v, quarters, (-2, -1))

    def back(v: Tensor) -> Tensor:
        v = torch.rot90(v, -quarters, (-2, -1))
        return v.flip(-1) if mirrored else v

    return there, back


_TURNS = [_turn(quarters, mirrored) for mirrored in (False, True) for quarters in range(4)]
"""The symmetries of a square about z, each with its inverse; those that exchange x and y are
every second one."""


class _Block(nn.Module):
    """Two convolutions about which the input passes by; gains between them tell the noise level."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _convolution(channels, channels)
        self.second = _convolution(channels, channels)
        self.gain = nn.Linear(CONDITIONS, channels)
        nn.init.zeros_(self.gain.weight)
        nn.init.zeros_(self.gain.bias)
        # Close to the identity at the start.
        with torch.no_grad():
            self.second.weight.mul_(0.3)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        gain = torch.exp(self.gain(condition).float()).to(x.dtype)
        h = F.leaky_relu(self.first(x) * gain[..., None, None, None], _SLOPE)
        return F.leaky_relu(x + self.second(h), _SLOPE)


def _convolution(inputs: int, outputs: int, size: int = 3) -> nn.Conv3d:
    layer = nn.Conv3d(inputs, outputs, size, padding=size // 2, bias=False)
    nn.init.kaiming_normal_(layer.weight, a=_SLOPE)
    return layer


def _doubled(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2, mode="nearest")


def to_blocks(u: Tensor) -> Tensor:
    """``(batch, z, y, x)`` to ``(batch, 8, z/2, y/2, x/2)``."""
    b, z, y, x = u.shape
    return (
        u.reshape(b, z // 2, 2, y // 2, 2, x // 2, 2)
        .permute(0, 2, 4, 6, 1, 3, 5)
        .reshape(b, 8, z // 2, y // 2, x // 2)
    ).contiguous(memory_format=torch.channels_last_3d)


def from_blocks(blocks: Tensor) -> Tensor:
    """Inverse (and adjoint) of :func:`to_blocks`."""
    b, _, z, y, x = blocks.shape
    return (
        blocks.reshape(b, 2, 2, 2, z, y, x)
        .permute(0, 4, 1, 5, 2, 6, 3)
        .reshape(b, 2 * z, 2 * y, 2 * x)
    )
