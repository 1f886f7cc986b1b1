"""Methods under test: ours by name, anybody's as a Python function, trained weights, or volumes in
files.

A method's name says all:

* ``fbp:KERNEL``, ``pwls``, ``mbir``; ``mbir:fidelity=1``, ``mbir:weights=mine.safetensors``,
  ``mbir:vessel`` around the drawn outlines of a vessel, ``mbir:tissues`` around its tissues;
  options are separated by commas;
* ``mbir:prior=PRIOR``: the same data steps with another prior in the network's place
  (:mod:`recon.mbir.priors`): ``bilateral``, the filter that the network is given, a filter of
  :mod:`recon.filters` such as ``perona-malik``, or ``package.module:function``, a denoiser as below
  or a network of a user's own;
* ``mbir:weights=FILE,network=package.module:Class``: weights of a network of a user's own;
* any of them with ``energies=CONTRAST`` among its options (``fbp:soft,energies=iodine``): of the
  energy bins of a photon-counting scanner, summed with the weights that show the contrast best
  (:mod:`recon.evaluate.energies`);
* ``FILTER@BASE``: a filter of :mod:`recon.filters` after a linear method, ``bilateral@fbp:detail``;
* ``package.module:function``: a function of ``(scan, grid)`` that gives a volume in HU; with
  ``@BASE`` a denoiser, a function of ``(volume)`` or ``(volume, sigma)`` in HU, tensors ``(z, y,
  x)`` float32;
* ``files:FOLDER``: volumes that another program has made of scans that
  :func:`recon.evaluate.export_scans` wrote, files or DICOM folders in ``FOLDER/TASK`` with the
  scans' names, as ``torchpcct reconstruct`` gives them, too.

Whatever it is, it becomes a :class:`Method`, a function of one realisation of a scan
(:class:`Realisation`).
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np
import torch
from torch import Tensor, nn

from recon.evaluate.names import check_method
from recon.evaluate.rivals import tuned
from recon.filters import FILTERS, SMOOTHED_BY, denoiser_of, flat_noise
from recon.mbir.mbir import Mbir
from recon.mbir.network import bilateral_prior
from recon.mbir.priors import PlugAndPlay, prior_of
from recon.mbir.weights_io import digest
from recon.names import filter_name, is_module_name, loaded, mbir_options, split_energies
from recon.vessel.known import known_vessel
from torchpcct.geometry import VolumeGrid
from torchpcct.scan import Scan
from torchpcct.volume import Volume

__all__ = ["Method", "Realisation", "denoiser", "method_of"]


class Realisation(Protocol):
    """One realisation, as a method sees it: simulated (:mod:`recon.evaluate.realisations`) or
    measured."""

    @property
    def scan(self) -> Scan:
        """The scan."""
        ...

    @property
    def exposure_s(self) -> float:
        """Of the scan."""
        ...

    @property
    def grid(self) -> VolumeGrid:
        """Of the volume that is asked for."""
        ...

    @property
    def label(self) -> str:
        """Name of its files."""
        ...

    def fbp(self, kernel: str) -> Tensor:
        """FBP, HU ``(z, y, x)``."""
        ...

    def pwls(self) -> Tensor:
        """PWLS with the default prior, HU ``(z, y, x)``, ``grid.shape``."""
        ...

    def mbir(self, network: Mbir) -> Tensor:
        """MBIR with this network, HU ``(z, y, x)``, ``grid.shape``."""
        ...

    def sigma(self, method: Method, smooths: float = 0.0) -> float:
        """Noise of a linear method in homogeneous tissue.

        Args:
            method: FBP of one of the kernels that were declared.
            smooths: standard deviation, in voxels, of a Gaussian that smooths the noise before; 0:
                none.

        Returns:
            Standard deviation of a voxel, HU.
        """
        ...


@dataclass(frozen=True, eq=False)
class Method:
    """A reconstruction under test.

    Args:
        name: for tables.
        run: from a :class:`Realisation` to HU ``(z, y, x)``.
        key: what its results depend on beside its name (weights, source), so that kept ones are not
            mixed up.
        kernels: of FBP that it asks a realisation for.
        is_fbp: its volume is FBP with the first of them: means and variances of its ROIs are exact.
        network: it is this MBIR, whose own response to noise controls what is drawn.
        energies: the contrast for which it is given weighted energy bins
            (:mod:`recon.evaluate.energies`); None: the plain sum of the counts.
        made: a function of a module and its arguments that make the same method in another process;
            None: it is sent as it is, which a ``run`` that is no function of a module does not
            allow.
    """

    name: str
    run: Callable[[Realisation], Tensor]
    key: str = ""
    kernels: tuple[str, ...] = ()
    is_fbp: bool = False
    network: Mbir | None = None
    energies: str | None = None
    made: tuple[Callable[..., Method], tuple[object, ...]] | None = None

    def __reduce__(self) -> tuple[object, ...]:
        return self.made or (Method, tuple(getattr(self, f.name) for f in fields(self)))


MethodLike: TypeAlias = str | Method | Callable[[Scan, VolumeGrid], Tensor | Volume]
"""What a method is given by: its name (``"fbp:soft"``), itself, or a function of a scan and a grid
that gives a volume in HU."""


def listed(what: Any) -> Sequence[Any]:
    """One of something as a list of one, several as they are."""
    return list(what) if isinstance(what, list | tuple | np.ndarray) else [what]


def method_of(spec: MethodLike) -> Method:
    """A method from its name, see the module; a :class:`Method` or a function of ``(scan, grid)``
    as it is.

    Raises:
        ValueError, TypeError: an unknown name or option, with those that there are.
        ImportError, AttributeError: a module or function that cannot be loaded.
        FileNotFoundError: weights or a folder that do not exist.
    """
    if isinstance(spec, Method):
        return spec
    if callable(spec):
        return _of_function(getattr(spec, "__name__", "function"), spec)
    if isinstance(spec, str):
        plain, energies = split_energies(spec)
        if energies is not None:
            check_method(spec)
            found = _named(plain)
            return replace(found, name=spec, energies=energies, made=(method_of, (spec,)))
        return replace(_named(spec), made=(method_of, (spec,)))
    raise TypeError(
        f"a method must be a name or a function of (scan, grid), got {type(spec).__name__}"
    )


def names_module(spec: str) -> bool:
    """Whether a method's name is that of a function of a module, which is imported."""
    head, _, base = split_energies(spec)[0].partition("@")
    if base:
        return filter_name(head) not in FILTERS
    name, _, rest = head.partition(":")
    if name == "mbir":
        given = [part.partition("=") for part in rest.split(",")]
        return any(key in ("prior", "network") and is_module_name(value) for key, _, value in given)
    return bool(rest) and name not in ("fbp", "files")


def _named(spec: str) -> Method:
    check_method(spec)
    head, _, base = spec.partition("@")
    if base:
        return (
            _filtered(head, base, spec)
            if filter_name(head) in FILTERS
            else denoiser(loaded(head), base, spec)
        )
    name, _, rest = spec.partition(":")
    if name == "fbp":
        kernel = rest or "standard"
        return Method(
            f"fbp:{kernel}",
            lambda realisation: realisation.fbp(kernel),
            kernels=(kernel,),
            is_fbp=True,
        )
    if name == "pwls":
        return Method("pwls", lambda realisation: realisation.pwls())
    if name == "mbir":
        return _mbir(spec, rest)
    if name == "files":
        return _of_files(spec, Path(rest))
    return _of_function(spec, loaded(spec))


def denoiser(function: Callable[..., object], base: MethodLike, name: str = "") -> Method:
    """A function of an image after a linear method.

    Args:
        function: of ``(volume)`` or ``(volume, sigma)``: HU ``(z, y, x)`` float32, and the standard
            deviation of the base's noise in the largest tissue, HU; it gives the same shape. Or a
            denoiser of deepinv (:func:`recon.filters.denoiser_of`).
        base: a linear method.
        name: for tables.

    Raises:
        ValueError: a base that is not linear.
    """
    before = method_of(base)
    if not before.is_fbp:
        raise ValueError(f"a denoiser needs FBP before it, got {before.name!r}: fbp:KERNEL")
    plain = getattr(function, "__name__", "denoiser")
    denoise = denoiser_of(function)

    name = name or f"{plain}@{before.name}"

    def run(realisation: Realisation) -> Any:
        volume = before.run(realisation)
        with _naming(name):
            return denoise(volume, lambda: realisation.sigma(before))

    made = denoiser, (function, before, name)
    return Method(name, run, key=_source_of(function), kernels=before.kernels, made=made)


def _filtered(name: str, base: str, spec: str) -> Method:
    """A filter of :mod:`recon.evaluate.rivals` with the settings that were tuned for it."""
    before, name = method_of(base), filter_name(name)

    def run(realisation: Realisation) -> Tensor:
        settings = tuned(name, before.kernels[0], realisation.exposure_s)
        smooths = settings.get("sigma", SMOOTHED_BY.get(name, 0.0)) if name in SMOOTHED_BY else 0.0
        found: Tensor = FILTERS[name](
            before.run(realisation), realisation.sigma(before, smooths), **settings
        )
        return found

    return Method(spec, run, key="tuned", kernels=before.kernels)


def _mbir(spec: str, rest: str) -> Method:
    given = mbir_options(rest)
    prior = prior_of(given["prior"]) if "prior" in given else None
    if prior is not None and "weights" not in given:
        network = Mbir(prior=prior)
    else:
        network = Mbir.load(given.get("weights"), network=given.get("network"))
    key = network.weights_sha256
    if "network" in given:
        key += _source_of(network.model.network)
    if prior is not None:
        network, key = network.with_prior(prior), f"{key} {_source_of(prior)}"
    if "fidelity" in given:
        network = network.with_fidelity(float(given["fidelity"]))
    network = network.with_known(known_vessel("vessel" in given, "tissues" in given))
    # Others need not be differentiable: what is drawn of them is controlled by the reference.
    differentiable = "tissues" not in given and (prior is None or prior is bilateral_prior)
    return Method(
        spec,
        lambda realisation: realisation.mbir(network),
        key=key,
        network=network if differentiable else None,
    )


@contextmanager
def _naming(name: str) -> Iterator[None]:
    """Put the name of a user's function before what it, or a library that it calls, refuses."""
    try:
        yield
    except (TypeError, ValueError) as error:
        kind = TypeError if isinstance(error, TypeError) else ValueError
        raise kind(f"{name}: {error}") from error


def _of_function(name: str, function: Callable[..., Any]) -> Method:
    made = _of_function, (name, function)

    def run(realisation: Realisation) -> Any:
        with _naming(name):
            return function(realisation.scan, realisation.grid)

    return Method(
        name,
        run,
        key=_source_of(function),
        made=made,
    )


def _of_files(spec: str, folder: Path) -> Method:
    def run(realisation: Realisation) -> Tensor:
        task, name = realisation.label.split("/")
        wanted = (name, *(f"{name}_{method}" for method in ("fbp", "pwls", "mbir")))
        there = volume_files(folder / task) or volume_files(folder)
        found = [there[n] for n in wanted if n in there]
        if len(found) > 1:
            raise ValueError(
                f"{', '.join(map(str, found))} are volumes of one scan: leave one of them in the "
                "folder"
            )
        if not found:
            raise FileNotFoundError(
                f"{folder} has no volume {realisation.label}, with or without _fbp, _pwls or _mbir "
                "appended: reconstruct the exported scan of that name"
            )
        volume = Volume.load(found[0])
        if not same_grid(volume.grid, realisation.grid):
            raise ValueError(f"{found[0]} has the grid {volume.grid}, the task {realisation.grid}")
        if volume.unit != "HU":
            raise ValueError(f"{found[0]} is in {volume.unit}: HU are needed")
        return volume.data

    return Method(spec, run, key=f"{folder.resolve()} {_content(folder)}")


def _content(folder: Path) -> str:
    """Of the files in a folder: names, sizes and times, so that volumes that are made again are
    read again."""
    seen = [
        (str(p.relative_to(folder)), p.stat().st_size, p.stat().st_mtime_ns)
        for p in folder.rglob("*")
        if p.is_file()
    ]
    return hashlib.sha256(repr(sorted(seen)).encode()).hexdigest()[:16]


_VOLUMES = (".nii.gz", ".nii", ".mha", ".mhd", ".h5", ".hdf5", ".zarr")
"""Endings of volumes that are read."""


def volume_files(folder: Path) -> dict[str, Path]:
    """Name without ending → a volume in a folder: files of :meth:`torchpcct.Volume.save`, stores,
    folders of DICOM.

    What lies beside them (summaries, hidden files) is left out. Names may hold dots.

    Raises:
        ValueError: two volumes of one name in several formats.
    """
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        ending = next((e for e in _VOLUMES if path.name.lower().endswith(e)), "")
        if path.name.startswith(".") or not (ending or path.is_dir()):
            continue
        name = path.name[: len(path.name) - len(ending)]
        if name in found:
            raise ValueError(
                f"{found[name]} and {path.name} are volumes of one name: leave one of them in the "
                "folder"
            )
        found[name] = path
    return found


def same_grid(first: VolumeGrid, second: VolumeGrid) -> bool:
    """Whether two grids are the same within a thousandth of a voxel: files keep places and
    lengths in float32."""
    if first.shape != second.shape:
        return False
    pairs = zip(
        first.spacing, second.spacing, first.center, second.center, first.shape, strict=True
    )
    return all(abs(a - b) * n <= 1e-3 * b and abs(c - d) <= 1e-3 * b for a, b, c, d, n in pairs)


def _source_of(function: Callable[..., object]) -> str:
    """SHA-256 of a function's source, and of the networks and plain values that it uses from
    outside."""
    kind = type(function) if isinstance(function, nn.Module) else function
    try:
        text = inspect.getsource(kind)
    except (OSError, TypeError):
        text = repr(kind)
    used: dict[str, object] = {"": function}
    if isinstance(function, PlugAndPlay):
        return _source_of(function.denoiser)
    if inspect.isfunction(function):
        outside = inspect.getclosurevars(function)
        used = {**outside.globals, **outside.nonlocals}
    for name, value in sorted(used.items()):
        if isinstance(value, nn.Module):
            text += f"{name} {value!r} {digest(value.state_dict())}"
        elif isinstance(value, bool | int | float | str):
            text += f"{name} {value!r}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def noise_of(volume: Tensor, flat: Tensor, smooths: float) -> float:
    """Standard deviation in HU of noise alone in flat voxels, smoothed as a filter does that
    looks at smoothed ones."""
    mask = torch.zeros(volume.numel(), dtype=torch.bool)
    mask[flat] = True
    return flat_noise(volume, mask.reshape(volume.shape), sigma=smooths)
