"""What a run may use of memory, disk and time: handed out, and watched (docs/budgets.md)."""
