"""Study spectral."""
