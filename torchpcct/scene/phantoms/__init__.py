"""Ready-made scenes beside the plaque."""
