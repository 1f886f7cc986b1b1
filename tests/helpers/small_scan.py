"""A ball of fibrous tissue in fat, and a scanner of few views and rows: a scan that tests can
afford."""

from dataclasses import replace

from torchpcct import VolumeGrid
from torchpcct.scanner import presets
from torchpcct.scene import Body, Ellipsoid, EllipticCylinder, Scene

CENTER = (0.0, -30.38, -29.63)
GRID = VolumeGrid((8, 18, 18), 0.4, CENTER)
SPECTRAL_GRID = VolumeGrid((6, 12, 12), 0.4, CENTER)


def scanner(mode="counting", views=120, rows=12):
    s = presets.pcct(views=views, mode=mode)
    return s.replace(geometry=replace(s.geometry, rows=rows))


BALL = Ellipsoid((1.6, 1.6, 1.2), position=CENTER[::-1])
SCENE = Scene(
    [
        Body("patient", EllipticCylinder(120.0), "pericoronary_fat"),
        Body("ball", BALL, "fibrous_tissue", "patient"),
    ]
)
