"""The certificate of the unrolled reconstruction's second pass from its definition, by automatic differentiation."""

from dataclasses import replace

import torch

from recon.mbir.minimise import energy
from recon.mbir.unrolled import FLOOR


def second(net, p, u1):
    """The second pass's problem from its definition."""
    a, b = net.add_back
    w = (a + b * (p.scale_hu / 200.0).log())[:, None, None, None]
    return replace(p, beta=(1 + w) * p.beta - w * p.apply(u1))


def certificate(net, p, u1, u):
    """‖∇Φ₂(u)‖ / ‖∇Φ₂(0)‖ of the pass after u1 by automatic differentiation; S is that of the data ``p``."""
    smoothing, last = net.vessel_smoothing(p), second(net, p, u1)
    smooth = net.prior.quadratic(p.beta.shape[-3:], p.voxel_mm, p.scale_hu) + smoothing.spectrum()
    weight = p.spectrum() + smooth + net.prior.slope_bound(p.scale_hu)[:, None, None, None] + FLOOR

    def size(at):
        at = at.detach().clone().requires_grad_()
        (g,) = torch.autograd.grad(energy(net, last, at, smoothing).sum(), at)
        filtered = torch.fft.irfftn(torch.fft.rfftn(g, dim=(1, 2, 3)) / weight, s=g.shape[1:], dim=(1, 2, 3))
        return (g * filtered).sum(dim=(1, 2, 3), dtype=torch.float64).sqrt()

    return size(u) / size(torch.zeros_like(u))
