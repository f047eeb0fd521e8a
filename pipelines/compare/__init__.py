"""`devrf-pipeline compare`: several finished runs of one scene side by side."""
