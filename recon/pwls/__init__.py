"""Penalised weighted least squares."""
