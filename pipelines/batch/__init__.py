"""`batch`: many scenes side by side, on this machine or on a Ray cluster, with one summary."""
