"""A table of bad inputs: each is refused by a TypeError or ValueError that names the argument, never anything else."""

import math

import numpy as np
import pytest
import torch

from recon import fbp, pwls
from recon.fbp.fbp import filter_sinogram, interleave
from recon.pwls.qggmrf import QGGMRF
from recon.study import registry
from torchpcct import ConeBeam, FanBeam, ParallelBeam, Projector, Volume, VolumeGrid, full_turn
from torchpcct.detector_window import DetectorWindow, shadow
from torchpcct.metrics import cnr, mean_interval, sd_interval
from torchpcct.metrics.residual_test import residual_test
from torchpcct.scanner import Source
from torchpcct.scanner.linearisation import WaterLinearisation
from torchpcct.scene import Body, Ellipsoid, EllipticCylinder, Scene

NAN, INF = math.nan, math.inf
NO_NUMBER = ("a", None, 1j, [1.0], {}, object())
LENGTH = (*NO_NUMBER, NAN, INF, -INF, 0.0, -1.0)
PLACE = (*NO_NUMBER, NAN, INF, -INF)
COUNT = ("a", None, 1j, [1], {}, NAN, INF, 1.5, 0, -1, True, "3")
CHOICE = ("round", None, 3, "", ["flat"])

PARALLEL = {"angles": full_turn(8), "columns": 8, "pitch": 1.0, "offset": 0.0}
FAN = {**PARALLEL, "sod": 500.0, "sdd": 1000.0, "detector": "flat"}
CONE = {**FAN, "rows": 4}
WINDOW = {"first_column": [0, 1], "columns": 3, "first_row": 0, "rows": 2}
WATER = {"coefficients": np.ones((4, 2)), "scale": np.ones(4), "mu_ref": 0.02}
ANGLES = (None, "a", [], [[0.0]], [NAN], [INF], 1.0, [1j], {})

TABLE = [
    (ParallelBeam, PARALLEL, {"angles": ANGLES, "columns": COUNT, "pitch": LENGTH, "offset": PLACE}),
    (
        FanBeam,
        FAN,
        {"angles": ANGLES, "sod": LENGTH, "sdd": (*LENGTH, 400.0), "columns": COUNT, "pitch": LENGTH, "offset": PLACE,
         "detector": CHOICE},
    ),
    (
        ConeBeam,
        CONE,
        {"angles": ANGLES, "sod": LENGTH, "sdd": (*LENGTH, 400.0), "columns": COUNT, "rows": COUNT,
         "pitch": (*LENGTH, (1.0, 0.0), (1.0, NAN), (1.0, 1.0, 1.0)), "offset": (*PLACE, (0.0, NAN), (0.0, 0.0, 0.0)),
         "detector": CHOICE},
    ),
    (
        VolumeGrid,
        {"shape": (2, 3, 4), "spacing": 1.0, "center": 0.0},
        {"shape": (None, 3, "abc", (1,), (1, 2, 3, 4), (1, 0, 2), (1, -1, 2), (1, 1.5, 2), (NAN, 1, 1), (True, 1, 1)),
         "spacing": (*LENGTH, (1.0, 1.0), (1.0, 1.0, 0.0)), "center": (*PLACE, (0.0, 0.0), (0.0, 0.0, INF))},
    ),
    (
        DetectorWindow,
        WINDOW,
        {"columns": (0, -1, "a", None, 1.5, NAN), "rows": (0, -1, "a", None, 1.5), "first_row": (-1, "a", None, 0.5),
         "first_column": ([], [-1], [[0]], "a", None, [0.5], [NAN])},
    ),
    (
        WaterLinearisation,
        WATER,
        {"mu_ref": LENGTH, "scale": (None, "a", [], np.ones(3), -np.ones(4), [1, 1, 1, NAN], np.ones(4) * 1j),
         "coefficients": (None, "a", [], np.ones(4), np.ones((3, 2)), np.full((4, 2), NAN))},
    ),
    (full_turn, {"views": 8}, {"views": COUNT}),
    (sd_interval, {"sd": 1.0, "realizations": 10, "level": 0.9},
     {"sd": (*NO_NUMBER, NAN, INF, -1.0), "realizations": (*COUNT, 1), "level": (*NO_NUMBER, NAN, 0.0, 1.0, 95)}),
    (mean_interval, {"means": [1.0, 2.0], "level": 0.9},
     {"means": ([], [1.0], [NAN, 1.0], [[1.0, 2.0]], [INF, 1.0]), "level": (*NO_NUMBER, NAN, 0.0, 1.0, 95)}),
    (QGGMRF, {"strength": 0.3, "threshold": 300.0},
     {"strength": (NAN, INF, -1.0, "a"), "threshold": (NAN, -1.0, 0.0, "a")}),
]  # fmt: skip

ROWS = [(f, {**good, name: bad}, name) for f, good, table in TABLE for name, values in table.items() for bad in values]


def test_the_table_is_long():
    assert len(ROWS) >= 200
    for function, good, _ in TABLE:
        function(**good)


@pytest.mark.parametrize(
    ("function", "arguments", "name"), ROWS, ids=[f"{f.__name__}-{n}-{a[n]!r:.20}" for f, a, n in ROWS]
)
def test_a_bad_value_is_refused_by_its_name(function, arguments, name):
    with pytest.raises((ValueError, TypeError)) as caught:
        function(**arguments)
    assert name in str(caught.value)


CONE_2 = ConeBeam(full_turn(8), 500.0, 1000.0, 32, 4, 1.0)
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
    "projector: NaN motion": (lambda: Projector(CONE_2, GRID, motion=np.full((8, 3), NAN)), "motion"),
    "projector: memory": (lambda: Projector(CONE_2, GRID, memory=0), "memory"),
    "projector: source inside": (lambda: Projector(CONE_2, VolumeGrid((2, 4, 4), 300.0)), "source"),
    "shadow: beyond the field": (lambda: shadow(CONE_2, VolumeGrid((1, 1, 1), 1.0, (0, 0, 90.0))), "field of view"),
    "shadow: motion": (lambda: shadow(CONE_2, GRID, motion=np.zeros((2, 3))), "motion"),
    "fbp: numpy": (lambda: fbp(np.zeros(CONE_2.shape), CONE_2, GRID), "sinogram"),
    "fbp: shape": (lambda: fbp(Y[1:], CONE_2, GRID), "sinogram"),
    "fbp: integers": (lambda: fbp(Y.long(), CONE_2, GRID), "sinogram"),
    "fbp: kernel": (lambda: fbp(Y, CONE_2, GRID, "hard"), "kernel"),
    "fbp: no kernel": (lambda: fbp(Y, CONE_2, GRID, []), "kernel"),
    "fbp: weights": (lambda: fbp(Y, CONE_2, GRID, weights=np.ones(3)), "weights"),
    "fbp: 2-D grid": (lambda: fbp(Y, CONE_2, GRID.slice), "grid"),
    "filter: weights": (lambda: filter_sinogram(Y, CONE_2, weights=np.ones((8, 3))), "weights"),
    "interleave: shape": (lambda: interleave(Y[..., 1:], CONE_2), "sinogram"),
    "pwls: data": (lambda: pwls(A, np.zeros(1), Y + 1, QGGMRF(1.0, 300.0), hu=2e-5), "y must"),
    "pwls: shape": (lambda: pwls(A, Y[1:], Y + 1, QGGMRF(1.0, 300.0), hu=2e-5), "y must"),
    "pwls: NaN": (lambda: pwls(A, Y * NAN, Y + 1, QGGMRF(1.0, 300.0), hu=2e-5), "y holds NaN"),
    "pwls: weights": (lambda: pwls(A, Y, Y - 1, QGGMRF(1.0, 300.0), hu=2e-5), "weights"),
    "pwls: no weights": (lambda: pwls(A, Y, Y, QGGMRF(1.0, 300.0), hu=2e-5), "weights"),
    "cnr: shapes": (lambda: cnr([1.0, 2.0], [1.0, 2.0, 3.0]), "shape"),
    "cnr: one": (lambda: cnr([1.0], [1.0]), "at least 2"),
    "cnr: NaN": (lambda: cnr([1.0, NAN], [1.0, 2.0]), "NaN"),
    "residual: shapes": (lambda: residual_test(Y, Y, Y[1:]), "shape"),
    "volume: numpy": (lambda: Volume(np.zeros(GRID.shape), GRID), "data"),
    "volume: shape": (lambda: Volume(torch.zeros(1, 4, 4), GRID), "data"),
    "body: radius": (lambda: Ellipsoid((1.0, -1.0, 1.0)), ""),
    "body: endless": (lambda: EllipticCylinder(NAN), ""),
    "body: material": (lambda: Scene([Body("a", EllipticCylinder(1.0), "unobtainium")]), "unobtainium"),
    "source: voltage": (lambda: Source(kvp=-1), ""),
    **{
        f"study {name}: {change}": (
            lambda n=name, c=change: registry.build_settings(n, changes=[c]),
            change.split("=")[0],
        )
        for name in registry.STUDIES
        for change in ("nonsense=1", "=", "views")
    },
}


@pytest.mark.parametrize("name", CALLS)
def test_a_bad_call_is_refused(name):
    call, word = CALLS[name]
    with pytest.raises((ValueError, TypeError)) as caught:
        call()
    assert word in str(caught.value)
