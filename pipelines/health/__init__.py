"""Health rows: what a stage noticed, how bad it is, what to do about it."""
