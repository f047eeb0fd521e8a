"""`init`: a scene.yaml from a folder of raw files."""
