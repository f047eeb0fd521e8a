"""`bench ingest` in small: the same parts on shorter clips and smaller photos."""

from pathlib import Path

import pytest

from devrf.lab.bench.accuracy import ingest_speed
from devrf.lab.bench.accuracy.cases import Cases
from devrf.pipelines.terminal.console import Talk


@pytest.mark.full
def test_parts_in_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"SHORT_FRAMES": 4, "LONGER": 2, "REPETITIONS": 1, "BIT_RATES": {"16 Mbit/s": 16_000_000}}
    for name, value in (small | {"PHOTO_TILES": 1, "FEW_PHOTOS": 1, "MANY_PHOTOS": 2}).items():
        monkeypatch.setattr(ingest_speed, name, value)
    cases = Cases(None, tmp_path, Talk("quiet"))
    rows = {row.name: row for part in (ingest_speed.speed, ingest_speed.raw) for row in part(cases)}
    assert all(row.value is not None and row.value > 0 for row in rows.values())
    speed = rows["ingest/1080p, 16 Mbit/s, speed over decoding to RGB"]
    decoding, ours = (
        rows[f"ingest/1080p, 16 Mbit/s, {what}"].value for what in ("decoding to RGB", "ingest")
    )
    assert speed.goal == 0.6 and decoding and ours and speed.value == pytest.approx(ours / decoding)
    # Numpy and OpenCV are there at the least, and two photos of less than a megapixel fill no gigabyte.
    assert 50 < (rows["ingest/2 RAW photos, peak memory"].value or 0) < 1000
    assert len(list((tmp_path / "raw/ingest/frames/static").iterdir())) == 2
