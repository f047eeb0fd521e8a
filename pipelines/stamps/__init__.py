"""What made a stage, whether that is still so, and earlier results that fit."""
