"""The learned reconstruction."""
