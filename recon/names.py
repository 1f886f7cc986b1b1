"""Names of methods, kernels, filters and priors, which can be checked before anything that
computes is loaded."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Mapping
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from torchpcct.validate import choice, meant, number

__all__ = ["FILTERS", "KERNELS", "METHODS"]

METHODS: tuple[str, ...] = ("fbp", "pwls", "mbir")
"""Of :func:`recon.reconstruct`."""

KERNELS: tuple[str, ...] = ("soft", "standard", "detail", "bone", "ram-lak")
"""Reconstruction kernels of filtered backprojection, from smooth to sharp
(:mod:`recon.analytic.ramp`)."""

FILTERS: tuple[str, ...] = ("gaussian", "perona_malik", "bilateral", "nlm", "tv", "bm4d")
"""Of :mod:`recon.filters`; a hyphen is as good as the underscore."""

CONTRASTS: Mapping[str, tuple[str, str]] = {"iodine": ("blood_iodine", "fibrous_tissue")}
"""Contrasts that an evaluation's option ``energies=`` knows by a name: two materials."""

_ENERGIES = re.compile(r"(?P<before>[:,])energies(?:=(?P<contrast>[^,@]*))?(?=,|$)")
"""The option among those of a method, wherever it stands."""

_MBIR = ("weights", "network", "fidelity", "vessel", "tissues", "prior")
"""Options of MBIR in a method's name."""


def packaged_names(folder: Traversable) -> tuple[str, ...]:
    """Names of the YAML files in a folder of the package, without their ending."""
    return tuple(
        sorted(f.name.removesuffix(".yaml") for f in folder.iterdir() if f.name.endswith(".yaml"))
    )


def filter_name(text: str) -> str:
    """A filter's name with the underscore that it has in :data:`FILTERS`."""
    return text.replace("-", "_")


def split_energies(spec: str) -> tuple[str, str | None]:
    """A method of an evaluation without its option ``energies``, and what that says: ``fbp:soft``
    and ``iodine`` from ``fbp:soft,energies=iodine``; empty without a value, None without the
    option."""
    found = _ENERGIES.search(spec)
    if found is None:
        return spec, None
    before, after = spec[: found.start()], spec[found.end() :]
    if found["before"] == ":" and after:
        before, after = f"{before}:", after.removeprefix(",")
    return before + after, (found["contrast"] or "").strip()


def split_method(spec: Any) -> tuple[str, dict[str, Any]]:
    """A method of :func:`recon.reconstruct` and its options, from ``fbp:soft`` or
    ``mbir:prior=perona-malik``.

    Of ``weights`` and ``network`` the texts are given; ``prior`` is a text, too.

    Raises:
        ValueError, TypeError: an unknown method or option, or a value that it does not take.
        FileNotFoundError: weights that do not exist.
    """
    if isinstance(spec, str) and split_energies(spec)[1] is not None:
        raise ValueError(
            f"energies= is an option of evaluations, got {spec!r}: sum the bins with weights "
            "before, scan.weighted(torchpcct.spectral.bin_weights(scanner, (a, b), {material: mm}))"
        )
    name, _, rest = spec.partition(":") if isinstance(spec, str) else (spec, "", "")
    choice("method", name, METHODS)
    if not rest:
        return name, {}
    if name == "fbp":
        return name, {"kernel": choice("kernel", rest, KERNELS)}
    if name == "pwls":
        raise ValueError(f"pwls has no options, got {spec!r}")
    texts = mbir_options(rest)
    options: dict[str, object] = {
        k: texts[k] for k in ("weights", "network", "prior") if k in texts
    }
    if "fidelity" in texts:
        options["fidelity"] = float(texts["fidelity"])
    options |= {k: True for k in ("vessel", "tissues") if k in texts}
    return name, options


def mbir_options(text: str) -> dict[str, str]:
    """Options of ``mbir:fidelity=1,vessel`` by name.

    Raises:
        ValueError, TypeError: an unknown option, or a value that it does not take.
        FileNotFoundError: weights that do not exist.
    """
    given: dict[str, str] = {}
    for part in filter(None, text.split(",")):
        key, _, value = part.partition("=")
        given[choice("option of mbir", key, _MBIR)] = value
    if "fidelity" in given:
        number("fidelity", given["fidelity"], low=0.0, high=1.0)
    if "prior" in given:
        check_prior(given["prior"])
    for name in ("vessel", "tissues"):
        if given.get(name):
            raise ValueError(f"{name} of mbir takes no value, got {given[name]!r}: mbir:{name}")
    if "weights" in given and not Path(given["weights"]).is_file():
        raise FileNotFoundError(f"no such file: {given['weights'] or 'weights= without a name'}")
    if "network" in given:
        if "weights" not in given:
            raise ValueError(
                "network of mbir is the class of a network of your own: give weights=FILE, too"
            )
        if not is_module_name(given["network"]):
            raise ValueError(
                f"network of mbir must be package.module:Class, got {given['network']!r}"
            )
    return given


def check_prior(text: str) -> None:
    """Refuse what names no prior of MBIR, as far as its text tells: a filter, or
    ``package.module:function``.

    Raises:
        ValueError: neither; the message lists the filters.
    """
    if is_module_name(text):
        return
    if filter_name(text) not in FILTERS:
        raise ValueError(
            f"unknown prior of mbir {text!r}: use one of {', '.join(FILTERS)}, or "
            "package.module:function"
            f"{meant(filter_name(text), FILTERS)}"
        )


def is_module_name(text: str) -> bool:
    """Whether a text has the form ``package.module:name``."""
    module, _, name = text.partition(":")
    return bool(module and name) and all(
        part.isidentifier() for part in [*module.split("."), *name.split(".")]
    )


def loaded(spec: str) -> Callable[..., object]:
    """The function or class that ``package.module:name`` names; its module is imported.

    Raises:
        ValueError: it cannot be imported, or the module has no such name.
        TypeError: it cannot be called.
    """
    module, _, name = spec.partition(":")
    try:
        found: object = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except Exception as error:  # whatever a foreign module does when it is imported
        reason = (
            str(error)
            if isinstance(error, ImportError | AttributeError)
            else f"{type(error).__name__}: {error}"
        )
        raise ValueError(
            f"cannot load {spec!r}: {reason} (is its folder on PYTHONPATH?){meant_method(module)}"
        ) from error
    if not callable(found):
        raise TypeError(f"{spec} is not a function: it is a {type(found).__name__}")
    function: Callable[..., object] = found
    return function


def meant_method(head: str) -> str:
    """`` (did you mean 'mbir'?)`` where the first part of a name is like that of a method of the
    package."""
    return meant(head, ("fbp", "pwls", "mbir", "files", *FILTERS))
