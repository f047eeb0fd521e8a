"""A comparison of two small run folders in a real browser, opened from its file."""

from pathlib import Path
from typing import Any

import pytest
from tests.browser.pages import PHONE, faults_of_structure, opened, too_wide
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
    assert {"Measures", "Views", "What differs besides"} <= set(page.locator("h2").all_inner_texts())
    assert page.locator("#measures .chip.fail").count() > 0  # worse
    assert faults_of_structure(page) == []
    links = page.locator("a[href^='../']").evaluate_all("all => all.map(a => a.href)")
    assert len(links) == 2 and all(Path(link.removeprefix("file://")).is_file() for link in links)


def test_on_a_phone_in_the_dark(browser: Any, comparison: Path) -> None:
    with browser.new_context(viewport=PHONE, color_scheme="dark") as phone:
        page = phone.new_page()
        opened(page, comparison)
        assert too_wide(page) == []
