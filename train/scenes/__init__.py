"""Training scenes."""
