"""Study motion."""
