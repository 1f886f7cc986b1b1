"""
Virtual monochromatic images
============================
At which energy does the plaque's core stand out most from the fibrous tissue around it?
"""

import matplotlib.pyplot as plt
import numpy as np
import torch

from torchpcct.scanner import presets
from torchpcct.spectral import SpectralModel, cramer_rao, pe_pvc, vmi_curve

basis = pe_pvc()  # two materials, PE and PVC, stand for the attenuation at every energy
model = SpectralModel.of(presets.pcct(mode="spectral"), exposure_s=2.0, basis=basis)
# line integrals behind 24 cm of fat, mm
behind = torch.tensor(basis.coefficients("adipose") * 240.0)
# the least noise that eight energy bins allow, one ray
covariance = cramer_rao(behind, model, columns=750).numpy()
curve = vmi_curve(
    basis.coefficients("fibrous_tissue"),
    basis.coefficients("necrotic_core"),
    covariance / 100**2,
    basis,
)
fig, axes = plt.subplots(1, 2, figsize=(8, 3.4), layout="constrained")
axes[0].plot(curve.energies, np.abs(curve.contrast))
axes[0].set(
    xlabel="energy, keV", ylabel="contrast, HU", title="fibrous tissue less core", ylim=(0, None)
)
axes[1].plot(curve.energies, curve.cnr / curve.limit)
axes[1].axvline(curve.optimum_kev, color="0.6", linestyle="--")
axes[1].set(
    xlabel="energy, keV",
    ylabel="CNR over its limit",
    title="limit: the best mix of all bins",
    ylim=(0, 1.05),
)
print(f"best energy behind 24 cm of fat: {curve.optimum_kev:.0f} keV")
