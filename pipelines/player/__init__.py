"""The player: a scene in motion as one HTML page that needs nothing else."""
