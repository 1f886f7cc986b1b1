"""The Gram operator of a small inset."""
