"""Linear maps under test."""

import torch


def mismatch(forward, transpose, domain, range_, dtype=torch.float64):
    """Of two maps that should be each other's transpose: |⟨Ax, y⟩ − ⟨x, Aᵀy⟩| of random x and y,
    over their norms."""
    generator = torch.Generator().manual_seed(0)
    x, y = (torch.randn(shape, generator=generator, dtype=dtype) for shape in (domain, range_))
    Ax, Aty = forward(x), transpose(y)
    assert (Ax.shape, Ax.dtype, Aty.shape, Aty.dtype) == (y.shape, dtype, x.shape, dtype)
    Ax, Aty, x, y = (v.double() for v in (Ax, Aty, x, y))
    return float(
        abs((Ax * y).sum() - (x * Aty).sum()) / (Ax.norm() * y.norm() + x.norm() * Aty.norm())
    )
