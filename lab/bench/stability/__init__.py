"""`bench stability`: where the pipeline breaks, one axis of damage at a time, and what it says there."""
