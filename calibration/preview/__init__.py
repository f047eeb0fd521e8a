"""What a few pictures of each clip tell before a crew leaves the field; the full calibration looks at all of them."""
