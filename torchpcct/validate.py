"""Checks of what a caller hands in: each returns the clean value, or raises an error that names
value and remedy."""

from __future__ import annotations

import functools
import inspect
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, TypedDict, TypeVar, Unpack, cast

import numpy as np

from torchpcct.switches import unswitched

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from torchpcct.typing import Floats


UNITS = ("HU", "mm^-1", "pixel^-1")
"""Of scans and volumes; of ``pixel^-1`` all lengths are in pixels."""


FORMER_NAMES = {
    "decompose_surround": "decompose_exterior",
    "surround": "exterior",
    "surround_line_integrals": "exterior_line_integrals",
    "surround_weights": "exterior_weights",
    "told": "noise_factor",
}
"""Public names that have changed → what they are called now."""


def now_called(names: Iterable[str]) -> str:
    """``: surround is now called exterior`` for the first of the names that has changed
    (:data:`FORMER_NAMES`), to be put behind an error; nothing if none has."""
    return next((f": {n} is now called {FORMER_NAMES[n]}" for n in names if n in FORMER_NAMES), "")


class Limits(TypedDict, total=False):
    """What :func:`number` holds a value to."""

    positive: bool
    finite: bool
    low: float | None
    high: float | None
    unit: str


def number(
    name: str,
    value: object,
    *,
    positive: bool = False,
    finite: bool = True,
    low: float | None = None,
    high: float | None = None,
    unit: str = "",
) -> float:
    """``value`` as a float.

    Args:
        name: what the message calls it.
        value: anything that ``float`` takes, texts of numbers too (YAML reads ``2e-3`` as one);
            not True and False, which it would take for 1 and 0.
        positive: refuse 0 and less.
        finite: refuse infinities; NaN is always refused.
        low, high: closed range.
        unit: for the message.

    Raises:
        TypeError: no number.
        ValueError: NaN, infinite, out of range.
    """
    unit = f" {unit}" if unit else ""
    if isinstance(value, complex):
        raise TypeError(f"{name} must be a real number{unit and ' in' + unit}, got {value!r}")
    try:
        if _is_truth(value):
            raise TypeError
        result = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise TypeError(
            f"{name} must be a number{unit and ' in' + unit}, got {value!r} "
            f"({type(value).__name__})"
        ) from None
    if math.isnan(result) or (finite and math.isinf(result)):
        raise ValueError(f"{name} must be {'finite' if finite else 'a number'}, got {value!r}")
    if positive and result <= 0:
        raise ValueError(f"{name} must be greater than 0{unit}, got {result:g}")
    if low is not None and high is not None and not low <= result <= high:
        raise ValueError(f"{name} must lie in [{low:g}, {high:g}]{unit}, got {result:g}")
    if low is not None and result < low:
        raise ValueError(f"{name} must be at least {low:g}{unit}, got {result:g}")
    if high is not None and result > high:
        raise ValueError(f"{name} must be at most {high:g}{unit}, got {result:g}")
    return result


def coverage(name: str, value: object) -> float:
    """``value`` as the coverage of an interval: a number between 0 and 1, ends excluded.

    Raises:
        TypeError: no number.
        ValueError: outside; the message reminds those who give per cent.
    """
    share = number(name, value)
    if not 0.0 < share < 1.0:
        raise ValueError(f"{name} must lie in (0, 1), got {share:g}: 95 % is 0.95")
    return share


def numbers(
    name: str, value: object, count: int | None = None, **limits: Unpack[Limits]
) -> tuple[float, ...]:
    """``value`` as a tuple of floats, each checked by :func:`number`.

    Args:
        name: what the message calls it.
        value: a sequence or a 1-D array.
        count: how many there must be; None: any number, but not none.
        limits: of :func:`number`.

    Raises:
        TypeError: an entry that is no number.
        ValueError: no sequence, another count, an entry out of range.
    """
    wanted = "one number or more" if count is None else f"{count} numbers"
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str | bytes):
        raise ValueError(f"{name} must be {wanted}, got {value!r}")
    if len(value) != count if count is not None else len(value) == 0:
        raise ValueError(f"{name} must be {wanted}, got {value!r}")
    return tuple(number(f"{name}[{i}]", v, **limits) for i, v in enumerate(value))


def per_axis(name: str, value: object, axes: int, **limits: Unpack[Limits]) -> tuple[float, ...]:
    """One number for every axis: a single one is repeated, ``axes`` of them are taken as they are.

    Raises:
        TypeError, ValueError: see :func:`number`; another count.
    """
    if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str):
        if len(value) != axes:
            raise ValueError(
                f"{name} must be one number or {axes} numbers (one per axis), got {value!r}"
            )
        return numbers(name, value, axes, **limits)
    return (number(name, value, **limits),) * axes


def whole(name: str, value: object, low: int = 1, high: int | None = None) -> int:
    """``value`` as an int of at least ``low`` and, if given, at most ``high``; ``True`` and ``3.0``
    are refused.

    Raises:
        TypeError: no whole number.
        ValueError: less than ``low``, more than ``high``.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name} must be a whole number, got {value!r} ({type(value).__name__})")
    if value < low:
        raise ValueError(f"{name} must be at least {low}, got {value}")
    if high is not None and value > high:
        raise ValueError(f"{name} must be at most {high}, got {value}")
    return int(value)


_UNITS = {
    "": 1,
    "B": 1,
    **{f"{p}{b}": k**n for n, p in enumerate("KMGT", 1) for b, k in (("B", 1000), ("IB", 1024))},
}
"""Units of memory → bytes: of 1000 (KB, MB, GB, TB) and of 1024 (KiB, MiB, GiB, TiB)."""


def memory_bytes(value: int | str) -> int:
    """A limit of memory in bytes: a whole number, or a text such as ``4GB`` (10⁹) or ``4 GiB``
    (2³⁰).

    Raises:
        ValueError: no such text, or 0. TypeError: neither text nor whole number.
    """
    if not isinstance(value, str):
        return whole("memory", value)
    text = value.strip().upper()
    digits = text.rstrip("KMGTIB ")
    try:
        found = int(float(digits) * _UNITS[text[len(digits) :].strip()])
    except (ValueError, KeyError, OverflowError):
        found = 0
    if found < 1:
        raise ValueError(f"memory must be bytes or a text like 4GB or 500MiB, got {value!r}")
    return found


def choice(name: str, value: object, options: Collection[str]) -> str:
    """``value``, if it is one of the options.

    Raises:
        ValueError: it is not; the message lists them.
    """
    if not isinstance(value, str) or value not in options:
        raise ValueError(
            f"unknown {name} {value!r}: use one of {', '.join(options)}{meant(value, options)}"
        )
    return str(value)


def meant(given: object, options: Iterable[str]) -> str:
    """`` (did you mean 'pwls'?)`` where an option is like the text that was given, else nothing."""
    import difflib  # of refusals only

    near = difflib.get_close_matches(str(given), options, 1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def reals(name: str, value: object) -> Floats:
    """``value`` as an array of real numbers, float64, of any shape.

    Raises:
        TypeError: anything that holds no real numbers.
    """
    if not _is_real(value):
        raise TypeError(f"{name} must hold real numbers, got {_short(value)}")
    return np.asarray(value.detach() if hasattr(value, "detach") else value, dtype=np.float64)


def broadcast(**arrays: Floats) -> list[Floats]:
    """Arrays by their names, broadcast to one shape.

    Raises:
        ValueError: shapes that do not fit; the message has them all.
    """
    try:
        return list(np.broadcast_arrays(*arrays.values()))
    except ValueError:
        listed = ", ".join(f"{name} {np.shape(value)}" for name, value in arrays.items())
        raise ValueError(f"shapes must be equal or broadcast to one, got {listed}") from None


def shaped(name: str, value: ArrayLike, wanted: tuple[int | None, ...]) -> None:
    """Refuse an array or tensor of another shape, before a compiled kernel that checks no index
    reads it.

    Args:
        name: what the message calls it.
        value: anything with a ``shape``.
        wanted: the shape; None: any length.

    Raises:
        ValueError: another number of axes, another length.
    """
    found = tuple(np.shape(value) if not hasattr(value, "shape") else value.shape)
    if len(found) != len(wanted) or any(
        w not in (None, n) for n, w in zip(found, wanted, strict=True)
    ):
        text = ", ".join("any" if n is None else str(n) for n in wanted)
        raise ValueError(
            f"{name} must have the shape ({text}{',' * (len(wanted) == 1)}), got {found}"
        )


F = TypeVar("F", bound=Callable[..., object])

_KINDS: dict[str, tuple[str, Callable[[object], bool]]] = {
    "int": ("a whole number", lambda v: isinstance(v, int | np.integer) and not _is_truth(v)),
    "float": (
        "a number",
        lambda v: (
            not _is_truth(v)
            and (
                isinstance(v, int | np.integer | float | np.floating)
                or (getattr(v, "shape", None) == () and _is_real(v))
            )
        ),
    ),
    "str": ("a text", lambda v: isinstance(v, str)),
    "bool": ("True or False", lambda v: _is_truth(v)),
    "None": ("None", lambda v: v is None),
    "Any": ("anything", lambda v: True),
    "object": ("anything", lambda v: True),
    "ArrayLike": ("real numbers", lambda v: _is_real(v)),
    "Floats": ("real numbers", lambda v: _is_real(v)),
    "Callable": ("a function", callable),
    "Mapping": ("a mapping", lambda v: isinstance(v, Mapping)),
    "Sequence": (
        "a sequence",
        lambda v: isinstance(v, Iterable) and not isinstance(v, str | bytes | Mapping),
    ),
}
"""Name of an annotation, in words, and whether a value is one."""
_SAID = {
    "Tensor": "a torch.Tensor",
    "Geometry": "a ParallelBeam, FanBeam or ConeBeam (or a VectorGeometry)",
    "tuple": "a sequence",
}
"""Annotations that their own names do not describe, in words."""


def checked(function: F) -> F:
    """A function that refuses arguments which its annotations exclude, by name, before it does
    anything.

    Checked are ``int``, ``float``, ``str``, ``bool``, ``Tensor``, ``ArrayLike`` (real numbers of
    any shape), ``Callable``, ``Sequence``, ``Mapping``, ``tuple[float, ...]`` (of a fixed length,
    too), classes, and what ``|`` joins; every other annotation lets everything pass. Values are
    handed on as they are: shapes and ranges are the function's own business. It runs
    :func:`torchpcct.switches.unswitched`: what a program has switched in torch and numpy does not
    change its result.

    Raises:
        TypeError: of the function that is made, for such an argument.
    """
    signature = inspect.signature(function)
    own = {
        name: p
        for name, p in signature.parameters.items()
        if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    }
    annotations = {name: str(p.annotation) for name, p in own.items()}
    defaults = {name: p.default for name, p in own.items()}
    in_order = [name for name, p in own.items() if p.kind is not p.KEYWORD_ONLY]
    needed = {name for name, p in own.items() if p.default is p.empty}
    by_name = {name for name, p in own.items() if p.kind is not p.POSITIONAL_ONLY}

    def arguments(args: tuple[object, ...], kwargs: dict[str, object]) -> Mapping[str, object]:
        """Values by their parameters' names, as ``inspect`` binds them; a call that is written
        plainly, as nearly all are, without its help, which takes longer than short functions do."""
        if len(args) <= len(in_order) and by_name.issuperset(kwargs):
            given = dict(zip(in_order, args, strict=False))
            if given.keys().isdisjoint(kwargs):
                given |= kwargs
                if given.keys() >= needed:
                    return given
        return signature.bind(*args, **kwargs).arguments

    @functools.wraps(function)
    def call(*args: object, **kwargs: object) -> object:
        try:
            given = arguments(args, kwargs)
        except TypeError as error:
            if former := now_called(kwargs):
                raise TypeError(f"{function.__qualname__}(): {error}{former}") from None
            return function(*args, **kwargs)  # Python's own words name the function, too
        for name, value in given.items():
            if name not in annotations or value is defaults[name]:
                continue
            kinds = _alternatives(annotations[name])
            if not any(_is(value, kind, function.__globals__) for kind in kinds):
                remedy = (
                    ": torch.from_numpy makes one"
                    if "Tensor" in kinds and isinstance(value, np.ndarray)
                    else ""
                )
                wanted = " or ".join(dict.fromkeys(_in_words(kind) for kind in kinds))
                raise TypeError(f"{name} must be {wanted}, got {_short(value)}{remedy}")
        with unswitched():
            return function(*args, **kwargs)

    return cast(F, call)


def _short(value: object) -> str:
    """A value for a message: its kind and, where that is short, itself."""
    kind = type(value).__name__
    return kind if hasattr(value, "shape") or len(repr(value)) > 60 else f"{value!r} ({kind})"


@functools.cache
def _alternatives(annotation: str) -> tuple[str, ...]:
    """The parts that ``|`` joins outside of brackets."""
    return tuple(part.strip() for part in re.split(r"\|(?![^\[]*\])", annotation))


def _in_words(kind: str) -> str:
    head, _, inner = kind.partition("[")
    if head == "tuple" and "..." not in inner:
        return f"{inner.count(',') + 1} numbers"
    if head in _KINDS:
        return _KINDS[head][0]
    return _SAID.get(head, f"a {head.rpartition('.')[2]}")


def _is(value: object, kind: str, names: Mapping[str, object]) -> bool:
    head, _, inner = kind.partition("[")
    if head in _KINDS:
        return _KINDS[head][1](value)
    if head == "tuple":
        if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str | bytes):
            return False
        if "[" in inner:
            return True
        parts = inner.rstrip("]").split(", ")
        if "..." not in parts and len(parts) != len(value):
            return False
        return set(parts) - {"..."} not in ({"float"}, {"int"}) or all(
            _is(v, parts[0], names) for v in value
        )
    known = names.get(head)
    if isinstance(known, type):
        return isinstance(value, known)
    # A class that only the type checker imports is known by its name.
    by_name = known is None and head.isidentifier() and head[:1].isupper()
    return not by_name or any(base.__name__ == head for base in type(value).__mro__)


def _is_truth(value: object) -> bool:
    return isinstance(value, bool | np.bool_)


def _is_real(value: object) -> bool:
    if value is None or isinstance(value, str | bytes | Mapping):
        return False
    try:
        return (
            np.asarray(value.detach() if hasattr(value, "detach") else value).dtype.kind in "fiub"
        )
    except (TypeError, ValueError, RuntimeError):
        return False
