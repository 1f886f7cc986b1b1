"""
Gradients through the scanner
=============================
Can a reconstruction be learned through the projector? (The smallest one: the filter of filtered backprojection.)
"""

import matplotlib.pyplot as plt
import torch

from torchpcct import FanBeam, Projector, VolumeGrid, full_turn

torch.manual_seed(0)
A = Projector(FanBeam(full_turn(120), 400.0, 800.0, 129, 2.0), VolumeGrid((64, 64), 2.0))
y, x = (torch.as_tensor(a, dtype=torch.float32) for a in A.grid.axes)
middle = torch.rand(40, 2, 1, 1) * 40 - 20
truth = 0.02 * (torch.hypot(x - middle[:, 0], y[:, None] - middle[:, 1]) < 20).float()  # a disc in each of 40 images
data = A(truth) + 0.05 * torch.randn(40, *A.range_shape)
f = torch.fft.rfftfreq(256)
window = torch.full_like(f, 0.3).requires_grad_()  # what is learned: a weight for each frequency, on the ramp filter
optimiser = torch.optim.Adam([window], 0.02)
for step in range(150):
    batch = torch.randint(39, (4,))
    filtered = torch.fft.irfft(torch.fft.rfft(data[batch], 256) * (f + 0.002) * window)[..., :129] / 120
    error = (A.T(filtered) - truth[batch]) / 0.02 * 1000  # HU; autograd goes through Aᵀ
    optimiser.zero_grad()
    error.square().mean().backward()
    optimiser.step()
    if step in (0, 149):
        print(f"step {step}: error {float(error.detach().square().mean().sqrt()):.0f} HU")
fig, axes = plt.subplots(1, 2, figsize=(8, 3.2), layout="constrained")
axes[0].plot(f, (f * window).detach())
axes[0].set(xlabel="frequency, cycles per column", ylabel="learned filter")
filtered = torch.fft.irfft(torch.fft.rfft(data[-1], 256) * (f + 0.002) * window)[..., :129] / 120
shown = axes[1].imshow(A.T(filtered).detach() * 50000 - 1000, cmap="gray", extent=(-64, 64) * 2, vmin=-1000, vmax=300)
axes[1].set(title="a disc that was not trained on", xlabel="x, mm", ylabel="y, mm")
fig.colorbar(shown, ax=axes[1], label="HU")
