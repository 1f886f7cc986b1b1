"""Whole studies: simulate, reconstruct, measure, report."""
