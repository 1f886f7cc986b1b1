"""
With PyLops
===========
Do the solvers of PyLops (a library of linear operators) take a scanner of this package?
"""

import importlib.util

import matplotlib.pyplot as plt
import numpy as np

from torchpcct import FanBeam, Projector, VolumeGrid, full_turn

A = Projector(FanBeam(full_turn(60), 400.0, 800.0, 129, 2.0), VolumeGrid((64, 64), 2.0))
y, x = np.meshgrid(*A.grid.axes, indexing="ij")
truth = 0.02 * (np.hypot(x, y) < 40) + 0.01 * (np.hypot(x - 15, y) < 10)
if importlib.util.find_spec("pylops") is None:
    print('Skipped: PyLops is not installed; pip install "torchpcct[interop]" brings it.')
else:
    from pylops import Laplacian
    from pylops.optimization.leastsquares import regularized_inversion

    P = A.as_pylops(np.float64)
    data = P @ truth.ravel() + 0.02 * np.random.default_rng(0).standard_normal(P.shape[0])
    smooth = Laplacian(A.domain_shape)  # bends are penalised
    volume = regularized_inversion(P, data, [smooth], epsRs=[20.0], iter_lim=60)[0].reshape(
        A.domain_shape
    )
    error = float(np.sqrt(np.mean((volume - truth) ** 2))) / 0.02 * 1000
    plt.figure(figsize=(4.6, 3.6), layout="constrained")
    plt.imshow(
        volume * 50000 - 1000,
        cmap="gray",
        extent=(-64, 64) * 2,
        origin="lower",
        vmin=-1000,
        vmax=800,
    )
    plt.colorbar(label="HU")
    plt.gca().set(xlabel="x, mm", ylabel="y, mm", title="regularised inversion by PyLops")
    print(f"PyLops, 60 views: error {error:.0f} HU (root mean square)")
