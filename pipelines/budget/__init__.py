"""What a run may use and what its stages need: memory, disk, time; estimated, handed out, watched (docs/budgets.md)."""
