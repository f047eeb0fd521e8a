"""Data sets by the paper's protocol: from all around, or from side by side."""
