"""Filtered backprojection."""
