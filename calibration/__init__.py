"""Frames become cameras in one metric frame, on one clock."""

if __name__ != "devrf.calibration":
    raise ImportError("import devrf.calibration, not calibration")
