"""Study resolution."""
