"""The report in a real browser, opened from its file: a small run folder with every artifact, and the example."""

from pathlib import Path
from typing import Any

import pytest
from tests.browser.pages import (
    PHONE,
    UNTRACED,
    border,
    contrast,
    drag,
    faults_of_structure,
    opened,
    outline,
    swipe,
    too_wide,
)
from tests.conftest import Command, ExampleRun
from tests.pipelines.report_folder import write_run

from devrf.pipelines.report.report_page import MAX_PAGE_BYTES, build_report
from devrf.pipelines.report.run_reader import RunFolder
from devrf.pipelines.stages import stage_names


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a run folder with every artifact."""
    run = tmp_path_factory.mktemp("report") / "run"
    write_run(run)
    file = run / "report/index.html"
    file.parent.mkdir()
    file.write_text(build_report(RunFolder(run, stage_names(), {}), "a scene"), encoding="utf-8")
    return file


def test_opens_from_its_file_and_asks_for_nothing(page: Any, report: Path) -> None:
    assert opened(page, report) == []
    titles = page.locator("section h2").all_inner_texts()
    assert {"Views", "Training", "Confidence"} <= set(titles)
    assert page.locator("#rig svg").first.bounding_box()["width"] > 100  # drawn


def test_the_border_follows_mouse_and_keys(page: Any, report: Path) -> None:
    opened(page, report)
    slider = page.locator(".frame.on .compare").first
    assert border(slider) == pytest.approx(0.5, abs=0.01)
    drag(page, slider, 0.5, 0.25)
    assert border(slider) == pytest.approx(0.25, abs=0.01)
    drag(page, slider, 0.9, 0.95)  # from anywhere, not only from the border
    assert border(slider) == pytest.approx(0.95, abs=0.01)
    covered = slider.locator(".over").evaluate("i => getComputedStyle(i).clipPath")
    assert "95" in covered  # the rendered picture begins at the border
    assert slider.locator("input").evaluate("i => document.activeElement === i")
    for _ in range(5):
        page.keyboard.press("ArrowLeft")
    assert border(slider) == pytest.approx(0.9, abs=0.011)
    page.keyboard.press("Home")
    assert border(slider) == pytest.approx(0.0, abs=0.001)
    assert "0 % true" in slider.locator("input").get_attribute("aria-valuetext")


def test_another_view_keeps_the_border(page: Any, report: Path) -> None:
    opened(page, report)
    views = page.locator(".views").first
    drag(page, views.locator(".frame.on .compare"), 0.5, 0.3)
    first = views.locator(".frame.on figcaption").first.inner_text()
    other = views.locator(".picker button").first
    assert other.get_attribute("aria-pressed") == "false"
    other.focus()
    page.keyboard.press("Enter")
    assert views.locator(".frame.on figcaption").first.inner_text() != first
    assert other.get_attribute("aria-pressed") == "true"
    assert border(views.locator(".frame.on .compare")) == pytest.approx(0.3, abs=0.011)


def test_on_a_phone(browser: Any, report: Path) -> None:
    """Nothing scrolls sideways but tables and the list of sections in themselves; a finger moves the border."""
    with browser.new_context(viewport=PHONE, has_touch=True, is_mobile=True) as phone:
        page = phone.new_page()
        opened(page, report)
        page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
        assert too_wide(page) == []
        slider = page.locator(".frame.on .compare").first
        swipe(page, slider, 0.5, 0.8)
        assert border(slider) == pytest.approx(0.8, abs=0.02)
        assert slider.bounding_box()["width"] > 300


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_words_can_be_read_in_light_and_dark(page: Any, report: Path, scheme: str) -> None:
    page.emulate_media(color_scheme=scheme)
    opened(page, report)
    for ink, ground in (("--ink", "--bg"), ("--muted", "--bg"), ("--muted", "--panel"), ("--link", "--bg")):
        assert contrast(page, ink, ground) >= 4.5, (ink, ground)
    for verdict in ("ok", "warn", "fail"):
        assert contrast(page, f"--{verdict}", f"--{verdict}-bg") >= 4.5, verdict
    for n in range(6):
        assert contrast(page, f"--s{n}", "--bg") >= 3, n  # lines (WCAG 1.4.11)
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(20, 23, 26)"
    assert dark == (scheme == "dark")


def test_on_paper_everything_is_there(page: Any, report: Path) -> None:
    """All sections, all views with both pictures side by side, what is folded on the screen, in light colours."""
    page.emulate_media(color_scheme="dark")
    opened(page, report)
    page.evaluate(
        "addEventListener('beforeprint', () => {"
        " window.folded = document.querySelectorAll('details:not([open])').length })"
    )
    pdf = page.pdf(format="A4", outline=True, tagged=True)
    titles = page.locator("h2").all_inner_texts()
    assert len(titles) > 8 and set(titles) <= set(outline(pdf))
    assert page.evaluate("window.folded") == 0
    page.emulate_media(media="print", color_scheme="dark")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert page.locator(".frame").count() == page.locator(".frame:visible").count() > 1
    for slider in page.locator(".compare").all():
        left, right = (slider.locator("img").nth(n).bounding_box() for n in (0, 1))
        assert left["x"] + left["width"] <= right["x"] + 1 and abs(left["width"] - right["width"]) < 2
        assert slider.locator(".over").evaluate("i => getComputedStyle(i).clipPath") == "none"
    page.set_viewport_size({"width": 690, "height": 1000})  # A4 within its margins
    assert page.evaluate("document.documentElement.scrollWidth") <= 690


def test_it_can_be_used_without_seeing_it(page: Any, report: Path) -> None:
    opened(page, report)
    assert faults_of_structure(page) == []


def test_every_number_leads_to_its_file(page: Any, report: Path) -> None:
    opened(page, report)
    assert page.evaluate(UNTRACED) == []
    links = page.locator("a[href^='../']").evaluate_all("all => [...new Set(all.map(a => a.href))]")
    missing = [link for link in links if not Path(link.removeprefix("file://").split("#")[0]).is_file()]
    assert len(links) > 15 and missing == []


def test_the_example(page: Any, whole_run: ExampleRun, devrf: Command) -> None:
    """A real run: small enough to send, nothing asked for, on a phone too; its numbers lead to their files."""
    file = whole_run.run_dir / "report/index.html"
    assert file.stat().st_size <= MAX_PAGE_BYTES
    assert opened(page, file) == []
    assert page.evaluate(UNTRACED) == [] and faults_of_structure(page) == []
    slider = page.locator(".frame.on .compare").first
    drag(page, slider, 0.5, 0.2)
    assert border(slider) == pytest.approx(0.2, abs=0.01)
    page.set_viewport_size(PHONE)
    assert too_wide(page) == []
