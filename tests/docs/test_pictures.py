"""The pictures of the capture guide and the README are those that their scripts make, and small."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tests.conftest import ExampleRun
from tests.docs.pages import REPOSITORY, links

DOCS = REPOSITORY / "docs"
MOST_BYTES = 80_000
MOST_FILM_BYTES = 3_000_000


def script_of(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, DOCS / "site" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


@pytest.mark.full
def test_the_film_of_the_readme_on_example_run(example_run: ExampleRun, tmp_path: Path) -> None:
    script_of("hero").main(example_run.run_dir, tmp_path, pictures=3)
    assert (DOCS / "film.webp").stat().st_size < MOST_FILM_BYTES
    for name in ("film.webp", "example.jpg"):
        with Image.open(tmp_path / name) as new, Image.open(DOCS / name) as kept:
            levels = [np.asarray(picture.convert("RGB"), np.float32) for picture in (new, kept)]
            assert new.size == kept.size
            # other machines train a little differently; in the film, what is rendered begins alike
            assert np.abs(levels[0] - levels[1]).mean() < 12, name


def test_the_script_makes_them(tmp_path: Path) -> None:
    script_of("pictures").main(tmp_path)
    made = sorted(path.name for path in tmp_path.iterdir())
    assert made == sorted(link for link in links(DOCS / "capture-guide.md") if link.startswith("guide-"))
    for name in made:
        assert (DOCS / name).stat().st_size <= MOST_BYTES, name
        with Image.open(tmp_path / name) as new, Image.open(DOCS / name) as kept:
            levels = [np.asarray(picture.convert("RGB"), np.float32) for picture in (new, kept)]
            # fonts and codecs of other machines move edges of letters, no more
            assert new.size == kept.size and np.abs(levels[0] - levels[1]).mean() < 4, name
