"""Which parts `bench calibration`, `bench sync` and `bench flow` have; each is a function from `Cases` to rows."""

from devrf.pipelines.bench.accuracy import flow_pairs, sync_flash, sync_motion, sync_sound
from devrf.pipelines.bench.accuracy.boards import boards
from devrf.pipelines.bench.accuracy.cases import Part
from devrf.pipelines.bench.accuracy.colour import colour
from devrf.pipelines.bench.accuracy.rigs import rigs
from devrf.pipelines.bench.accuracy.sweeps import sweeps

CALIBRATION: dict[str, Part] = {
    "boards": boards,
    "colour": colour,
    "sweeps": sweeps,
    "rigs": rigs,
}
SYNC: dict[str, Part] = {
    "flash": sync_flash.rows,
    "motion": sync_motion.rows,
    "sound": sync_sound.rows,
}
FLOW: dict[str, Part] = {
    "accuracy": flow_pairs.accuracy,
    "speed": flow_pairs.speed,
    "store": flow_pairs.store,
}
