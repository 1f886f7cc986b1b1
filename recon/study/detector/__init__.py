"""Study detector."""
