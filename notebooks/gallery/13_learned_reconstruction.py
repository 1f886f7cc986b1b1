"""
Gradients through the scanner
=============================
Can a reconstruction be learned through the projector? (The smallest one: the filter of filtered
backprojection.)
"""

import matplotlib.pyplot as plt
import torch

from torchpcct import FanBeam, Projector, VolumeGrid, full_turn

A = Projector(FanBeam(full_turn(120), 400.0, 800.0, 129, 2.0), VolumeGrid((64, 64), 2.0))
y, x = (torch.as_tensor(a, dtype=torch.float32) for a in A.grid.axes)
middle = torch.rand(40, 2, 1, 1, generator=torch.manual_seed(0)) * 40 - 20
# a disc in each of 40 images
truth = 0.02 * (torch.hypot(x - middle[:, 0], y[:, None] - middle[:, 1]) < 20).float()
data, f = A(truth) + 0.05 * torch.randn(40, *A.range_shape), torch.fft.rfftfreq(256)
# what is learned: a window on the ramp, at ten frequencies
points = torch.full((1, 1, 10), 0.3).requires_grad_()
optimiser, errors = torch.optim.Adam([points], 0.02), []


def reconstruct(sinograms):
    window = torch.nn.functional.interpolate(points, f.numel(), mode="linear", align_corners=True)[
        0, 0
    ]
    return A.T(
        torch.fft.irfft(torch.fft.rfft(sinograms, 256) * (f + 0.002) * window)[..., :129] / 120
    ), window


for _ in range(150):
    k = torch.randint(39, (4,))
    error = (reconstruct(data[k])[0] - truth[k]) * 50000  # HU; autograd goes through Aᵀ
    optimiser.zero_grad()
    error.square().mean().backward()
    optimiser.step()
    errors.append(float(error.detach().square().mean().sqrt()))
fig, axes = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")
volume, window = (t.detach() for t in reconstruct(data[-1]))
axes[0].plot(f, f * window)
axes[0].set(xlabel="frequency, cycles per column", ylabel="learned filter")
shown = axes[1].imshow(
    volume * 50000 - 1000, cmap="gray", extent=(-64, 64) * 2, vmin=-1000, vmax=300
)
axes[1].set(title="a disc that was not trained on", xlabel="x, mm", ylabel="y, mm")
fig.colorbar(shown, ax=axes[1], label="HU")
print(f"error: {errors[0]:.0f} HU before, {errors[-1]:.0f} HU after 150 steps")
