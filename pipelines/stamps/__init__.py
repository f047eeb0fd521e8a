"""What made a stage, and whether that is still so."""
