"""devrf: from a field capture of a moving scene to novel views of it (DeVRF, NeurIPS 2022)."""

__version__ = "0.1.0"
