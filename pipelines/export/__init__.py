"""`devrf-pipeline export`: what a run has made, in the files of other programs. `formats.py` is the table of them."""
