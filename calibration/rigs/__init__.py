"""The fixed cameras in one metric frame: by the sweep, by boards seen at once, by both, or as given."""
