"""Scene, scanner and exposure as YAML: for ``torchpcct simulate --config``, and for tasks."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from torchpcct.acquisition.scanner_yaml import scanner_of
from torchpcct.formats.damage import read_yaml
from torchpcct.geometry import VolumeGrid
from torchpcct.scanner import presets
from torchpcct.scanner.scanner import Scanner
from torchpcct.scene.bodies import Box, Ellipsoid, EllipticCylinder
from torchpcct.scene.scene import Body, Scene
from torchpcct.scene.voxels import DENSE, VoxelScene
from torchpcct.validate import choice, number
from torchpcct.volume import Volume

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from torchpcct.scene.bodies import Shape


__all__ = ["SimulationConfig", "configured", "read_config"]

EXAMPLE = """\
# A simulated scan: torchpcct simulate --config scene.yaml --out scan.h5
scene:
  kind: bodies              # plaque, thorax, water, bodies, or volume
  # plaque: the paper's; patient_diameter, core_contrast, motion_amplitude, the fields of Plaque
  #         (vessel_diameter, core_scale, position), variant: stent; bodies: further ones, as below
  # water: diameter, length, position
  # volume: file: patient.nii.gz (a CT volume in HU), dense: bone, iodine, water or a file of labels
  #         0, 1, 2 (what is above muscle), energy_kev: 70 (mean energy of the volume's scan; null:
  #         its numbers come back)
  bodies:                   # mm; parents before their children
    - {name: patient, shape: cylinder, semi_axes: {x: 160, y: 110}, material: soft_tissue}
    - name: spine
      shape: cylinder
      semi_axes: 18
      position: {x: 0, y: -70, z: 0}    # a plain list is [x, y, z] in scene, [z, y, x] in region
      material: spongiosa
      parent: patient
    - name: vessel
      shape: ellipsoid
      semi_axes: {x: 5, y: 5, z: 5}
      position: {x: 40, y: 20, z: 0}
      material: iodine 10 mg/ml in blood
      parent: patient
scanner:
  preset: pcct              # pcct or eid; one of your own (geometry, source, detector, filters):
                            # see the how-to "Your own scanner"
  views: 984
  rows: 16
  columns: 1500
  bowtie: large
  kvp: 100
  current_ma: 1000
exposure_s: 1.0             # null: expected readings without noise
seed: 0
region: null                # grid to keep, such as
  # {shape: {z: 40, y: 90, x: 90}, spacing: 0.2, center: {z: 0, y: 20, x: 40}}
tolerance_hu: 0.5           # effects below it are left out
"""
"""Configuration that ``torchpcct show-config`` prints and ``torchpcct simulate`` takes."""

_SHAPES: dict[str, type[Shape]] = {"cylinder": EllipticCylinder, "ellipsoid": Ellipsoid, "box": Box}
"""Shapes of a body by their names in a file."""
_PRESETS: dict[str, Callable[..., Scanner]] = {"pcct": presets.pcct, "eid": presets.eid}
"""Scanners by their names in a file."""
_GRID = ("shape", "spacing", "center")
"""Fields of ``region``."""
_KEYS = ("scene", "scanner", "exposure_s", "seed", "region", "tolerance_hu")
"""Fields of a configuration."""


@dataclass(frozen=True)
class SimulationConfig:
    """What to simulate, built and checked.

    Attributes:
        scene, scanner, region: objects for :func:`torchpcct.acquire`; region None: the whole
            detector.
        exposure_s, seed, tolerance_hu: numbers for it.
        values: the resolved YAML mapping, with every default of a preset scanner; a scanner of
            one's own as it was given.
    """

    scene: Scene | VoxelScene
    scanner: Scanner
    region: VolumeGrid | None
    exposure_s: float | None
    seed: int
    tolerance_hu: float
    values: dict[str, Any]


def read_config(path: Path, **changes: object) -> SimulationConfig:
    """The configuration in a YAML file; ``changes`` replace its top-level values where they are not
    None.

    Raises:
        FileNotFoundError: no such file.
        ValueError, TypeError: no mapping, unknown names, bad values; the message names them.
    """
    values = _mapping(str(path), read_yaml(path, "a configuration"), _KEYS)
    return configured(
        {**values, **{k: v for k, v in changes.items() if v is not None}}, path.parent
    )


def configured(values: Mapping[str, object], folder: Path) -> SimulationConfig:
    """The configuration of a mapping as in YAML; ``folder`` is where the files that it names lie.

    Raises:
        ValueError, TypeError: unknown names, bad values; the message names them.
    """
    values = _mapping("the configuration", values, _KEYS)
    scene, scene_values = _scene(values.get("scene"), folder)
    scanner, scanner_values = _scanner(values.get("scanner"), folder)
    region = values.get("region")
    grid = None if region is None else grid_of("region", region)
    exposure, seed = values.get("exposure_s"), values.get("seed", 0)
    tolerance = number("tolerance_hu", values.get("tolerance_hu", 0.5), low=0.0, unit="HU")
    resolved = {
        "scene": scene_values,
        "scanner": scanner_values,
        "exposure_s": exposure,
        "seed": seed,
        "region": region,
        "tolerance_hu": tolerance,
    }
    return SimulationConfig(scene, scanner, grid, exposure, seed, tolerance, resolved)


def grid_of(name: str, value: object) -> VolumeGrid:
    """A grid of ``shape``, ``spacing`` and ``center``, numbers by axis or ``[z, y, x]``."""
    made: VolumeGrid = _build(name, VolumeGrid, _mapping(name, value, _GRID), order="zyx")
    return made


def _mapping(name: str, value: object, keys: Collection[str]) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise TypeError(
            f"{name} must be a mapping with {', '.join(keys)}, got {value!r:.200}; see torchpcct "
            "show-config"
        )
    unknown = [str(k) for k in value if k not in keys]
    if unknown:
        raise ValueError(f"{name}: unknown {', '.join(unknown)}; it takes {', '.join(keys)}")
    return dict(value)


def _parameters(function: Callable[..., object]) -> dict[str, inspect.Parameter]:
    """Parameters of a function or class with their defaults (none: empty)."""
    return {
        n: p.default
        for n, p in inspect.signature(function).parameters.items()
        if p.kind is not p.VAR_KEYWORD
    }


def _in_order(name: str, value: object, order: str) -> object:
    """Numbers by the names of their axes as a list in the ``order`` that a function takes; anything
    else as it is.

    Raises:
        ValueError: other names than those of the axes.
    """
    if not isinstance(value, Mapping):
        return value
    if len(value) < 2 or not set(value) <= set(order):
        raise ValueError(
            f"{name} must be numbers, or a mapping of the axes {', '.join(order)} such as "
            f"{{{', '.join(f'{a}: 0' for a in order)}}}, got {dict(value)!r}"
        )
    return [value[a] for a in order if a in value]


T = TypeVar("T")


def _build(
    name: str, function: Callable[..., T], given: Mapping[str, object], order: str = "xyz"
) -> T:
    """What a function or class makes of the ``given`` parameters; those given by axis come in
    ``order``.

    Raises:
        ValueError: one without a default is missing.
    """
    given = {k: _in_order(f"{name}.{k}", v, order) for k, v in given.items()}
    missing = [
        n
        for n, d in _parameters(function).items()
        if d is inspect.Parameter.empty and n not in given
    ]
    if missing:
        raise ValueError(f"{name} needs {', '.join(missing)}")
    return function(**given)


def _scanner(value: object, folder: Path) -> tuple[Scanner, dict[str, object]]:
    if value is not None and not isinstance(value, Mapping):
        raise TypeError(
            "scanner must be a mapping with preset (pcct or eid), or with geometry, source and "
            f"detector, got {value!r:.200}"
        )
    given = dict(value or {})
    if "geometry" in given:
        return scanner_of(given, folder), given
    preset = choice(
        "scanner.preset", given.pop("preset", "pcct" if value is None else None), tuple(_PRESETS)
    )
    known = {n: d for n, d in _parameters(_PRESETS[preset]).items() if n != "detector"}
    resolved = {**known, **_mapping("scanner", given, tuple(known))}
    return _PRESETS[preset](**resolved), {"preset": preset, **resolved}


def _scene(value: object, folder: Path) -> tuple[Scene | VoxelScene, dict[str, object]]:
    if not isinstance(value, Mapping):
        raise TypeError(
            f"scene must be a mapping with kind, got {value!r}; see torchpcct show-config"
        )
    given = dict(value)
    kind = choice(
        "scene.kind", given.pop("kind", None), ("plaque", "thorax", "water", "bodies", "volume")
    )
    if kind == "volume":
        return _voxels(_mapping("scene", given, ("file", "energy_kev", "dense")), folder)
    if kind == "bodies":
        _mapping("scene", given, ("bodies",))
        return Scene(_bodies(given)), {"kind": kind, **given}
    from torchpcct.scene.phantoms.quality import water_cylinder  # load what is asked for only
    from torchpcct.scene.phantoms.thorax import thorax
    from torchpcct.scene.plaque import Plaque, plaque_scene
    from torchpcct.scene.plaque.variants import plaque_variant

    more = _bodies(given)
    own = {k: v for k, v in given.items() if k != "bodies"}
    if kind == "plaque":
        variant = own.pop("variant", "paper")
        known = (*_parameters(plaque_scene), *(f.name for f in fields(Plaque)), "variant", "bodies")
        made = plaque_variant(variant, **_mapping("scene", own, known))[0]
    else:
        makers: dict[str, Callable[..., Scene]] = {"thorax": thorax, "water": water_cylinder}
        make = makers[kind]
        made = _build("scene", make, _mapping("scene", own, (*_parameters(make), "bodies")))
    return (made.add(*more) if more else made), {"kind": kind, **given}


def _bodies(given: Mapping[str, Any]) -> list[Body]:
    """Those of a scene, parents before their children."""
    bodies = given.get("bodies") or []
    if not isinstance(bodies, list | tuple):
        raise TypeError(
            f"scene.bodies must be a list of bodies, each on a line that begins with -, got "
            f"{bodies!r:.200}"
        )
    return [_body(k, body) for k, body in enumerate(bodies)]


def _body(k: int, value: object) -> Body:
    name = f"scene.bodies[{k}]"
    given = dict(value) if isinstance(value, Mapping) else {}
    shape = _SHAPES[choice(f"{name}.shape", given.pop("shape", None), tuple(_SHAPES))]
    common = {n: given.pop(n) for n in ("name", "material", "parent") if n in given}
    missing = [n for n in ("name", "material") if n not in common]
    if missing:
        raise ValueError(f"{name} needs {', '.join(missing)}")
    solid = _build(name, shape, _mapping(name, given, tuple(_parameters(shape))))
    return Body(common["name"], solid, common["material"], common.get("parent"))


def _voxels(given: dict[str, Any], folder: Path) -> tuple[VoxelScene, dict[str, object]]:
    if "file" not in given:
        raise ValueError("a scene of kind volume needs file, a CT volume in HU")
    energy = given.get("energy_kev")
    if energy is not None:
        energy = number("scene.energy_kev", energy, positive=True, unit="keV")
    volume = Volume.load(folder / given["file"])
    if volume.unit != "HU":
        raise ValueError(f"{given['file']} is in {volume.unit}: a scene is made of a volume in HU")
    dense = given.get("dense", "bone")
    description = {
        "kind": "volume",
        "file": str((folder / given["file"]).resolve()),
        "energy_kev": energy,
        "dense": dense,
    }
    if dense not in DENSE:
        if not isinstance(dense, str) or not (folder / dense).exists():
            raise ValueError(
                f"scene.dense must be {', '.join(DENSE)}, or a volume file of labels, got {dense!r}"
            )
        labels = Volume.load(folder / dense)
        if labels.grid != volume.grid:
            raise ValueError(f"scene.dense: the voxels of {dense} are not those of {given['file']}")
        description["dense"], dense = str((folder / dense).resolve()), np.asarray(labels.data)
    return VoxelScene(
        np.asarray(volume.data), volume.grid, energies_kev=energy, dense=dense
    ), description
