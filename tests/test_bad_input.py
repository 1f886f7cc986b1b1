"""A table of bad inputs: each is refused by a TypeError or ValueError that names the argument,
never anything else."""

import inspect
import math
import sys

import numpy as np
import pytest
import torch

import recon
import torchpcct.scanner
from recon import fbp, pwls
from recon.analytic.fbp import filter_sinogram, interleave
from recon.least_squares.qggmrf import QGGMRF
from torchpcct import (
    ConeBeam,
    FanBeam,
    ParallelBeam,
    Projector,
    Scan,
    Volume,
    VolumeGrid,
    VoxelScene,
    dose,
    full_turn,
    metrics,
    spectral,
)
from torchpcct.detector_window import DetectorWindow, footprint
from torchpcct.metrics import cnr, cnr_interval, sd_interval
from torchpcct.scanner import SiliconDetector, Source, TransportedSilicon, presets
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.scene import Ellipsoid, Scene, chord_lengths
from torchpcct.scene.materials import MATERIALS, Material

NAN = math.nan
INF = math.inf
NO_NUMBER = ("a", None, 1j, [1.0], {}, object(), True, np.True_)
LENGTH = (*NO_NUMBER, NAN, INF, -INF, 0.0, -1.0)
PLACE = (*NO_NUMBER, NAN, INF, -INF)
NO_SCAN = (1e-300, 1e300)
"""Lengths that no scan has."""
AFAR = (1e30, -1e30, 1e300)
"""Places that no detector has."""
COUNT = ("a", None, 1j, [1], {}, NAN, INF, 1.5, 0, -1, True, "3")
LEVEL = (*NO_NUMBER, NAN, -0.5, 0.0, 1.0, 2.0, 95)
CHOICE = ("round", None, 3, "", ["flat"])

PARALLEL = {"angles": full_turn(8), "columns": 8, "pitch": 1.0, "offset": 0.0}
FAN = {**PARALLEL, "sod": 500.0, "sdd": 1000.0, "detector": "flat"}
CONE = {**FAN, "rows": 4}
WINDOW = {"first_column": [0, 1], "columns": 3, "first_row": 0, "rows": 2}
WATER = {"coefficients": np.ones((4, 2)), "scale": np.ones(4), "mu_ref": 0.02}
ANGLES = (
    None,
    "a",
    [],
    [[0.0]],
    [NAN],
    [INF],
    1.0,
    [1j],
    {},
    [1 + 2j, 0.3],
    [None, 1.0],
    [[0.1], [0.2, 0.3]],
    [0.0, 1e30],
)

TABLE = [
    (
        ParallelBeam,
        PARALLEL,
        {
            "angles": ANGLES,
            "columns": (*COUNT, 10**12),
            "pitch": (*LENGTH, *NO_SCAN),
            "offset": (*PLACE, *AFAR),
        },
    ),
    (
        FanBeam,
        FAN,
        {
            "angles": ANGLES,
            "sod": (*LENGTH, *NO_SCAN),
            "sdd": (*LENGTH, 400.0, *NO_SCAN),
            "columns": (*COUNT, 10**12),
            "pitch": (*LENGTH, *NO_SCAN, 1e5),
            "offset": (*PLACE, *AFAR, 1e5),
            "detector": CHOICE,
        },
    ),
    (
        ConeBeam,
        CONE,
        {
            "angles": ANGLES,
            "sod": (*LENGTH, *NO_SCAN),
            "sdd": (*LENGTH, 400.0, *NO_SCAN),
            "columns": (*COUNT, 10**12),
            "rows": (*COUNT, 10**12),
            "pitch": (
                *LENGTH,
                (1.0, 0.0),
                (1.0, NAN),
                (1.0, 1.0, 1.0),
                *NO_SCAN,
                (1e-300, 1.0),
                (1e5, 1.0),
            ),
            "offset": (*PLACE, (0.0, NAN), (0.0, 0.0, 0.0), *AFAR, (1e30, 0.0), (1e5, 0.0)),
            "detector": CHOICE,
        },
    ),
    (
        VolumeGrid,
        {"shape": (2, 3, 4), "spacing": 1.0, "center": 0.0},
        {
            "shape": (
                None,
                3,
                "abc",
                (1,),
                (1, 2, 3, 4),
                (1, 0, 2),
                (1, -1, 2),
                (1, 1.5, 2),
                (NAN, 1, 1),
                (True, 1, 1),
            ),
            "spacing": (*LENGTH, (1.0, 1.0), (1.0, 1.0, 0.0)),
            "center": (*PLACE, (0.0, 0.0), (0.0, 0.0, INF)),
        },
    ),
    (
        DetectorWindow,
        WINDOW,
        {
            "columns": (0, -1, "a", None, 1.5, NAN),
            "rows": (0, -1, "a", None, 1.5),
            "first_row": (-1, "a", None, 0.5),
            "first_column": ([], [-1], [[0]], "a", None, [0.5], [NAN]),
        },
    ),
    (
        WaterLinearisation,
        WATER,
        {
            "mu_ref": LENGTH,
            "scale": (
                None,
                "a",
                [],
                np.ones(3),
                -np.ones(4),
                [1, 0, 1, 1],
                [1, 1, 1, NAN],
                [1j] * 4,
            ),
            "coefficients": (
                None,
                "a",
                [],
                np.ones(4),
                np.ones((3, 2)),
                np.ones((4, 0)),
                np.full((4, 2), NAN),
                np.full((4, 2), INF),
                np.full((4, 2), 1j),
            ),
        },
    ),
    (full_turn, {"views": 8}, {"views": COUNT}),
    (
        sd_interval,
        {"sd": 1.0, "realisations": 10, "level": 0.9},
        {"sd": (*NO_NUMBER, NAN, INF, -1.0), "realisations": (*COUNT, 1), "level": LEVEL},
    ),
    (
        cnr_interval,
        {"foreground_means": [1.0, 2.0, 4.0], "background_means": [4.1, 2.1, 1.1], "level": 0.9},
        {"level": LEVEL},
    ),
    (
        QGGMRF,
        {"strength": 0.3, "threshold": 300.0},
        {"strength": (NAN, INF, -1.0, "a"), "threshold": (NAN, -1.0, 0.0, "a")},
    ),
]

ROWS = [
    (f, {**good, name: bad}, name)
    for f, good, table in TABLE
    for name, values in table.items()
    for bad in values
]


def test_the_table_is_long():
    assert len(ROWS) >= 200
    for function, good, _ in TABLE:
        function(**good)


@pytest.mark.parametrize(
    ("function", "arguments", "name"),
    ROWS,
    ids=[f"{f.__name__}-{n}-{a[n]!r:.20}" for f, a, n in ROWS],
)
def test_a_bad_value_is_refused_by_its_name(function, arguments, name):
    with pytest.raises((ValueError, TypeError)) as caught:
        function(**arguments)
    assert name in str(caught.value)


CONE_2 = ConeBeam(full_turn(8), 500.0, 1000.0, 32, 4, 1.0)
FAN_2 = FanBeam(full_turn(8), 500.0, 1000.0, 32, 1.0)
GRID = VolumeGrid((2, 4, 4), 0.5)
A = Projector(CONE_2, GRID)
Y = torch.zeros(CONE_2.shape)

CALLS = {
    "projector: numpy": (lambda: A(np.zeros(GRID.shape)), "x"),
    "projector: shape": (lambda: A(torch.zeros(2, 4, 5)), "x"),
    "projector: integers": (lambda: A(torch.zeros(GRID.shape, dtype=torch.int64)), "x"),
    "projector: complex": (lambda: A(torch.zeros(GRID.shape, dtype=torch.complex64)), "x"),
    "adjoint: shape": (lambda: A.T(torch.zeros(8, 4, 31)), "y"),
    "projector: 2-D grid": (lambda: Projector(CONE_2, GRID.slice), "grid"),
    "projector: grid is None": (lambda: Projector(CONE_2, None), "grid"),
    "projector: geometry is None": (lambda: Projector(None, GRID), "geometry"),
    "projector: window": (lambda: Projector(CONE_2, GRID, "all"), "window"),
    "projector: motion": (lambda: Projector(CONE_2, GRID, motion=np.zeros(3)), "motion"),
    "projector: NaN motion": (
        lambda: Projector(CONE_2, GRID, motion=np.full((8, 3), NAN)),
        "motion",
    ),
    "projector: source inside the moved grid": (
        lambda: Projector(FAN_2, GRID.slice, motion=np.tile([0.0, 500.0], (8, 1))),
        "source",
    ),
    "projector: 3-D grid": (lambda: Projector(FAN_2, GRID), "grid"),
    "projector: views of the window": (
        lambda: Projector(FAN_2, GRID.slice, DetectorWindow([0] * 3, 5)),
        "window",
    ),
    "projector: columns of the window": (
        lambda: Projector(FAN_2, GRID.slice, DetectorWindow([30] * 8, 5)),
        "columns",
    ),
    "projector: rows of the window": (
        lambda: Projector(CONE_2, GRID, DetectorWindow([0] * 8, 5, 1, 4)),
        "rows",
    ),
    "projector: memory of no batch": (lambda: A.memory_estimate(-1), "batch"),
    "projector: memory of half precision": (lambda: A.memory_estimate(1, torch.float16), "dtype"),
    "projector: source inside": (lambda: Projector(CONE_2, VolumeGrid((2, 4, 4), 300.0)), "source"),
    "footprint: beyond the field": (
        lambda: footprint(CONE_2, VolumeGrid((1, 1, 1), 1.0, (0, 0, 90.0))),
        "field of view",
    ),
    "footprint: motion": (lambda: footprint(CONE_2, GRID, motion=np.zeros((2, 3))), "motion"),
    "fbp: shape": (lambda: fbp(Y[1:], CONE_2, GRID), "sinogram"),
    "fbp: integers": (lambda: fbp(Y.long(), CONE_2, GRID), "sinogram"),
    "fbp: kernel": (lambda: fbp(Y, CONE_2, GRID, "hard"), "kernel"),
    "fbp: no kernel": (lambda: fbp(Y, CONE_2, GRID, []), "kernel"),
    "fbp: weights": (lambda: fbp(Y, CONE_2, GRID, weights=np.ones(3)), "weights"),
    "fbp: 2-D grid": (lambda: fbp(Y, CONE_2, GRID.slice), "grid"),
    "filter: weights": (lambda: filter_sinogram(Y, CONE_2, weights=np.ones((8, 3))), "weights"),
    "interleave: shape": (lambda: interleave(Y[..., 1:], CONE_2), "sinogram"),
    "pwls: shape": (lambda: pwls(A, Y[1:], Y + 1, QGGMRF(1.0, 300.0), mu_per_hu=2e-5), "y must"),
    "pwls: integers": (
        lambda: pwls(A, (Y + 1).int(), Y + 1, QGGMRF(1.0, 300.0), mu_per_hu=2e-5),
        "y must",
    ),
    "pwls: NaN": (
        lambda: pwls(A, Y * NAN, Y + 1, QGGMRF(1.0, 300.0), mu_per_hu=2e-5),
        "y holds NaN",
    ),
    "pwls: weights": (lambda: pwls(A, Y, Y - 1, QGGMRF(1.0, 300.0), mu_per_hu=2e-5), "weights"),
    "pwls: no weights": (lambda: pwls(A, Y, Y, QGGMRF(1.0, 300.0), mu_per_hu=2e-5), "weights"),
    "cnr: shapes": (lambda: cnr([1.0, 2.0], [1.0, 2.0, 3.0]), "shape"),
    "cnr: one": (lambda: cnr([1.0], [1.0]), "at least 2"),
    "cnr: NaN": (lambda: cnr([1.0, NAN], [1.0, 2.0]), "NaN"),
    "cnr: constants": (lambda: cnr([1.0, 1.0], [2.0, 2.0]), "do not vary"),
    "volume: numpy": (lambda: Volume(np.zeros(GRID.shape), GRID), "data"),
    "volume: shape": (lambda: Volume(torch.zeros(1, 4, 4), GRID), "data"),
    "cnr_from_moments: shapes": (
        lambda: metrics.cnr_from_moments([1.0, 2.0], 1.0, [1.0, 2.0, 3.0], 1.0),
        "fg_mean (2,)",
    ),
    "controlled_mean: no axis": (lambda: metrics.controlled_mean([1.0, 2.0], 0.0, 0.0), "controls"),
    "inverse: two entries": (lambda: spectral.inverse(torch.ones(2, 3)), "packed"),
    "label: complex": (
        lambda: spectral.label(torch.ones(2, 3, dtype=torch.complex64)),
        "fractions",
    ),
    "spectral model: text": (lambda: spectral.SpectralModel("a", np.ones((2, 2, 2))), "energies"),
    "spectral model: complex": (
        lambda: spectral.SpectralModel([50.0, 60.0], np.ones((2, 2, 2)) * 1j),
        "spectra",
    ),
    "voxels: text": (lambda: VoxelScene("a", GRID), "hu"),
    "material: list of shares": (lambda: Material("a", 1.0, [1.0]), "mass_fractions of 'a'"),
    "material: text for a share": (lambda: Material("a", 1.0, {"H": "x"}), "mass fraction of H"),
    "material: two densities": (lambda: Material("a", [1.0, 2.0], {"H": 1.0}), "density"),
    "material: two weights": (
        lambda: MATERIALS["water"].hu([50.0, 60.0, 70.0], [1.0, 2.0]),
        "weights",
    ),
    "material: no energy": (lambda: MATERIALS["water"].attenuation([]), "energies_kev"),
    "preset: number for a bowtie": (lambda: presets.pcct(bowtie=3.0), "bowtie"),
    "detector: array for a mode": (lambda: SiliconDetector(np.zeros(3)), "mode"),
    "detector: no stack": (lambda: TransportedSilicon(stack=None), "stack"),
    "tube: table of one": (lambda: Source(table="a"), "table"),
    "chords: nothing": (lambda: chord_lengths(None, np.zeros(3), np.ones(3)), "scene"),
    "scene: nothing": (lambda: Scene(None), "bodies"),
    "body: text for a rotation": (lambda: Ellipsoid(1.0, rotation=["a"]), "rotation"),
    "scan: text for a seed": (
        lambda: Scan.from_counts(Y + 5, CONE_2, air=9.0).at_dose(0.5, "a"),
        "seed",
    ),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_bad_call_is_refused(name):
    call, word = CALLS[name]
    with pytest.raises((ValueError, TypeError)) as caught:
        call()
    assert word in str(caught.value)


PACKAGES = (torchpcct, torchpcct.scanner, torchpcct.scene, metrics, spectral, dose, recon)
FUNCTIONS = {
    f"{f.__module__}.{f.__name__}": f
    for package in PACKAGES
    for name in package.__all__
    if inspect.isfunction(f := getattr(package, name)) and inspect.signature(f).parameters
}


def _fits(kind, names):
    """Something that an annotation takes; of a class an empty instance, for no function sees it."""
    head, _, inner = kind.split(" | ")[0].partition("[")
    if head == "tuple":
        return (1.0,) * (inner.count(",") + 1)
    known = {
        "float": 1.0,
        "int": 1,
        "str": "a",
        "bool": True,
        "ArrayLike": [1.0],
        "Floats": [1.0],
        "Callable": len,
        "Tensor": torch.zeros(2),
        "Sequence": [],
        "Mapping": {},
    }
    made = names.get(head)
    return (
        known[head] if head in known else object.__new__(made) if isinstance(made, type) else None
    )


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_argument_of_every_public_function_is_refused_by_its_name(name):
    """Of a wrong kind, before anything is done with it: no AttributeError, no words of numpy or
    torch."""
    function = FUNCTIONS[name]
    assert hasattr(function, "__wrapped__"), "decorate it with torchpcct.validate.checked"
    parameters = inspect.signature(function).parameters
    kinds = {
        n: str(p.annotation)
        for n, p in parameters.items()
        if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
    }
    names = {**vars(sys.modules[function.__module__]), "Any": None}
    fitting = {
        n: _fits(kind, names)
        for n, kind in kinds.items()
        if parameters[n].default is inspect.Parameter.empty
    }
    for argument, kind in kinds.items():
        if {"Any", "object", "torch.device"} & set(kind.split(" | ")):
            continue  # the function's own business
        with pytest.raises(TypeError, match=rf"^{argument} must be .*, got <object object at"):
            function(**{**fitting, argument: object()})
