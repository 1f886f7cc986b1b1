"""CPU passes of the projector."""
