"""Time and error of the chord kernels (``pytest -n 0 -m bench -s tests/torchpcct/scene/test_speed.py``)."""

import math
import time

import numpy as np
import pytest

from torchpcct.scene.chords import chord_lengths
from torchpcct.scene.plaque import plaque_scene

pytestmark = pytest.mark.bench


def _rays(center, spread, n=4000, height=2.0):
    rng = np.random.default_rng(0)
    beta = rng.uniform(0, 2 * math.pi, n)
    o = np.stack([626 * np.cos(beta), 626 * np.sin(beta), height * rng.uniform(-1, 1, n)], axis=1)
    d = np.array(center) + rng.uniform(-1, 1, (n, 3)) * spread - o
    return o, d / np.linalg.norm(d, axis=1, keepdims=True)


def test_nanoseconds_per_body_and_ray():
    """One thread, cached rays, the kernel inlined into its caller's loop as in the simulation of a scan."""
    import numba

    from torchpcct.scene.chords import interval

    @numba.njit(fastmath={"contract", "arcp", "nsz"}, error_model="numpy")
    def loop(kinds, params, o, d):
        total = 0.0
        for n in range(o.shape[0]):
            for b in range(kinds.shape[0]):
                t0, t1 = interval(kinds[b], params[b], o[n, 0], o[n, 1], o[n, 2], d[n, 0], d[n, 1], d[n, 2])
                if t1 > t0:
                    total += t1 - t0
        return total

    scene, plaque = plaque_scene()
    kinds, params = scene.pack()
    cases = {"through the core": (0.3, 0.3, 0.5), "9 mm inset": (4.5, 4.5, 5.0), "200 mm field": (100.0, 100.0, 5.0)}
    print(f"\nns per body and ray  {'  '.join(f'{n:>8s}' for n in (*scene.names, 'mean'))}")
    for name, spread in cases.items():
        o, d = _rays(plaque.position, spread)
        chosen = [slice(k, k + 1) for k in range(len(scene))] + [slice(None)]
        best = []
        for part in chosen:
            k, p = kinds[part], params[part]
            expected = chord_lengths(scene, o, d)[part].sum()
            assert loop(k, p, o, d) == pytest.approx(expected, rel=1e-9)
            times = []
            for _ in range(40):
                start = time.perf_counter()
                loop(k, p, o, d)
                times.append(time.perf_counter() - start)
            best.append(min(times) / len(o) / len(k) * 1e9)
        print(f"{name:19s}  {'  '.join(f'{t:8.1f}' for t in best)}")
        assert best[-1] < 500
