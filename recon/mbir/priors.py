"""The prior is a seam: what may stand between the data steps of :mod:`recon.mbir.unrolled`, and how
it is named.

A *prior* is a module or function of four tensors that gives a new estimate ``(batch, z, y, x)``,
all in noise units (:mod:`recon.data_term`): ``prior(estimate, towards, condition, smoothed)``,
see :meth:`recon.mbir.network.Network.forward`. The package's network is one, a network of a user's
own another.

A *denoiser* of ``(volume)`` or ``(volume, sigma)`` in HU becomes a prior by :class:`PlugAndPlay`,
be it a filter of :mod:`recon.filters`, a denoiser of deepinv or a user's function (plug-and-play
priors: Venkatakrishnan, Bouman, Wohlberg 2013, GlobalSIP).

Code of a user is imported where the user names it, ``package.module:name``, and never because a
file says so.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from recon.filters import FILTERS, SMOOTHED_BY, denoiser_of, places_of
from recon.mbir.network import REFERENCE_SCALE_HU, Network, NetworkConfig, bilateral_prior
from recon.names import check_prior, filter_name, is_module_name, loaded
from torchpcct.validate import number

__all__ = ["PlugAndPlay", "Prior"]

Prior = Callable[..., Tensor]
"""A :class:`recon.mbir.network.Network`, or a module or function with the arguments of its
``forward``."""
_SMOOTHED = [(FILTERS[name], width) for name, width in SMOOTHED_BY.items()]
"""Filters whose noise is that of the smoothed volume, with the width of that."""
_ARGUMENTS = "(estimate, towards, condition, smoothed)"
"""Of a prior's ``forward``, for messages."""


class PlugAndPlay(nn.Module):
    """A denoiser as a prior: it is given the step towards the data, and what it gives is the new
    estimate.

    The denoiser sees one volume after the other, HU ``(z, y, x)`` in the precision of the data (of
    a whole field: HU above a strongly smoothed PWLS). ``sigma`` is the standard deviation of a
    voxel's noise there, HU: in noise units it follows from the spectrum of H
    (:func:`recon.mbir.unrolled.guide_noise`), times the noise scale. It is that of the first step,
    and later ones have hardly less. The noise is correlated, as that of FBP is: a denoiser of white
    noise that is given its standard deviation takes away less than it could at low frequencies.

    Args:
        denoiser: of ``(volume)`` or ``(volume, sigma)``, or one of deepinv
            (:func:`recon.filters.denoiser_of`).
        smoothed_by: ``sigma`` is that of the volume smoothed by a Gaussian of so many voxels; None:
            as a filter of :mod:`recon.filters` has it, else 0.
    """

    def __init__(self, denoiser: Callable[..., object], smoothed_by: float | None = None) -> None:
        super().__init__()
        self.denoiser = denoiser
        usual = next((width for known, width in _SMOOTHED if known is denoiser), 0.0)
        self.smoothed_by = (
            usual
            if smoothed_by is None
            else number("smoothed_by", smoothed_by, low=0.0, unit="voxels")
        )
        self._denoised = denoiser_of(denoiser)

    def with_noise(self, noise: Tensor, zero_hu: float) -> Prior:
        """The prior of scans whose noise is known.

        Args:
            noise: ``(batch,)`` standard deviation of ``towards`` smoothed by ``smoothed_by``, noise
                units.
            zero_hu: HU where ``towards`` is 0.
        """
        return partial(self.forward, noise=noise, zero_hu=zero_hu)

    def forward(
        self,
        estimate: Tensor,
        towards: Tensor,
        condition: Tensor,
        smoothed: Tensor | None = None,
        *,
        noise: Tensor,
        zero_hu: float = 0.0,
    ) -> Tensor:
        """See :meth:`with_noise` and :meth:`recon.mbir.network.Network.forward`; of the four only
        ``towards`` counts, and of ``condition`` the noise scale."""
        found = []
        for volume, level, sigma in zip(towards, condition[:, 0], noise, strict=True):
            scale = REFERENCE_SCALE_HU * level.exp()
            hu = volume * scale + zero_hu
            made = same_kind(self._denoised(hu, partial(float, sigma * scale)), hu, self)
            found.append((made - zero_hu) / scale)
        return torch.stack(found)


def prior_of(given: object) -> Prior:
    """A prior from what a user gives.

    Args:
        given: a prior; a denoiser; the name of a filter, ``perona-malik``; ``bilateral``, the
            filter that the network is given (:func:`recon.mbir.network.bilateral_prior`); or
            ``package.module:name`` of one of the first two, which is imported.

    Raises:
        ValueError: an unknown name, or one that cannot be imported.
        TypeError: a class, whose instance is meant, or what has other arguments.
    """
    if isinstance(given, str):
        check_prior(given)
        if is_module_name(given):
            return prior_of(loaded(given))
        return (
            bilateral_prior
            if filter_name(given) == "bilateral"
            else PlugAndPlay(FILTERS[filter_name(given)])
        )
    if isinstance(given, type):
        raise TypeError(
            f"a prior is a function or an instance, got the class {given.__name__}: make one, and "
            "name that"
        )
    if not callable(given):
        raise TypeError(
            f"a prior must be a function, a module or a name, got {type(given).__name__}"
        )
    function: Prior = given
    places = places_of(function)
    needed = [p.name for p in places if p.default is inspect.Parameter.empty]
    if (
        any(p.name == "towards" for p in places)
        or len(needed) == 4
        or (not places and _takes_any(function))
    ):
        return function
    if len(needed) in (1, 2):
        return PlugAndPlay(function)
    raise TypeError(
        f"a prior takes {_ARGUMENTS}, a denoiser (volume) or (volume, sigma): "
        f"{name_of(function)} takes ({', '.join(p.name for p in places)})"
    )


def _takes_any(function: Callable[..., object]) -> bool:
    call = function.forward if isinstance(function, nn.Module) else function
    try:
        return any(p.kind is p.VAR_POSITIONAL for p in inspect.signature(call).parameters.values())
    except (TypeError, ValueError):
        return False


def name_of(prior: object) -> str:
    """What messages and reports call a prior."""
    if isinstance(prior, PlugAndPlay):
        return name_of(prior.denoiser)
    if isinstance(prior, partial):
        return name_of(prior.args[0] if prior.args and callable(prior.args[0]) else prior.func)
    if inspect.ismethod(prior):
        return name_of(prior.__self__)
    return str(getattr(prior, "__name__", type(prior).__name__))


def same_kind(made: object, given: Tensor, prior: object) -> Tensor:
    """What a prior or denoiser has returned for ``given``, if it has its shape, precision and
    device.

    Raises:
        TypeError: no tensor. ValueError: a tensor of another kind.
    """
    if not isinstance(made, Tensor):
        raise TypeError(
            f"the prior {name_of(prior)} returned {type(made).__name__}: it must return a tensor "
            "like the one it is given (torch.from_numpy makes one of an array)"
        )
    if made.shape != given.shape:
        raise ValueError(
            f"the prior {name_of(prior)} returned the shape {tuple(made.shape)} for "
            f"{tuple(given.shape)}: it must return one value for each voxel"
        )
    if made.dtype != given.dtype or made.device != given.device:
        raise ValueError(
            f"the prior {name_of(prior)} returned {made.dtype} on {made.device} for {given.dtype} "
            f"on {given.device}: end it with .to(...) of what it is given"
        )
    return made


def network_of(values: Mapping[str, Any], named: object = None) -> nn.Module:
    """The network that a training's configuration or the header of its weights describes, with
    random weights.

    Args:
        values: arguments of :class:`recon.mbir.network.NetworkConfig`; or, of another network,
            ``class``, ``package.module:Class``, and the arguments of that.
        named: what the user has named as that class: its name again (which is imported; it need not
            be the one in ``values``, modules may have moved), the class, or the network itself.

    Raises:
        ValueError: another class that the user has not named, or a named one where it is the
            package's own network; a name that cannot be imported; arguments that the class does not
            take.
        TypeError: what the class makes is no module.
    """
    arguments = dict(values)
    spec = arguments.pop("class", None)
    if spec is None:
        if named is not None:
            raise ValueError(
                "the network is the package's own: leave out the class of another one, network"
            )
        return Network(NetworkConfig(**arguments))
    if named is None:
        raise ValueError(
            f"the network is of a class of its own, {spec}, which no file alone may import: if "
            "you trust it, name it, "
            f'network="{spec}" or --network {spec}'
        )
    if isinstance(named, nn.Module):
        return named
    make = loaded(named) if isinstance(named, str) else named
    if not callable(make):
        raise TypeError(
            f"network must be package.module:Class, a class or a module, got {type(named).__name__}"
        )
    try:
        made = make(**arguments)
    except TypeError as error:
        given = ", ".join(f"{k}={v!r}" for k, v in arguments.items()) or "no arguments"
        raise ValueError(f"{name_of(make)} cannot be made with {given}: {error}") from error
    if not isinstance(made, nn.Module):
        raise TypeError(f"{name_of(make)} must make a torch.nn.Module, got {type(made).__name__}")
    return made
