"""Which parts `bench calibration` and `bench sync` have; each is a function from `Cases` to rows."""

from devrf.pipelines.bench.accuracy import sync_flash, sync_motion, sync_sound
from devrf.pipelines.bench.accuracy.boards import boards
from devrf.pipelines.bench.accuracy.cases import Part
from devrf.pipelines.bench.accuracy.learned_offsets import learned
from devrf.pipelines.bench.accuracy.rigs import rigs
from devrf.pipelines.bench.accuracy.sweeps import sweeps

CALIBRATION: dict[str, Part] = {
    "boards": boards,
    "sweeps": sweeps,
    "rigs": rigs,
}
SYNC: dict[str, Part] = {
    "flash": sync_flash.rows,
    "learned": learned,
    "motion": sync_motion.rows,
    "sound": sync_sound.rows,
}
