"""Against XCIST (``gecatsim``): line integrals of an analytic scene, and noise-free signals of an
EID-CT.

    pip install gecatsim && python -m pytest -m peers tests/test_peers_xcist.py

The scene is a water cylinder that holds an off-centre PMMA ellipsoid. XCIST starts with the source
at +y and counts the columns the other way; its cross-sections are taken where only geometry is
compared.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from torchpcct.acquisition.acquire import acquire
from torchpcct.geometry import ConeBeam
from torchpcct.scanner import presets
from torchpcct.scanner.detector import Scintillator
from torchpcct.scanner.source import Source
from torchpcct.scene import Body, Ellipsoid, EllipticCylinder, Scene
from torchpcct.scene.chords import chord_lengths
from torchpcct.scene.materials import MATERIALS

pytestmark = [
    pytest.mark.peers,
    # XCIST leaves its configuration files open and imports numpy.matlib.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::PendingDeprecationWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]

VIEWS = 8
COLUMNS = 400
ROWS = 4
PITCH = (1.0988, 1.0239)
OFFSET = 1.25 * 1.0239
KVP = 100
CURRENT_MA = 1000.0
_OBJECT = """object.center({k},:) = [{center}];
object.half_axes({k},:) = [{axes}];
object.euler_angs({k},:) = [{angles}];
object.density({k}) = 1.000000;
object.type({k}) = {kind};
object.material({k}) = {k};
object.axial_lims({k},:) = [0 0];
object.shape({k}) = 0;
object.clip{{{k}}} = [];

"""


def scene():
    cylinder = Body("cylinder", EllipticCylinder(100.0, 50.0), "water")
    ellipsoid = Ellipsoid((60.0, 40.0, 30.0), position=(20.0, -10.0, 0.0))
    return Scene([cylinder, Body("ellipsoid", ellipsoid, "pmma", "cylinder")])


def geometry():
    angles = math.pi / 2 + 2 * math.pi * np.arange(VIEWS) / VIEWS
    return ConeBeam(
        angles, 541.0, 949.0, COLUMNS, ROWS, PITCH, offset=(0.0, OFFSET), detector="curved"
    )


def readings(name, views=VIEWS):
    """A file of XCIST in our order of columns: ``(views, rows, columns)``."""
    return np.fromfile(name, np.float32).reshape(views, ROWS, COLUMNS)[..., ::-1].astype(np.float64)


@pytest.fixture
def xcist(tmp_path, monkeypatch):
    """XCIST's simulator, set to this scanner and scene, without noise; it writes into the
    current folder."""
    catsim = pytest.importorskip("gecatsim", reason="pip install gecatsim")
    monkeypatch.chdir(tmp_path)
    objects = [
        _OBJECT.format(k=1, center="0 0 0", axes="100 100 50", angles="90.0 0.0 0.0", kind=2),
        _OBJECT.format(
            k=2, center="20.0 -10.0 0.0", axes="60.0 40.0 30.0", angles="0.0 0.0 0.0", kind=1
        ),
    ]
    (tmp_path / "scene.ppm").write_text("materialList = {'water' 'plexi'};\n\n" + "".join(objects))
    run = catsim.CatSim()
    settings = {
        "phantom": {
            "callback": "Phantom_Analytic",
            "projectorCallback": "C_Projector_Analytic",
            "filename": "scene.ppm",
            "projectorNumThreads": 1,
        },
        "physics": {
            "enableQuantumNoise": 0,
            "enableElectronicNoise": 0,
            "srcXSampleCount": 1,
            "srcYSampleCount": 1,
            "viewSampleCount": 1,
        },
        "protocol": {
            "viewsPerRotation": VIEWS,
            "viewCount": VIEWS,
            "stopViewId": VIEWS - 1,
            "mA": CURRENT_MA,
            "rotationTime": 1.0,
            "spectrumFilename": f"tungsten_tar7.0_{KVP}_filt.dat",
        },
        "scanner": {
            "sid": 541.0,
            "sdd": 949.0,
            "detectorColCount": COLUMNS,
            "detectorRowCount": ROWS,
            "detectorRowsPerMod": ROWS,
            "detectorColSize": PITCH[1],
            "detectorRowSize": PITCH[0],
            "detectorColOffset": -1.25,
            "detectorPrefilter": [],
            "focalspotShape": "Uniform",
            "focalspotWidth": 1e-3,
            "focalspotLength": 1e-3,
            "detectionGain": 1.0,
        },
    }
    for part, values in settings.items():
        for key, value in values.items():
            setattr(getattr(run, part), key, value)
    run.resultsName = "out"
    return SimpleNamespace(run=run, folder=tmp_path)


def test_line_integrals_of_the_centre_rays(xcist):
    from gecatsim.pyfiles.GetMu import GetMu

    run = xcist.run
    run.physics.monochromatic = 60
    run.physics.colSampleCount = run.physics.rowSampleCount = 1
    run.protocol.bowtie, run.protocol.flatFilter = "", []
    run.run_all()
    g = geometry()
    away = -np.stack([np.cos(g.angles), np.sin(g.angles), 0 * g.angles], 1)
    across = np.stack([-np.sin(g.angles), np.cos(g.angles), 0 * g.angles], 1)
    gamma = g.fan_angles[:, None]
    # (views, columns, 3)
    cells = g.sdd * (away[:, None] * np.cos(gamma) + across[:, None] * np.sin(gamma))
    up = np.array([0.0, 0.0, 1.0]) * g.row_positions[:, None, None]
    directions = (cells[:, None] + up).reshape(-1, 3)
    origins = np.repeat(-g.sod * away, ROWS * COLUMNS, axis=0)
    cylinder, ellipsoid = chord_lengths(scene(), origins, directions).reshape(
        2, VIEWS, ROWS, COLUMNS
    )
    # per cm to per mm
    water, pmma = (float(np.ravel(GetMu(m, 60.0))[0]) / 10.0 for m in ("water", "plexi"))
    ours, theirs = water * (cylinder - ellipsoid) + pmma * ellipsoid, readings("out.prep")
    assert np.abs(ours - theirs).max() < 2e-3 * ours.max()


def test_noise_free_signals(xcist):
    run = xcist.run
    run.physics.energyCount = 100
    run.physics.colSampleCount = run.physics.rowSampleCount = 8
    run.run_all()
    import gecatsim

    table = np.loadtxt(
        f"{gecatsim.__path__[0]}/spectrum/tungsten_tar7.0_{KVP}_filt.dat",
        delimiter=",",
        skiprows=1,
        max_rows=200,
    )
    used = table[:, 1] > 0
    source = Source.tabulated(
        table[used, 0], table[used, 1] / 100.0, current_ma=CURRENT_MA, focal_spot=(0.0, 0.0)
    )
    detector = Scintillator(depth_mm=3.0, fill_factor=0.81, electronic_noise_kev=0.0)
    scanner = presets.eid(detector=detector).replace(geometry=geometry(), source=source)
    assert MATERIALS["lumex"] is detector.material
    scan = acquire(scene(), scanner, exposure_s=None, duty=1e-3, sub_rays=64)
    air = readings("out.air", 1)[0]
    np.testing.assert_allclose(scan.air.reshape(ROWS, COLUMNS).numpy(), air, rtol=0.01)
    ours, theirs = scan.counts.reshape(VIEWS, ROWS, COLUMNS).numpy(), readings("out.scan")
    np.testing.assert_allclose(ours, theirs, rtol=0.01)
