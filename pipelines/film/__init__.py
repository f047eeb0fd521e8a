"""`devrf-pipeline render` with options: films of a finished run, of other paths, lengths and layers."""
