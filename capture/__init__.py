"""What a capture is: raw files become frames that carry their time, cameras, and scenes on disk."""

if __name__ != "devrf.capture":
    raise ImportError("import devrf.capture, not capture")
