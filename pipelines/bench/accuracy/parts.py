"""Which parts `bench calibration` and `bench sync` have; each is a function from `Cases` to rows."""

from devrf.pipelines.bench.accuracy.cases import Part

CALIBRATION: dict[str, Part] = {}
SYNC: dict[str, Part] = {}
