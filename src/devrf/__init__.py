"""devrf: from a field capture of a moving scene to novel views of it (DeVRF, NeurIPS 2022)."""

import os

__version__ = "0.1.0"

# OpenMP reads this once, when torch is loaded, and every way into devrf comes through this file first. Threads that
# busy-wait take five times the processor time beside another program. A value that is set already stands.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
