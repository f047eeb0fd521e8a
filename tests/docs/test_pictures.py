"""The pictures of the capture guide are those that their script makes, and small."""

import importlib.util
from pathlib import Path

import numpy as np
from PIL import Image
from tests.docs.pages import REPOSITORY, links

DOCS = REPOSITORY / "docs"
MOST_BYTES = 80_000


def test_the_script_makes_them(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("pictures", DOCS / "site" / "pictures.py")
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.main(tmp_path)
    made = sorted(path.name for path in tmp_path.iterdir())
    assert made == sorted(link for link in links(DOCS / "capture-guide.md") if link.startswith("guide-"))
    for name in made:
        assert (DOCS / name).stat().st_size <= MOST_BYTES, name
        with Image.open(tmp_path / name) as new, Image.open(DOCS / name) as kept:
            levels = [np.asarray(picture.convert("RGB"), np.float32) for picture in (new, kept)]
            # fonts and codecs of other machines move edges of letters, no more
            assert new.size == kept.size and np.abs(levels[0] - levels[1]).mean() < 4, name
