"""CUDA passes of the projector."""
