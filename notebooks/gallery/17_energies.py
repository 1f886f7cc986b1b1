"""
Weights for the energy bins
===========================
What do weights that fit the contrast make of a scan, and how much of that does the detector lose?
"""

import matplotlib.pyplot as plt
import numpy as np

import recon
from torchpcct import VolumeGrid, acquire
from torchpcct.scanner import SiliconDetector, presets
from torchpcct.scene.plaque import plaque_scene
from torchpcct.spectral import bin_weights, contrast_information, weighting_gain

lumen = ("blood_iodine", "fibrous_tissue")  # the contrast that is to be seen
behind = {"pericoronary_fat": 240.0}  # what the rays cross on their way, mm
scene, plaque = plaque_scene()
inset = VolumeGrid((2, 45, 45), 0.2, plaque.position[::-1])
scanner = presets.pcct(views=246, rows=4, mode="spectral")
scan = acquire(scene, scanner, exposure_s=2.0, seed=0, region=inset, duty=1 / 8)
weights = bin_weights(scanner, lumen, behind)  # (bins, columns)
plain = scan.weighted(np.ones_like(weights))  # weight 1: the sum of the counts
both = {"plain sum": plain, "weighted": scan.weighted(weights)}
volumes = {k: recon.reconstruct(s, inset, "fbp", kernel="soft").data for k, s in both.items()}

fig, axes = plt.subplots(1, 4, figsize=(13, 3.2), layout="constrained")
for ax, (name, hu) in zip(axes, volumes.items(), strict=False):
    top = float(hu[0].max())  # iodine is brighter in low energies
    ax.imshow(hu[0], cmap="gray", vmin=-0.3 * top, vmax=top, origin="lower")
    ax.set(title=name, xticks=[], yticks=[])
axes[2].step(scanner.detector.thresholds_kev, weights[:, 750], where="post")
axes[2].set(xlabel="recorded energy, keV", ylabel="weight", title="peak: K edge of iodine")


def information(kind, **changes):
    """Of the lumen's contrast, one ray: with the best weights, or of the plain sum."""
    detector = SiliconDetector("spectral", **changes)
    one = presets.pcct(views=1, rows=1, columns=3, detector=detector)
    return contrast_information(one, lumen, behind, kind)[1]


best = information("bins", sigma_kev=0.1)
sigmas, shares = np.array([0.1, 1.0, 1.6, 2.5, 4.0, 6.0]), np.array([0.0, 0.05, 0.1, 0.2, 0.3])
for kind, label in (("bins", "weighted"), ("sum", "plain sum")):
    by_sigma = [information(kind, sigma_kev=s) / best for s in sigmas]
    by_share = [information(kind, charge_sharing=c) / best for c in shares]
    (line,) = axes[3].plot(sigmas, by_sigma, "o-", label=f"{label}, σ in keV")
    axes[3].plot(20 * shares, by_share, "s--", color=line.get_color(), label="shared charge, 5 %")
    axes[3].annotate(f"{by_sigma[2]:.2f}", (sigmas[2], by_sigma[2]))
axes[3].set(
    xlabel="σ, keV; shared charge in 5 %", title="dose that is worth as much", ylim=(0, 1.1)
)
axes[3].legend(fontsize=7)
gain = float(weighting_gain(scanner, lumen, behind)[750])
lost = 1 - information("bins") / best
print(f"the weights are worth {gain:.2f} times the dose; a resolution of 1.6 keV costs {lost:.1%}")
