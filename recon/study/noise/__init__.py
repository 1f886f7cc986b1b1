"""Study noise."""
