"""Configuration of a training run and its YAML form.

A YAML file holds the fields that differ from the defaults of :class:`TrainConfig`. Sections (``prior``, ``data``,
``objective``) are mappings. Unknown keys are errors, so that a misspelt one does not silently train the default.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

if TYPE_CHECKING:
    from train.data import DataConfig
    from train.objective import ObjectiveConfig

__all__ = ["TrainConfig", "differences", "load_config", "packaged_config"]

LONGEST_INTERVAL = 120.0
"""Largest ``checkpoint_seconds``: what a killed run may lose, in s."""


# Imported when used: the data bring compiled kernels along, which reading a file does not need.
def _data_config() -> DataConfig:
    from train.data import DataConfig

    return DataConfig()


def _objective_config() -> ObjectiveConfig:
    from train.objective import ObjectiveConfig

    return ObjectiveConfig()


@dataclass(frozen=True)
class TrainConfig:
    """A training run. Everything in it is counted in steps, so that the result does not depend on the machine's speed.

    Args:
        seed: of the weights' start, the data and the validation, ≥ 0.
        steps: optimisation steps.
        batch: scenes of a step, over all processes.
        learning_rate: of Adam, at the end of the warm-up.
        warmup: steps over which it rises linearly.
        final_fraction: of ``learning_rate`` that the cosine ends with, 0 to 1.
        clip: largest norm of the gradient of the mean loss; longer ones are shortened to it. ``inf`` for none.
        ema: decay per step of the exponential moving average of the weights, in [0, 1); the average is what is
            validated and shipped. Early in a run the decay is smaller, ``(1 + step) / (10 + step)``.
        checkpoint_seconds: time between checkpoints in s, ≤ 120.
        validate_every: steps between validations; the last step is always validated.
        log_every: steps between rows of the log.
        prior: arguments of :class:`recon.mbir.prior.PriorConfig`.
        unroll: steps K of :class:`recon.mbir.unrolled.Unrolled`.
        data, objective: of :mod:`train.data` and :mod:`train.objective`; their defaults if left out.

    Raises:
        ValueError: a value is out of its range, or ``prior`` has an unknown key.
    """

    seed: int = 0
    steps: int = 3000
    batch: int = 4
    learning_rate: float = 2e-3
    warmup: int = 50
    final_fraction: float = 0.02
    clip: float = 1.0
    ema: float = 0.995
    checkpoint_seconds: float = 60.0
    validate_every: int = 250
    log_every: int = 1
    prior: dict[str, Any] = field(default_factory=dict)
    unroll: int = 8
    data: DataConfig = field(default_factory=_data_config)
    objective: ObjectiveConfig = field(default_factory=_objective_config)

    def __post_init__(self) -> None:
        lowest = {"seed": 0, "steps": 1, "batch": 1, "warmup": 0, "validate_every": 1, "log_every": 1, "unroll": 1}
        for name, least in lowest.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"{name} must be an integer of at least {least}, got {value!r}")
        for name in ("learning_rate", "clip", "checkpoint_seconds"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)!r}")
        if not math.isfinite(self.learning_rate):
            raise ValueError(f"learning_rate must be finite, got {self.learning_rate!r}")
        if not self.checkpoint_seconds <= LONGEST_INTERVAL:
            raise ValueError(f"checkpoint_seconds must be at most {LONGEST_INTERVAL}, got {self.checkpoint_seconds!r}")
        if not 0 <= self.final_fraction <= 1:
            raise ValueError(f"final_fraction must be from 0 to 1, got {self.final_fraction!r}")
        if not 0 <= self.ema < 1:
            raise ValueError(f"ema must be from 0 to below 1, got {self.ema!r}")
        from recon.mbir.prior import PriorConfig

        _build(PriorConfig, self.prior, "prior")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainConfig:
        """From plain values; fields left out keep their defaults.

        Raises:
            ValueError: an unknown key, a value of the wrong kind or out of range; the message names it.
        """
        config: TrainConfig = _build(cls, values, "")
        return config

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON and YAML (tuples as lists)."""
        plain: dict[str, Any] = _plain(self)
        return plain

    @classmethod
    def from_yaml(cls, text: str) -> TrainConfig:
        """From YAML.

        Raises:
            ValueError: not a mapping of known keys to values of the right kind.
        """
        try:
            values = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ValueError(f"not YAML: {error}") from error
        if values is None:
            values = {}
        if not isinstance(values, dict):
            raise ValueError(f"a configuration is a mapping of names to values, got {type(values).__name__}")
        return cls.from_dict(values)

    def to_yaml(self) -> str:
        """All fields as YAML, such that :meth:`from_yaml` gives an equal configuration."""
        text: str = yaml.safe_dump(self.as_dict(), sort_keys=False, allow_unicode=True)
        return text


def load_config(path: str | Path) -> TrainConfig:
    """Configuration of a YAML file.

    Raises:
        ValueError: as :meth:`TrainConfig.from_yaml`, with the file's name.
        OSError: the file cannot be read.
    """
    try:
        return TrainConfig.from_yaml(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def packaged_config(name: str) -> TrainConfig:
    """A configuration of ``train/configs``, such as ``default`` or ``quick``."""
    text = resources.files("train").joinpath("configs", f"{name}.yaml").read_text(encoding="utf-8")
    return TrainConfig.from_yaml(text)


def differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """Names in which two configurations, as plain values, differ, with a dot after the name of a section."""
    a, b = _flat(first), _flat(second)
    missing = object()
    return sorted(key for key in a.keys() | b.keys() if a.get(key, missing) != b.get(key, missing))


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            out.update(_flat(value, f"{prefix}{key}."))
        else:
            out[prefix + key] = value
    return out


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value) if f.init}
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, Path):
        return str(value)
    return value


def _hints(cls: type) -> dict[str, Any]:
    # The sections of TrainConfig are imported for the type checker only.
    names: dict[str, Any] = {}
    if cls is TrainConfig:
        from train.data import DataConfig
        from train.objective import ObjectiveConfig

        names = {"DataConfig": DataConfig, "ObjectiveConfig": ObjectiveConfig}
    return typing.get_type_hints(cls, localns=names)


def _build(cls: Any, values: Any, where: str) -> Any:
    """Dataclass ``cls`` from plain values; ``where`` is its name in messages."""
    label = where or "the configuration"
    if not isinstance(values, Mapping):
        raise ValueError(f"{label} must be a mapping of names to values, got {values!r}")
    known = [f.name for f in dataclasses.fields(cls) if f.init]
    for key in values:
        if key not in known:
            name = f"{where}.{key}" if where else str(key)
            raise ValueError(f"unknown key {name!r}; known in {label}: {', '.join(known)}")
    hints = _hints(cls)
    arguments = {k: _convert(hints[k], v, f"{where}.{k}" if where else k) for k, v in values.items()}
    try:
        return cls(**arguments)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}" if where else str(error)) from error


def _convert(hint: Any, value: Any, where: str) -> Any:
    """A YAML value as the type of its field."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        rest = [a for a in arguments if a is not type(None)]
        if len(rest) == 1:
            return _convert(rest[0], value, where)
        return value
    if dataclasses.is_dataclass(hint):
        return value if isinstance(value, typing.cast(type, hint)) else _build(hint, value, where)
    if hint is float:
        return _float(value, where)
    if hint in (int, bool, str):
        if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
            raise ValueError(f"{where} must be of type {hint.__name__}, got {value!r}")
        return value
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise ValueError(f"{where} must be a list, got {value!r}")
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return tuple(_convert(arguments[0], v, where) for v in value)
        if len(value) != len(arguments):
            raise ValueError(f"{where} must have {len(arguments)} values, got {value!r}")
        return tuple(_convert(a, v, where) for a, v in zip(arguments, value, strict=True))
    if origin is dict and not isinstance(value, Mapping):
        raise ValueError(f"{where} must be a mapping, got {value!r}")
    return value


def _float(value: Any, where: str) -> float:
    # YAML 1.1 reads 1e-3, without a point, as text.
    if not isinstance(value, bool) and isinstance(value, (int, float, str)):
        try:
            return float(value)
        except ValueError:
            pass
    raise ValueError(f"{where} must be a number, got {value!r}")
