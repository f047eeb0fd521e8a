"""One bundle adjustment for points and boards."""
