"""A comparison of two small run folders in a real browser, opened from its file."""

from pathlib import Path
from typing import Any

import pytest
from tests.browser.pages import (
    PHONE,
    UNTRACED,
    border,
    drag,
    faults_of_structure,
    opened,
    outline,
    swipe,
    too_wide,
)
from tests.pipelines.compare_folders import write_two_runs

from devrf.pipelines.compare.command import PAGE, compare
from devrf.pipelines.console import Talk

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page about two runs."""
    folder = tmp_path_factory.mktemp("compare")
    return compare(Talk("quiet"), write_two_runs(folder), folder / "out", None).parent / PAGE


def test_opens_from_its_file_and_can_be_used_by_everybody(page: Any, comparison: Path) -> None:
    assert opened(page, comparison) == []
    assert {"Measures", "Views", "Configuration"} <= set(page.locator("h2").all_inner_texts())
    assert page.locator("#measures .chip.fail").count() > 0  # worse
    assert page.evaluate(UNTRACED) == [] and faults_of_structure(page) == []
    links = page.locator("a[href^='../']").evaluate_all("all => [...new Set(all.map(a => a.href))]")
    missing = [link for link in links if not Path(link.removeprefix("file://")).is_file()]
    assert len(links) > 5 and missing == []


def test_any_two_runs_or_the_truth_are_chosen(page: Any, comparison: Path) -> None:
    opened(page, comparison)
    slider = page.locator(".frame.on .compare").first
    assert slider.locator("img:visible").count() == 2
    assert slider.locator(".tag").all_inner_texts() == ["one", "two"]
    drag(page, slider, 0.5, 0.3)
    page.locator(".chooser select").first.select_option("true")
    assert slider.locator(".tag").all_inner_texts() == ["true", "two"]
    assert slider.locator(".under").get_attribute("alt").startswith("true")
    assert slider.locator("img:visible").count() == 2
    assert border(slider) == pytest.approx(0.3, abs=0.01)
    page.locator(".picker button").first.click()
    other = page.locator(".frame.on .compare").first
    assert other.locator(".tag").all_inner_texts() == ["true", "two"]  # of all views alike
    other.locator("input").press("ArrowRight")
    assert border(other) == pytest.approx(0.31, abs=0.011)


def test_on_a_phone_in_the_dark(browser: Any, comparison: Path) -> None:
    with browser.new_context(viewport=PHONE, has_touch=True, is_mobile=True, color_scheme="dark") as phone:
        page = phone.new_page()
        opened(page, comparison)
        assert too_wide(page) == []
        slider = page.locator(".frame.on .compare").first
        swipe(page, slider, 0.5, 0.75)
        assert border(slider) == pytest.approx(0.75, abs=0.02)


def test_on_paper_all_pictures_of_all_views_are_there(page: Any, comparison: Path) -> None:
    opened(page, comparison)
    titles = page.locator("h2").all_inner_texts()
    assert set(titles) <= set(outline(page.pdf(format="A4", outline=True, tagged=True)))
    page.emulate_media(media="print")
    sliders = page.locator(".compare").all()
    assert len(sliders) > 1
    for slider in sliders:
        boxes = [image.bounding_box() for image in slider.locator("img").all()]
        assert len(boxes) == 3 and all(
            a["x"] + a["width"] <= b["x"] + 1 for a, b in zip(boxes, boxes[1:], strict=False)
        )
