"""The browser that the other tests use draws in three dimensions."""

from typing import Any


def test_webgl_works_without_a_gpu(page: Any) -> None:
    page.set_content("<canvas id='canvas'></canvas>")
    assert page.evaluate("document.getElementById('canvas').getContext('webgl2') !== null")
