"""Consecutive frames become optical flow with validity."""

if __name__ != "devrf.flow":
    raise ImportError("import devrf.flow, not flow")
