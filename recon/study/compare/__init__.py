"""Study compare."""
