"""Configuration of a training run and its YAML form.

A YAML file holds the fields that differ from the defaults of :class:`TrainConfig`, or from those of
a packaged configuration that its key ``base`` names. Sections (``network``, ``data``, ``late``,
``objective``) are mappings. Unknown keys are errors, so that a misspelt one does not silently train
the default. Every class checks its own values, whether they come from YAML or from Python.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

import yaml

from recon.mbir.network import NetworkConfig
from recon.names import is_module_name, packaged_names
from torchpcct.formats.damage import read_yaml, yaml_values
from torchpcct.validate import checked, number, numbers, whole
from train.scenes.scene import SceneConfig

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from torchpcct.typing import Json, JsonObject


__all__ = ["DataConfig", "ObjectiveConfig", "TrainConfig", "load_config"]

LONGEST_INTERVAL = 120.0
"""Largest ``checkpoint_seconds``: what a killed run may lose, in s."""
_MOST = 10**9
"""Steps, scenes and views at most: more are a slip of the pen."""
_MOST_MARGIN = 8
"""Voxels: more would leave little of any core."""
_HIGHEST = {"seed": 2**62, "unroll": 1000}
"""Other limits."""
_MOST_VOXELS = 1024
"""Voxels along an edge of the training inset at most."""
_FASTEST = 10.0
"""Learning rate at most: about what a weight moves in a step."""
_FOLDER = resources.files("train") / "configs"
"""Of the packaged configurations."""
_MERGED = ("data", "late", "objective")
"""Sections that a file with a ``base`` gives in part."""
OPTIMISERS = ("adam", "soap")
"""Names of the optimisers."""
_FORMER_NAMES = {
    "looks": "fidelities",
    "relative": "image",
    "bias": "contrast_bias",
    "flat_from": "end_from",
}
"""Of parts of the loss, which older files have, and what they are called now."""
OF_ROIS = ("core_roi", "tissue_roi", "flat_roi", "roi_margin")
"""Fields of :class:`DataConfig` that no view of a scene depends on."""
OF_THE_END = ("flat", "empty", "lesion_bias", "contrast_end")
"""Parts of the loss that count from ``end_from`` on."""
VALIDATED_AT_ONCE = 4
"""Scenes that a validation reconstructs at a time."""


def _set(config: object, **values: object) -> None:
    """Put checked values into a frozen dataclass."""
    for name, value in values.items():
        object.__setattr__(config, name, value)


def _is_list(value: object) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


C = TypeVar("C", bound="DataclassInstance")


def _section(cls: type[C], values: object, where: str) -> C:
    """Dataclass ``cls`` from plain values; ``where`` is its name in messages."""
    if isinstance(values, cls):
        return values
    label = where or "the configuration"
    if not isinstance(values, Mapping):
        raise ValueError(f"{label} must be a mapping of names to values, got {values!r}")
    known = [f.name for f in fields(cls)]
    for former, name in _FORMER_NAMES.items():
        if former in values and name in known:
            if name in values:
                raise ValueError(f"{label}: {former} is the former name of {name}: leave one out")
            values = {name if k == former else k: v for k, v in values.items()}
    for key in values:
        if key not in known:
            name = f"{where}.{key}" if where else str(key)
            listed = ", ".join(known if where else ["base", *known])
            raise ValueError(f"unknown key {name!r}; known in {label}: {listed}")
    needed = [f.name for f in fields(cls) if f.default is MISSING and f.default_factory is MISSING]
    missing = [name for name in needed if name not in values]
    if missing:
        raise ValueError(f"{label}: needs {', '.join(map(repr, missing))}")
    try:
        return cls(**values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}" if where else str(error)) from error


def _network(given: Any) -> JsonObject:
    """Checked arguments of a network, as a mapping."""
    values = {"class": given} if isinstance(given, str) else given
    if not isinstance(values, Mapping) or "class" not in values:
        _section(NetworkConfig, values, "network")
        return dict(values)
    name = values["class"]
    if not isinstance(name, str) or not is_module_name(name):
        raise ValueError(f"network.class must be package.module:Class, got {name!r}")
    for key in values:
        if not isinstance(key, str) or not key.isidentifier():
            raise ValueError(f"network: {key!r} names no argument of {name}")
    return dict(values)


@dataclass(frozen=True)
class Situation:
    """Where the inset lies and what the scan is like.

    Args:
        x, y: centre of the inset, mm.
        patient_mm: diameter of the adipose cylinder.
        pitch_scale: factor on the detector's pitch.
    """

    x: float
    y: float
    patient_mm: float = 240.0
    pitch_scale: float = 1.0

    def __post_init__(self) -> None:
        _set(self, x=number("x", self.x), y=number("y", self.y))
        _set(
            self,
            **{
                k: number(k, getattr(self, k), positive=True) for k in ("patient_mm", "pitch_scale")
            },
        )


_SITUATIONS = (
    Situation(42.0, 0.0),
    Situation(-20.0, 38.0),
    Situation(5.0, -8.0),
    Situation(30.0, -55.0, patient_mm=280.0),
    Situation(-50.0, -20.0, patient_mm=200.0),
    Situation(10.0, 40.0, pitch_scale=1.15),
)
"""Places of the inset, patients and detectors that scenes are seen in."""


@dataclass(frozen=True)
class DataConfig:
    """What the training draws.

    Args:
        shape: voxels of the training inset (z, y, x).
        voxel_mm: voxel size; 0.2 is the one that :func:`recon.mbir.reconstruct.reconstruct_mbir`
            works at.
        exposure_s: range of the exposure, log-uniform.
        views: views of the scans whose Gram operators are taken (their exposure is that of the
            whole scan).
        situations: one Gram operator each; one is drawn per step.
        scenes: changes of :class:`train.scenes.scene.SceneConfig`.
        scenes_kept: different scenes, each with an exposure, two noise draws and a volume without
            noise; what the network sees of them is computed once and kept in a file, 1.1 MB a scene
            of the usual shape.
        core_roi, tissue_roi: ranges of the radii of the random ROIs, mm.
        flat_roi: share of ROIs that are discs of one slice, as in an axial image, instead of balls.
        roi_margin: voxels by which ROIs in cores keep away from the border, where at least 8 voxels
            are left: there contrast is lost to blur, and to count it there teaches a network to
            exaggerate it in the middle.

    Raises:
        TypeError, ValueError: a value is out of its range, or ``scenes`` or a situation has an
            unknown key.
    """

    shape: tuple[int, int, int] = (40, 32, 32)
    voxel_mm: float = 0.2
    exposure_s: tuple[float, float] = (0.2, 8.0)
    views: int = 984
    situations: tuple[Situation, ...] = _SITUATIONS
    scenes: JsonObject = field(default_factory=dict)
    scenes_kept: int = 4000
    core_roi: tuple[float, float] = (0.25, 0.8)
    tissue_roi: tuple[float, float] = (0.15, 0.45)
    flat_roi: float = 0.6
    roi_margin: int = 0

    def __post_init__(self) -> None:
        if not _is_list(self.shape) or len(self.shape) != 3:
            raise ValueError(f"shape must be 3 numbers (z, y, x), got {self.shape!r}")
        if not self.situations:
            raise ValueError("situations must name at least one scan")
        if not _is_list(self.situations):
            raise ValueError(
                f"situations must be a list of places such as {{x: 42, y: 0}}, got "
                f"{self.situations!r}"
            )
        _section(SceneConfig, self.scenes, "scenes")
        _set(
            self,
            shape=tuple(
                whole(f"shape[{i}]", n, high=_MOST_VOXELS) for i, n in enumerate(self.shape)
            ),
            voxel_mm=number("voxel_mm", self.voxel_mm, positive=True),
            views=whole("views", self.views, high=_MOST),
            situations=tuple(
                _section(Situation, s, f"situations[{i}]") for i, s in enumerate(self.situations)
            ),
            scenes_kept=whole("scenes_kept", self.scenes_kept, high=_MOST),
            flat_roi=number("flat_roi", self.flat_roi, low=0.0, high=1.0),
            roi_margin=whole("roi_margin", self.roi_margin, 0, _MOST_MARGIN),
        )
        for i, place in enumerate(self.situations):
            if math.hypot(place.x, place.y) >= place.patient_mm / 2.0:
                raise ValueError(
                    f"situations[{i}]: x and y must be in mm and within the patient, whose radius "
                    f"is {place.patient_mm / 2.0:g} mm, got x {place.x:g}, y {place.y:g}"
                )
        for name in ("exposure_s", "core_roi", "tissue_roi"):
            low, high = numbers(name, getattr(self, name), 2, positive=True)
            if low > high:
                raise ValueError(
                    f"{name} must be a range, the lower end first, got {getattr(self, name)}"
                )
            _set(self, **{name: (low, high)})


@dataclass(frozen=True)
class LateConfig:
    """Other scenes in the last part of a training, which the weights keep most of.

    Args:
        begins: share of the steps after which they are drawn; 1 for never.
        scenes: changes of :class:`train.scenes.scene.SceneConfig`, instead of those of the data.
        scenes_kept, roi_margin: as of the data.

    Raises:
        TypeError, ValueError: a value is out of its range, or ``scenes`` has an unknown key.
    """

    begins: float = 1.0
    scenes: JsonObject = field(default_factory=dict)
    scenes_kept: int = 2000
    roi_margin: int = 0

    def __post_init__(self) -> None:
        _section(SceneConfig, self.scenes, "scenes")
        _set(
            self,
            begins=number("begins", self.begins, low=0.0, high=1.0),
            scenes_kept=whole("scenes_kept", self.scenes_kept, high=_MOST),
            roi_margin=whole("roi_margin", self.roi_margin, 0, _MOST_MARGIN),
        )


@dataclass(frozen=True)
class ObjectiveConfig:
    """Weights of the terms of :mod:`train.objective` and size of the validation.

    Args:
        image: of ‖e‖² over that of the filtered view; edge: by how much more a voxel counts in both
            within two voxels of an edge; body: in bodies and one voxel about them; flat: in bodies,
            where the truth is constant for two voxels around, such as deep in a lumen; empty: the
            same outside of bodies, such as in fat.
        lesion_bias: by how much more than the variance the squared bias of each voxel of a lesion
            counts in ``image``, at fidelity 0 and at fidelity 1, linear between.
        noise_free: of ``image`` of the same scene without noise, against those with noise: what is
            left there is blur and overshoot.
        contrast: of the ROI contrasts' errors at fidelity 1; viewing: share of it that is left at
            fidelity 0, linear between; contrast_end: ``contrast`` in the end, None if it stays.
        contrast_bias: κ at fidelity 0 and at fidelity 1, linear between.
        end_from: share of the training after which the end begins: what :data:`OF_THE_END` names
            counts from there on.
        contrast_sd: an ROI contrast error, in noise units, that counts as 1.
        fidelities: range of the fidelity, uniform.
        held_out: scenes of the validation, of another seed than those of the training.

    Raises:
        TypeError, ValueError: a value is out of its range.
    """

    image: float = 30.0
    edge: float = 2.0
    body: float = 0.0
    flat: float = 0.0
    empty: float = 0.0
    lesion_bias: tuple[float, float] = (0.0, 0.0)
    noise_free: float = 0.0
    contrast: float = 0.2
    contrast_end: float | None = None
    viewing: float = 1.0
    contrast_bias: tuple[float, float] = (1.0, 1.0)
    end_from: float = 0.0
    contrast_sd: float = 0.15
    fidelities: tuple[float, float] = (0.0, 1.0)
    held_out: int = 64

    def __post_init__(self) -> None:
        for name in ("edge", "body", "flat", "empty", "noise_free", "contrast"):
            _set(self, **{name: number(name, getattr(self, name), low=0.0)})
        _set(self, image=number("image", self.image, positive=True))
        if self.contrast_end is not None:
            _set(self, contrast_end=number("contrast_end", self.contrast_end, low=0.0))
        _set(self, end_from=number("end_from", self.end_from, low=0.0, high=1.0))
        _set(self, viewing=number("viewing", self.viewing, low=0.0, high=1.0))
        _set(self, contrast_sd=number("contrast_sd", self.contrast_sd, positive=True))
        for name in ("contrast_bias", "lesion_bias"):
            first, last = numbers(name, getattr(self, name), 2)
            if not (first >= 0 and last >= 0):
                raise ValueError(
                    f"{name} must be two weights of at least 0, of fidelity 0 and fidelity 1, got "
                    f"{getattr(self, name)}"
                )
            _set(self, **{name: (first, last)})
        low, high = numbers("fidelities", self.fidelities, 2)
        if not 0 <= low <= high <= 1:
            raise ValueError(f"fidelities must be a range within 0 … 1, got {self.fidelities}")
        _set(self, fidelities=(low, high))
        _set(self, held_out=whole("held_out", self.held_out, 2, _MOST))


@dataclass(frozen=True)
class TrainConfig:
    """A training run. Everything in it is counted in steps, so that the result does not depend on
    the machine's speed.

    Args:
        seed: of the weights' start, the data and the validation, ≥ 0.
        steps: optimisation steps.
        batch: scenes of a step, over all processes.
        optimiser: "adam", or "soap" (:mod:`train.soap`).
        learning_rate: of the optimiser, at the end of the warm-up.
        warmup: steps over which it rises linearly; it counts only steps that change the weights, as
            the average does.
        decay: share of the steps, at the end, over which the learning rate falls along a cosine;
            before, it is constant, and a run may be resumed with other ``steps``.
        final_fraction: of ``learning_rate`` that the cosine ends with, 0 to 1.
        clip: largest norm of the gradient of the mean loss; longer ones are shortened to it.
            ``inf`` for none.
        ema: decay per step of the exponential moving average of the weights, in [0, 1); the average
            is what is validated and shipped. Early in a run the decay is smaller, ``(1 + n) / (10 +
            n)`` after n steps.
        checkpoint_seconds: time between checkpoints in s, ≤ 120.
        validate_every: steps between validations; the last step is always validated.
        log_every: steps between rows of the log.
        network: arguments of :class:`recon.mbir.network.NetworkConfig`. Or of a network of a user's
            own: ``class``, its ``package.module:Class``, and the arguments of that; without
            arguments its name alone. It is imported when the training begins, not here.
        unroll: steps K of :class:`recon.mbir.unrolled.Unrolled`.
        single: share of the training with one step of the K: the network is the same in all, and
            one is cheaper.
        bfloat16: convolve in that precision where the processor has it, in half the time (others
            would imitate it, at twenty times the time, and convolve in float32).
        data, late, objective: :class:`DataConfig`, :class:`LateConfig` and
            :class:`ObjectiveConfig`, or mappings of their fields.

    Raises:
        TypeError, ValueError: a value is out of its range, or a section has an unknown key.
    """

    seed: int = 0
    steps: int = 3000
    batch: int = 4
    optimiser: str = "adam"
    learning_rate: float = 2e-3
    warmup: int = 50
    decay: float = 1.0
    final_fraction: float = 0.02
    clip: float = 1.0
    ema: float = 0.995
    checkpoint_seconds: float = 60.0
    validate_every: int = 250
    log_every: int = 1
    network: JsonObject = field(default_factory=dict)
    unroll: int = 2
    single: float = 0.5
    bfloat16: bool = True
    data: DataConfig = field(default_factory=DataConfig)
    late: LateConfig = field(default_factory=LateConfig)
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)

    def __post_init__(self) -> None:
        lowest = {
            "seed": 0,
            "steps": 1,
            "batch": 1,
            "warmup": 0,
            "validate_every": 1,
            "log_every": 1,
            "unroll": 1,
        }
        for name, least in lowest.items():
            whole(name, getattr(self, name), least, _HIGHEST.get(name, _MOST))
        _set(
            self,
            learning_rate=number("learning_rate", self.learning_rate, positive=True, high=_FASTEST),
            decay=number("decay", self.decay, low=0.0, high=1.0),
            final_fraction=number("final_fraction", self.final_fraction, low=0.0, high=1.0),
            clip=number("clip", self.clip, positive=True, finite=False),
            ema=number("ema", self.ema, low=0.0),
            checkpoint_seconds=number(
                "checkpoint_seconds", self.checkpoint_seconds, positive=True, high=LONGEST_INTERVAL
            ),
            data=_section(DataConfig, self.data, "data"),
            late=_section(LateConfig, self.late, "late"),
            objective=_section(ObjectiveConfig, self.objective, "objective"),
        )
        if self.optimiser not in OPTIMISERS:
            raise ValueError(f"optimiser must be {' or '.join(OPTIMISERS)}, got {self.optimiser!r}")
        if self.ema >= 1:
            raise ValueError(f"ema must be less than 1, got {self.ema:g}")
        _set(self, single=number("single", self.single, low=0.0, high=1.0))
        if not isinstance(self.bfloat16, bool):
            raise TypeError(f"bfloat16 must be true or false, got {self.bfloat16!r}")
        _set(self, network=_network(self.network))
        kinds = len(self.data.situations)
        pools = [
            ("data.scenes_kept", self.data.scenes_kept, self.batch),
            ("objective.held_out", self.objective.held_out, VALIDATED_AT_ONCE),
        ]
        if self.late_begins < self.steps:
            pools.append(("late.scenes_kept", self.late.scenes_kept, self.batch))
        for name, scenes, batch in pools:
            if math.ceil(scenes / kinds) < batch:
                raise ValueError(
                    f"{name} must be at least {kinds * (batch - 1) + 1}, got {scenes}: scenes of "
                    f"{batch} are taken at a time, all of one of the {kinds} situations"
                )

    @property
    def decay_begins(self) -> int:
        """Updates after which the learning rate falls."""
        return round(self.steps * (1.0 - self.decay))

    @property
    def end_begins(self) -> int:
        """The first step that depends on how many there will be."""
        fewer = 0 if self.unroll > 1 and self.single else self.steps
        changes = self.steps if self.loss_changes is None else self.loss_changes
        return min(self.decay_begins, self.late_begins, changes, fewer)

    @property
    def loss_changes(self) -> int | None:
        """The first step with all parts of the loss; None if all steps have them."""
        o = self.objective
        later = any(getattr(o, name) != getattr(ObjectiveConfig, name) for name in OF_THE_END)
        first = math.floor(self.steps * o.end_from)
        first += first / self.steps < o.end_from  # as the loss compares its progress
        return first if later else None

    @property
    def late_begins(self) -> int:
        """The first step with the late scenes."""
        return round(self.steps * self.late.begins)

    @property
    def late_data(self) -> DataConfig:
        """What the training draws from then on."""
        late = self.late
        return replace(
            self.data,
            scenes=late.scenes,
            scenes_kept=late.scenes_kept,
            roi_margin=late.roi_margin,
        )

    @classmethod
    def from_yaml(cls, text: str) -> Self:
        """From YAML; fields left out are those of the packaged configuration that ``base`` names,
        without ``base`` the defaults.

        Raises:
            ValueError: not a mapping of known keys to values of the right kind and range; the
                message names the key.
        """
        return cls.of(yaml_values(text))

    @classmethod
    def of(cls, values: object) -> Self:
        """The same of what YAML holds; None for nothing."""
        config: Self = _section(cls, _on_base({} if values is None else values), "")
        return config

    def as_dict(self) -> dict[str, Json]:
        """Plain values for JSON and YAML (tuples as lists)."""
        plain: dict[str, Json] = json.loads(json.dumps(asdict(self)))
        return plain

    def to_yaml(self) -> str:
        """All fields as YAML, such that :meth:`from_yaml` gives an equal configuration."""
        text: str = yaml.safe_dump(self.as_dict(), sort_keys=False, allow_unicode=True)
        return text


def _on_base(values: object) -> object:
    """What YAML holds, on top of the packaged configuration that its key ``base`` names.

    The fields of :data:`_MERGED` are taken one by one, every other value as a whole: half a network
    or a list of places would be another one.
    """
    if not isinstance(values, Mapping) or "base" not in values:
        return values
    name, known = values["base"], packaged_names(_FOLDER)
    if name not in known:
        raise ValueError(f"base must be one of {', '.join(known)}, got {name!r}")
    out = dict(_packaged(name))
    for key, value in values.items():
        if key in _MERGED and isinstance(value, Mapping):
            out[key] = {**out.get(key, {}), **value}
        elif key != "base":
            out[key] = value
    return out


def _packaged(name: str) -> JsonObject:
    """What the YAML file of a packaged configuration holds, its base included."""
    text = (_FOLDER / f"{name}.yaml").read_text(encoding="utf-8")
    values: Any = _on_base(yaml_values(text))
    return dict(values)


@checked
def load_config(path: str | Path) -> TrainConfig:
    """Configuration of a YAML file.

    Raises:
        ValueError: as :meth:`TrainConfig.from_yaml`, with the file's name.
        OSError: the file cannot be read.
    """
    values = read_yaml(path, "a configuration of a training")
    try:
        return TrainConfig.of(values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


@checked
def packaged_config(name: str) -> TrainConfig:
    """A configuration of ``train/configs``, such as ``default`` or ``quick``."""
    return TrainConfig.of(_packaged(name))


@checked
def differences(first: Mapping[str, object], second: Mapping[str, object]) -> list[str]:
    """Names in which two configurations, as plain values, differ, with a dot after the name of a
    section."""
    a, b = _flat(first), _flat(second)
    missing = object()
    return sorted(key for key in a.keys() | b.keys() if a.get(key, missing) != b.get(key, missing))


def _flat(values: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    out: dict[str, object] = {}
    for key, value in values.items():
        out.update(
            _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
        )
    return out
