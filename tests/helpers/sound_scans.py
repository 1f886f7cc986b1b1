"""Sound scans drawn at random: no check may find anything wrong with them, and wrong ones are made
of them.

Nothing here knows of the package's projector: chords of ellipsoids, elliptic cylinders and boxes
are exact, each cell averages the transmissions of rays spread over it (and, of some scans, over the
focal spot and the arc that a view takes), the photons have Poisson noise. A seed tells all of a
scan.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from torchpcct.geometry import ConeBeam, FanBeam, ParallelBeam, VolumeGrid
from torchpcct.scan import Scan

__all__ = ["KINDS", "Drawn", "Solid", "draw", "transmissions"]

Floats = NDArray[np.float64]
BALL = 0
CYLINDER = 1
BOX = 2
KINDS = ("parallel", "fan", "cone")
DENSITIES = ((0.02, 0.05), (0.3, 0.6), (2.0, 7.0))
"""Attenuation over that of water of foam, of wood, and of stone and metal."""


@dataclass(frozen=True)
class Solid:
    """A uniform body.

    Args:
        shape: ``BALL``, ``CYLINDER`` (its axis the third) or ``BOX``.
        center: x, y, z in mm.
        radii: half-axes in its own frame, mm.
        value: attenuation that it adds, mm⁻¹.
        turn, tilt: about z, after that about x, rad.
    """

    shape: int
    center: tuple[float, float, float]
    radii: tuple[float, float, float]
    value: float
    turn: float = 0.0
    tilt: float = 0.0

    @property
    def numbers(self) -> list[float]:
        """Shape, centre, value and the nine numbers of the matrix to the unit body."""
        c, s, a, b = (
            math.cos(self.turn),
            math.sin(self.turn),
            math.cos(self.tilt),
            math.sin(self.tilt),
        )
        about_z = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, a, b], [0.0, -b, a]])
        matrix = (about_z @ about_x) / np.array(self.radii)[:, None]
        return [float(self.shape), *self.center, self.value, *matrix.ravel().tolist()]


@njit(cache=True)
def _chord(body, px, py, pz, dx, dy, dz):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    qx, qy, qz = px - body[1], py - body[2], pz - body[3]
    ax = body[5] * dx + body[6] * dy + body[7] * dz
    ay = body[8] * dx + body[9] * dy + body[10] * dz
    az = body[11] * dx + body[12] * dy + body[13] * dz
    bx = body[5] * qx + body[6] * qy + body[7] * qz
    by = body[8] * qx + body[9] * qy + body[10] * qz
    bz = body[11] * qx + body[12] * qy + body[13] * qz
    if body[0] == 0.0:
        aa, ab, bb = (
            ax * ax + ay * ay + az * az,
            ax * bx + ay * by + az * bz,
            bx * bx + by * by + bz * bz,
        )
        inside = ab * ab - aa * (bb - 1.0)
        return 2.0 * math.sqrt(inside) / aa if inside > 0.0 else 0.0
    low, high = -1e12, 1e12
    if body[0] == 1.0:
        aa, ab, bb = ax * ax + ay * ay, ax * bx + ay * by, bx * bx + by * by
        inside = ab * ab - aa * (bb - 1.0)
        if inside <= 0.0:
            return 0.0
        root = math.sqrt(inside)
        low, high = (-ab - root) / aa, (-ab + root) / aa
    else:
        for a, b in ((ax, bx), (ay, by)):
            if abs(a) < 1e-15:
                if abs(b) > 1.0:
                    return 0.0
                continue
            first, last = (-1.0 - b) / a, (1.0 - b) / a
            low, high = max(low, min(first, last)), min(high, max(first, last))
    if abs(az) < 1e-15:
        if abs(bz) > 1.0:
            return 0.0
    else:
        first, last = (-1.0 - bz) / az, (1.0 - bz) / az
        low, high = max(low, min(first, last)), min(high, max(first, last))
    return max(high - low, 0.0)


@njit(cache=True)
def _mean_transmissions(bodies, angles, arc, u, w, pitches, subs, kind, sod, sdd, spot, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """``kind``: 0 parallel, 1 flat, 2 curved; ``subs``: rays a cell along columns, rows and the
    arc of a view."""
    columns, rows, arcs = subs
    total = columns * rows * arcs
    # Coprime to the number of rays, so that all parts of the focal spot have one and none is to one
    # side.
    stride = 7 if total % 7 else 11
    cosines, sines = np.empty(arcs), np.empty(arcs)
    for v in range(angles.size):
        for m in range(arcs):
            b = angles[v] + arc * ((m + 0.5) / arcs - 0.5)
            cosines[m], sines[m] = math.cos(b), math.sin(b)
        for r in range(w.size):
            for k in range(u.size):
                mean = 0.0
                for n in range(total):
                    i, j, m = n % columns, (n // columns) % rows, n // (columns * rows)
                    c, s = cosines[m], sines[m]
                    at = u[k] + pitches[1] * ((i + 0.5) / columns - 0.5)
                    height = w[r] + pitches[0] * ((j + 0.5) / rows - 0.5)
                    if kind == 0:
                        px, py, pz = -at * s, at * c, height
                        dx, dy, dz = c, s, 0.0
                    else:
                        # Each ray of a cell starts at another part of the focal spot.
                        shift = spot * (((stride * n) % total + 0.5) / total - 0.5)
                        px, py, pz = sod * c - shift * s, sod * s + shift * c, 0.0
                        far, across = (
                            (sdd, at)
                            if kind == 1
                            else (sdd * math.cos(at / sdd), sdd * math.sin(at / sdd))
                        )
                        qx, qy = sod * c - far * c - across * s, sod * s - far * s + across * c
                        dx, dy, dz = qx - px, qy - py, height
                        length = math.sqrt(dx * dx + dy * dy + dz * dz)
                        dx, dy, dz = dx / length, dy / length, dz / length
                    p = 0.0
                    for body in bodies:
                        p += body[4] * _chord(body, px, py, pz, dx, dy, dz)
                    mean += math.exp(-p)
                out[v, r, k] = mean / total


def transmissions(
    geometry: Any,
    solids: list[Solid],
    *,
    subs: tuple[int, int, int] = (3, 2, 1),
    arc: float = 0.0,
    spot: float = 0.0,
) -> Floats:
    """Transmissions averaged over cells, ``(views, [rows,] columns)``.

    Args:
        geometry: parallel, fan or cone beam; of the first two the plane z = 0.
        solids: whose attenuations add up.
        subs: rays a cell along the columns, the rows, and the arc of a view.
        arc: by which the scanner turns during a view, rad.
        spot: width of the focal spot, mm.
    """
    cone = isinstance(geometry, ConeBeam)
    kind = 0 if isinstance(geometry, ParallelBeam) else 1 + (geometry.detector == "curved")
    sod, sdd = (0.0, 0.0) if kind == 0 else (geometry.sod, geometry.sdd)
    w = geometry.row_positions if cone else np.zeros(1)
    pitches = np.array(geometry.pitch if cone else (0.0, geometry.pitch), np.float64)
    per_cell = np.array((subs[0], subs[1] if cone else 1, subs[2]), np.int64)
    out = np.empty((geometry.views, w.size, geometry.columns))
    bodies = np.array([s.numbers for s in solids], np.float64).reshape(-1, 14)
    _mean_transmissions(
        bodies,
        np.asarray(geometry.angles, np.float64),
        arc,
        np.asarray(geometry.column_positions, np.float64),
        np.asarray(w, np.float64),
        pitches,
        per_cell,
        kind,
        float(sod),
        float(sdd),
        spot,
        out,
    )
    return out if cone else out[:, 0]


@dataclass(frozen=True)
class Drawn:
    """A sound scan, and what it was made of.

    Attributes:
        seed: of all of it.
        kind: one of :data:`KINDS`.
        text: what it is, in one line.
        geometry, solids, photons, options: photons a cell in air; ``options`` of
            :func:`transmissions`.
        profile: relative readings in air, ``([rows,] columns)``.
        frames: of which air was measured; 0: it is known.
        electronic_noise: photons.
        mu_water: mm⁻¹.
        grid: that the readings show.
        rightly: parts of warnings that are true of it.
    """

    seed: int
    kind: str
    text: str
    geometry: Any
    solids: list[Solid]
    photons: float
    mu_water: float
    grid: VolumeGrid
    profile: Any = 1.0
    frames: int = 0
    electronic_noise: float = 0.0
    options: dict[str, Any] = field(default_factory=dict)
    rightly: tuple[str, ...] = ()

    def scan(self, geometry: Any = None, shone: Any = None) -> Scan:
        """The scan, with its Poisson noise.

        Args:
            geometry: that it is described with; None: its own.
            shone: transmissions; None: its own.
        """
        rng = np.random.default_rng([self.seed, 1])
        shone = (
            transmissions(self.geometry, self.solids, **self.options) if shone is None else shone
        )
        air = np.broadcast_to(self.photons * self.profile, shone.shape[1:])
        counts = rng.poisson(air * shone).astype(np.float64)
        measured = (
            rng.poisson(air, (self.frames, *air.shape)).astype(np.float64) if self.frames else air
        )
        extra: dict[str, Any] = {}
        if self.electronic_noise:
            extra["electronic_noise"] = self.electronic_noise
            counts += self.electronic_noise * rng.standard_normal(counts.shape)
            extra["dark"] = np.zeros(air.shape)
        return Scan.from_counts(
            counts,
            self.geometry if geometry is None else geometry,
            air=measured,
            mu_water=self.mu_water,
            **extra,
        )

    def wrongly(self, texts: list[str]) -> list[str]:
        """Those of some warnings that are not true of the scan."""
        return [text for text in texts if not any(part in text for part in self.rightly)]


# --- what is scanned ------------------------------------------------------------------------------


def _inserts(rng: Any, count: int, reach: float, height: float, mu: float) -> list[Solid]:
    """Small bodies inside an ellipse of the radius ``reach``, within ``height`` of z = 0."""
    found = []
    for _ in range(count):
        size = reach * rng.uniform(0.05, 0.3)
        away, way = (reach - size) * math.sqrt(rng.uniform()), rng.uniform(0, 2 * math.pi)
        tall = 1e5 if math.isinf(height) else max(min(size, 0.8 * height), 1e-3)
        radii = (size, size * rng.uniform(0.4, 1.0), tall)
        z = 0.0 if math.isinf(height) else rng.uniform(-1, 1) * max(height - tall, 0.0)
        value = mu * (rng.uniform(-1.0, 1.2) if rng.random() < 0.6 else rng.uniform(-0.05, 0.05))
        shape = CYLINDER if math.isinf(height) else int(rng.integers(3))
        if shape == BOX:
            radii = (0.7 * radii[0], 0.7 * radii[1], radii[2])
        found.append(
            Solid(
                shape,
                (away * math.cos(way), away * math.sin(way), z),
                radii,
                value,
                rng.uniform(0, 3),
            )
        )
    return found


def _object(rng: Any, fov: float, height: float, mu: float) -> tuple[str, list[Solid]]:
    """A body within the radius ``fov``, of a kind drawn at random.

    Args:
        fov: mm.
        height: half of what all views see at any place, mm; of a plane infinite.
        mu: its attenuation, mm⁻¹.
    """
    plane = math.isinf(height)
    names = ["round", "off-centre", "ellipse", "several", "shell", "box"]
    if not plane:
        names += ["tilted", "pancake", "disc", "disc", "tall", "tooth", "animal", "plate"]
    name = str(rng.choice(names))
    endless = plane or rng.random() < 0.25
    high = 1e5 if endless else height

    def z(radius: float) -> float:
        return 0.0 if endless else rng.uniform(-1, 1) * max(height - radius, 0.0)

    def placed(radius: float) -> tuple[float, float]:
        away, way = max(fov - radius, 0.0) * math.sqrt(rng.uniform()), rng.uniform(0, 2 * math.pi)
        return away * math.cos(way), away * math.sin(way)

    solid = CYLINDER if endless else (BALL if rng.random() < 0.7 else CYLINDER)
    if name == "round":
        r = fov * rng.uniform(0.4, 0.95)
        c = high if solid == CYLINDER else min(r, height)
        bodies = [Solid(solid, (0.0, 0.0, 0.0), (r, r, c), mu)]
        if rng.random() < 0.5:
            bodies += _inserts(
                rng, int(rng.integers(1, 6)), 0.9 * r, math.inf if endless else c / 2, mu
            )
    elif name in ("off-centre", "ellipse", "tilted"):
        a = fov * rng.uniform(0.15, 0.9)
        b = a * (1.0 if name == "off-centre" else rng.uniform(0.4, 1.0))
        x, y = placed(a)
        tilt = rng.uniform(-1.0, 1.0) if name == "tilted" else 0.0
        c = 1e5 if endless and not tilt else min(a * rng.uniform(0.4, 1.2), 0.9 * height)
        if tilt:
            solid, b = BALL, min(b, 0.8 * height)
        zz = 0.0 if c > height else z(math.hypot(c, b * math.sin(tilt)))
        bodies = [
            Solid(solid, (x, y, zz), (a, b, c), mu, rng.uniform(0, 3) if not tilt else 0.0, tilt)
        ]
        for s in _inserts(
            rng, int(rng.integers(0, 4)), 0.7 * min(a, b), math.inf if c > height else 0.5 * c, mu
        ):
            cx, cy, cz = s.center
            bodies.append(replace(s, center=(cx + x, cy + y, cz + zz)))
    elif name == "box":
        a, turn = (
            fov * rng.uniform(0.2, 0.65),
            float(rng.choice([0.0, 0.5 * math.pi, rng.uniform(0, 3)])),
        )
        c = min(a * rng.uniform(0.4, 1.2), 0.9 * high)
        x, y = placed(1.42 * a)
        bodies = [Solid(BOX, (x, y, z(c)), (a, a * rng.uniform(0.2, 1.0), c), mu, turn)]
    elif name == "several":
        bodies = []
        for _ in range(int(rng.integers(2, 6))):
            r = fov * rng.uniform(0.05, 0.35)
            c = 1e5 if endless else min(r * rng.uniform(0.5, 1.5), height)
            bodies.append(
                Solid(
                    solid,
                    (*placed(r), z(c)),
                    (r, r * rng.uniform(0.6, 1), c),
                    mu * rng.uniform(0.3, 1.5),
                )
            )
    elif name == "shell":
        a, thick = fov * rng.uniform(0.5, 0.95), rng.uniform(0.03, 0.15)
        b = a * rng.uniform(0.7, 1.0)
        c = 1e5 if endless else min(a, height)
        inner = 1.0 - thick
        hollow = (inner * a, inner * b, c if endless else inner * c)
        bodies = [
            Solid(solid, (0.0, 0.0, 0.0), (a, b, c), mu),
            Solid(solid, (0.0, 0.0, 0.0), hollow, -mu * rng.uniform(0.3, 1)),
            *_inserts(rng, 3, 0.7 * b, math.inf if endless else 0.5 * c, mu),
        ]
    elif name in ("pancake", "disc", "plate"):
        a = fov * rng.uniform(0.3, 0.95)
        shape = {"pancake": BALL, "disc": CYLINDER, "plate": BOX}[name]
        a *= 0.7 if shape == BOX else 1.0
        c = height * rng.uniform(0.08, 0.9)
        x, y = placed(a * (1.42 if shape == BOX else 1.0)) if rng.random() < 0.6 else (0.0, 0.0)
        zz = rng.uniform(-1, 1) * (height - c)
        tilt = (
            float(np.clip(rng.normal(0, 0.3), -1, 1)) * (height - c - abs(zz)) / a
            if rng.random() < 0.4
            else 0.0
        )
        bodies = [
            Solid(shape, (x, y, zz), (a, a * rng.uniform(0.6, 1), c), mu, rng.uniform(0, 3), tilt)
        ]
        for s in _inserts(rng, int(rng.integers(0, 4)), 0.55 * a, 0.8 * c, mu):
            cx, cy, cz = s.center
            bodies.append(replace(s, center=(cx + x, cy + y, cz + zz)))
    elif name == "tall":  # beyond the rows, above and below
        a = fov * rng.uniform(0.3, 0.9)
        x, y = placed(a)
        middle = z(height / 2)
        radii = (a, a * rng.uniform(0.6, 1), height * rng.uniform(1.5, 6))
        up, value = rng.uniform(-1, 1) * height, mu * rng.uniform(-1, 1)
        # A hole stays within.
        c = a / 3 if value > 0.0 else min(a / 3, 0.3 * radii[2])
        bodies = [
            Solid(BALL, (x, y, middle), radii, mu),
            Solid(BALL, (x, y, up), (a / 3, a / 3, c), value),
        ]
    elif name == "tooth":
        a, c = fov * rng.uniform(0.3, 0.7), height * rng.uniform(0.6, 1.0)
        x, y = placed(a)
        b = a * rng.uniform(0.7, 1)
        post = (a * 0.1, a * 0.1, c * 0.3)
        bodies = [
            Solid(BALL, (x, y, 0.0), (a, b, c), mu),
            Solid(BALL, (x, y, 0.4 * c), (a * 0.6, b * 0.6, c * 0.5), 0.8 * mu),
            Solid(BALL, (x, y, -0.1 * c), (a * 0.2, b * 0.2, c * 0.7), -0.8 * mu),
            Solid(CYLINDER, (x + 0.3 * a, y, 0.1 * c), post, 0.7 * mu, 0.0, rng.uniform(-0.3, 0.3)),
        ]
    else:  # an animal
        a, c = fov * rng.uniform(0.3, 0.8), height * rng.uniform(0.7, 3.0)
        x, y = placed(a)
        b = a * rng.uniform(0.7, 1)
        bodies = [
            Solid(BALL, (x, y, 0.0), (a, b, c), mu),
            Solid(
                BALL,
                (x - 0.35 * a, y, z(0.4 * height)),
                (a * 0.25, b * 0.4, height * 0.4),
                -0.7 * mu,
            ),
            Solid(
                BALL,
                (x + 0.35 * a, y, z(0.4 * height)),
                (a * 0.25, b * 0.4, height * 0.4),
                -0.7 * mu,
            ),
            Solid(
                CYLINDER,
                (x, y - 0.6 * b, 0.0),
                (a * 0.1, a * 0.1, 0.7 * c),
                mu,
                0.0,
                rng.uniform(-0.15, 0.15),
            ),
        ]
    upright = ("round", "off-centre", "ellipse", "several", "shell", "box")
    return f"{name}, endless" if endless and not plane and name in upright else name, bodies


def _within(solid: Solid, points: Floats) -> NDArray[np.bool_]:
    """Which of some points ``(n, 3)`` in mm lie in a body."""
    matrix = np.array(solid.numbers[5:]).reshape(3, 3)
    x, y, z = ((points - np.array(solid.center)) @ matrix.T).T
    if solid.shape == BALL:
        inside: NDArray[np.bool_] = x * x + y * y + z * z <= 1.0
    elif solid.shape == CYLINDER:
        inside = (x * x + y * y <= 1.0) & (np.abs(z) <= 1.0)
    else:
        inside = np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z)) <= 1.0
    return inside


def possible(solids: list[Solid], rng: Any, points: int = 4000) -> list[Solid]:
    """The bodies, none of which takes away more than those before it have where it is, as found at
    points drawn at random: nothing attenuates less than air."""
    kept: list[Solid] = []
    for solid in solids:
        if solid.value < 0.0:
            matrix = np.array(solid.numbers[5:]).reshape(3, 3)
            cube = rng.uniform(-1.0, 1.0, (points, 3))
            at = cube @ np.linalg.inv(matrix).T + np.array(solid.center)
            at = at[_within(solid, at)]
            there = sum((s.value * _within(s, at) for s in kept), np.zeros(len(at)))
            solid = replace(solid, value=max(solid.value, -float(there.min(initial=math.inf))))
        kept.append(solid)
    return kept


# --- how it is scanned ----------------------------------------------------------------------------


def _log_uniform(rng: Any, low: float, high: float) -> float:
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def draw(seed: int, *, kind: str | None = None, readings: int = 600_000) -> Drawn:
    """A sound scan.

    Args:
        seed: each another one.
        kind: one of :data:`KINDS`; None: any.
        readings: the most.
    """
    rng = np.random.default_rng([seed, 0])
    kind = str(rng.choice(KINDS, p=(0.2, 0.25, 0.55))) if kind is None else kind
    scale = str(rng.choice(["body", "animal", "micro"], p=(0.5, 0.25, 0.25)))
    radius = {
        "body": rng.uniform(40, 200),
        "animal": rng.uniform(8, 30),
        "micro": rng.uniform(1, 8),
    }[scale]
    cell = {
        "body": _log_uniform(rng, 1, 8),
        "animal": _log_uniform(rng, 0.2, 1),
        "micro": _log_uniform(rng, 0.05, 0.4),
    }[scale]
    sod = {"body": rng.uniform(2.8, 5), "animal": rng.uniform(3, 10), "micro": rng.uniform(4, 20)}[
        scale
    ] * radius
    magnification = rng.uniform(1.3, 2.5) if scale != "micro" else rng.uniform(1.1, 6.0)
    zoom = 1.0 if kind == "parallel" else magnification
    fov = radius * rng.uniform(1.05, 1.5)
    columns = int(np.clip(2 * fov * zoom / cell, 24 if rng.random() < 0.9 else 12, 700))
    views = (
        int(_log_uniform(rng, 60, 1000))
        if rng.random() < 0.8
        else int(rng.choice([120, 180, 360, 720]))
    )
    rows = int(_log_uniform(rng, 2, 80)) if kind == "cone" else 1
    while views * rows * columns > readings:
        if rows > 12:
            rows = int(0.8 * rows)
        elif views > 120:
            views = int(0.8 * views)
        elif columns > 40:
            columns = int(0.8 * columns)
        else:
            rows, views = max(2, int(0.8 * rows)), max(60, int(0.9 * views))
    pitch = 2 * fov * zoom / columns  # as many cells as there are cover the field
    if kind != "parallel":  # of a divergent beam the border lies farther out
        pitch *= 1.0 / math.sqrt(1.0 - min(fov / sod, 0.9) ** 2)
    row_pitch = pitch * _log_uniform(rng, 0.5, 2.0)

    # The turn.
    angle = math.atan(columns * pitch / 2 / (sod * zoom))
    start = rng.uniform(-math.pi, math.pi) if rng.random() < 0.5 else 0.0
    arcs = {"turn": 2 * math.pi, "inclusive": 2 * math.pi, "over": rng.uniform(2.1, 2.6) * math.pi}
    if kind == "parallel":
        arcs |= {
            "half": math.pi,
            "half inclusive": math.pi,
            "more than half": rng.uniform(1.05, 1.6) * math.pi,
        }
        turn = str(rng.choice(list(arcs), p=(0.35, 0.05, 0.05, 0.35, 0.1, 0.1)))
    else:
        least = (math.pi + 2 * angle) * (1 + 4.0 / views)
        arcs |= {"short": min(least * rng.uniform(1.0, 1.15), 2 * math.pi * (1 - 4.0 / views))}
        turn = str(rng.choice(list(arcs), p=(0.65, 0.08, 0.07, 0.2)))
    angles = start + np.linspace(0.0, arcs[turn], views, endpoint="inclusive" in turn)
    if rng.random() < 0.2:
        angles = angles[::-1].copy()

    # The detector.
    offset = float(rng.choice([0.0, 0.25, rng.uniform(-3, 3)])) * pitch
    half = kind != "parallel" and turn == "turn" and rng.random() < 0.12
    if half:  # reaches far to one side, a little to the other
        side = rng.uniform(0.15, 0.5)
        offset = (1 - side) / 4 * columns * pitch * (1 if rng.random() < 0.5 else -1)
        columns = int(columns * (1 + side) / 2)
    detector = "curved" if kind != "parallel" and rng.random() < 0.4 else "flat"
    rightly = ["views are few", "seen in every view"]
    cut = not half and rng.random() < 0.05
    height = math.inf
    if kind == "parallel":
        g: Any = ParallelBeam(angles, columns, pitch, offset)
    elif kind == "fan":
        g = FanBeam(angles, sod, sod * zoom, columns, pitch, offset, detector)
    else:
        up = rng.choice([0.0, 0.0, 0.5, rng.uniform(-0.3, 0.3) * rows]) * row_pitch
        g = ConeBeam(
            angles,
            sod,
            sod * zoom,
            columns,
            rows,
            (row_pitch, pitch),
            (float(up), offset),
            detector,
        )

    # What all views see of the field, up to the middle of the last cell but one.
    shorter = (
        np.abs(g.column_positions[[1, -2]]).max()
        if half
        else np.abs(g.column_positions[[1, -2]]).min()
    )
    if kind == "parallel":
        fov = shorter
    else:
        fov = sod * math.sin(
            shorter / g.sdd if detector == "curved" else math.atan(shorter / g.sdd)
        )
    if kind == "cone":
        least_height = min(-g.row_positions[0], g.row_positions[-1]) + row_pitch / 2
        height = max(least_height, 0.3 * row_pitch) / zoom * (1 - fov / sod)

    # What is in it.
    water = {
        "body": rng.uniform(0.017, 0.03),
        "animal": rng.uniform(0.018, 0.06),
        "micro": rng.uniform(0.02, 0.3),
    }[scale]
    name, solids = _object(rng, fov * (rng.uniform(1.2, 1.6) if cut else 1.0), height, water)
    solids = possible(solids, np.random.default_rng([seed, 5]))
    if cut:
        rightly += [
            "the rows end inside the object",
            "no row ends in air",
            "or it reaches beyond the rows in some views",
        ]
        name += ", cut off"
    photons = _log_uniform(rng, 1e3, 1e6)
    few = g.select(slice(None, None, max(1, views // 12)))
    shone = transmissions(few, solids, subs=(1, 1, 1))
    densest = -math.log(max(float(shone.min()), 1e-300))
    most = math.log(photons / _log_uniform(rng, 5, 100))
    wanted = min(densest, most) if rng.random() < 0.6 else min(_log_uniform(rng, 0.05, 6.0), most)
    if densest > 0:
        solids = [replace(s, value=s.value * wanted / densest) for s in solids]
        water *= wanted / densest
    # Foam, wood, or stone and metal, by their attenuation over that of water. What is as light as a
    # tenth of it, or as heavy as ten times, is also water in another unit: no parts of several
    # densities.
    rng_of_density = np.random.default_rng([seed, 3])
    if rng_of_density.random() < 0.25 and not name.startswith(("several", "shell")):
        low, high = DENSITIES[int(rng_of_density.integers(len(DENSITIES)))]
        density = rng_of_density.uniform(low, high)
        name += f" of {density:.2g} times water"
        water /= density
        if density > 1.0:
            rightly.append("more than any tissue")
    if name.startswith("shell") and solids[0].value:
        filling = 1.0 + solids[1].value / solids[0].value
        inner = solids[1].radii[0] / solids[0].radii[0]
        wall = (1.0 - inner**2) / (1.0 - inner**2 + inner**2 * filling)
        if 0.05 < filling < 0.2 and wall < 0.3:  # the same within a skin
            rightly.append("is mu_water given in cm⁻¹?")
    # Thin bodies take many rays: those that miss them between two others would be another object's.
    thin = min((s.radii[2] for s in solids if s.value), default=math.inf)
    # Where a flat ball ends, the chords of two rays of a row begin so many columns apart.
    flat = max(
        (max(s.radii[:2]) / s.radii[2] for s in solids if s.value and s.shape == BALL), default=0.0
    )
    across = 1
    if kind == "cone":
        rays = max(4 * row_pitch / zoom / thin, flat * row_pitch / pitch)
        across = int(np.clip(math.ceil(rays), 2, 16))
    options: dict[str, Any] = {"subs": (3, across, 1)}
    step = abs(float(angles[1] - angles[0]))
    if rng.random() < 0.3:
        options |= {"arc": step, "subs": (3, across, 3)}
    if kind != "parallel" and rng.random() < 0.3:
        options["spot"] = pitch / max(zoom - 1.0, 0.3) * rng.uniform(0.2, 1.2)
    profile: Any = 1.0
    if rng.random() < 0.3:
        profile = np.exp(-rng.uniform(0.3, 2.0) * np.linspace(-1, 1, columns) ** 2)
        if rng.random() < 0.5:
            profile = profile * rng.uniform(0.9, 1.1, columns)
    frames = int(rng.integers(8, 40)) if rng.random() < 0.3 else 0
    noise = rng.uniform(1, 5) if rng.random() < 0.1 else 0.0
    side_mm = 1.2 * fov
    grid = VolumeGrid((24, 24), side_mm / 24)
    if kind == "cone":
        slices = int(np.clip(rows // 2, 1, 5))
        grid = VolumeGrid(
            (slices, 24, 24), (min(2 * height / max(slices, 2), side_mm / 24), *(side_mm / 24,) * 2)
        )
    shape = "" if kind == "parallel" else f", {detector}"
    text = (
        f"{kind} {scale} {name}; {views} views ({turn}), {rows}×{columns} cells of {pitch:.2g} mm, "
        f"{photons:.0f} photons, p ≤ {wanted:.2g}{shape}{', offset detector' if half else ''}"
        f"{', arc' if 'arc' in options else ''}{', spot' if 'spot' in options else ''}"
        f"{f', {frames} air frames' if frames else ''}{', electronic noise' if noise else ''}"
    )
    return Drawn(
        seed,
        kind,
        text,
        g,
        solids,
        photons,
        water,
        grid,
        profile,
        frames,
        noise,
        options,
        tuple(rightly),
    )
