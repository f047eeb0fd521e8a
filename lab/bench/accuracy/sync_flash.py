"""`bench sync`, light: flashes in clips of rolling shutters of unknown readout, read back by ingest."""

import numpy as np

from devrf.calibration.clocks.flash import Brightness, find_flashes, flash_delay
from devrf.capture.ingest.extract_clip import Keep, extract_clip
from devrf.lab.bench.accuracy.cases import Cases
from devrf.lab.bench.bench_rows import Row
from devrf.lab.simulate.session.flash import RollingShutter, film_flashes

SEEDS = 12
SECONDS = 4.0
FLASHES = 4
ANCHOR_MS = 0.5
ANCHOR = "Šmíd & Matas, VISAPP 2017: 0.3 to 0.5 ms over 5 minutes of real clips with many flashes, 4 cameras"
INSIDE_GOAL = 0.9


def flash(cases: Cases) -> list[Row]:
    """Error, and how often the stated doubt covers it."""
    folder = cases.folder("flash")
    errors_ms, inside = [], []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        offset_s = float(rng.uniform(-0.3, 0.3))
        flashes_s = np.sort(rng.uniform(0.5, SECONDS - 0.6, FLASHES)).tolist()
        seen = []
        for k, start_s in enumerate((0.0, offset_s)):
            readout_s = float(rng.uniform(0.012, 0.03))
            camera = RollingShutter(start_s, readout_s=readout_s, exposure_s=0.022, seconds=SECONDS)
            path = folder / f"{seed}_{k}.mp4"
            film_flashes(path, camera, flashes_s, seed=seed + 100 * k)
            course = extract_clip(path, folder, path.stem, "camera", path.name, Keep()).courses.brightness
            seen.append(find_flashes(Brightness(course[:, 0], course[:, 1:])))
        found = flash_delay(*seen)
        if found is not None and found.accepted:
            errors_ms.append(1e3 * abs(found.delay_s - offset_s))
            inside.append(abs(found.delay_s - offset_s) < 2 * found.std_s)
    name = f"sync/flash, {FLASHES} flashes, readout unknown"
    middle, share = (float(of(v)) if v else None for of, v in ((np.median, errors_ms), (np.mean, inside)))
    return [
        Row(f"{name}, median", middle, "ms", anchor=ANCHOR_MS, source=ANCHOR),
        Row(f"{name}, largest", max(errors_ms, default=None), "ms", anchor=ANCHOR_MS, source=ANCHOR),
        Row(f"{name}, refused of {SEEDS}", float(SEEDS - len(errors_ms)), ""),
        Row(f"{name}, share within two standard deviations", share, "").at_least(INSIDE_GOAL),
    ]
