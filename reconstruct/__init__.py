"""Calibrated frames and flow become a model of the moving scene (DeVRF)."""

if __name__ != "devrf.reconstruct":
    raise ImportError("import devrf.reconstruct, not reconstruct")
