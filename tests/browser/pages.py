"""What tests of the report ask of a page that is opened from a file."""

import re
from pathlib import Path
from typing import Any

PHONE = {"width": 390, "height": 844}

# Texts with a digit that nothing leads to a file from: neither their row or line, nor a source below it in the section.
UNTRACED = r"""() => {
  const WORDS = "nav, script, style, h1, h2, thead, .lead, .picker, footer, .sub, .scale, " // constants, and
    + ".verdict > strong, summary"; // counts of what stands below
  const FILE = "a[href^='../'], a[href^='file:']", LINE = "tr, li, p, .tile, figure, .key-row, .panes, h3, h4";
  const sourced = (node) => {
    for (let box = node; box && box.tagName !== "SECTION" && box.tagName !== "HEADER"; box = box.parentElement) {
      if (box.matches(LINE) && box.querySelector(FILE)) return true;
      for (let next = box.nextElementSibling; next && !next.matches("h2, h3"); next = next.nextElementSibling)
        if (next.matches(".source, .stated") && next.querySelector(FILE)) return true;
    }
    const traced = node.closest("[data-stages]");
    return Boolean(traced && traced.querySelector(":scope > .made a"));
  };
  const out = [], walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const node = walk.currentNode.parentElement;
    if (!/\d/.test(walk.currentNode.data) || node.closest(WORDS)) continue;
    if (!sourced(node)) out.push(walk.currentNode.data.trim());
  }
  return out;
}"""


def opened(page: Any, file: Path) -> list[str]:
    """Open a page from its file; what it asks for beside itself is what is returned (data URIs apart)."""
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.on("console", lambda line: asked.append(f"console: {line.text}"))
    page.goto(file.as_uri())
    page.wait_for_load_state("networkidle")
    return [url for url in asked if not url.startswith("data:") and url != file.as_uri()]


def border(slider: Any) -> float:
    """Where the border of a slider is drawn, as a share of the pictures' width."""
    return slider.evaluate(
        "s => { const a = s.getBoundingClientRect(), b = s.querySelector('.bar').getBoundingClientRect();"
        " return (b.left + b.width / 2 - a.left) / a.width }"
    )


def drag(page: Any, slider: Any, start: float, end: float) -> None:
    """Drag with the mouse from one share of the width to another."""
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + start * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + end * box["width"], y, steps=5)
    page.mouse.up()


def swipe(page: Any, slider: Any, start: float, end: float) -> None:
    """The same with a finger."""
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    y = box["y"] + box["height"] / 2
    touch = page.context.new_cdp_session(page)

    def send(kind: str, share: float | None) -> None:
        points = [] if share is None else [{"x": box["x"] + share * box["width"], "y": y}]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    send("touchStart", start)
    for n in range(1, 6):
        send("touchMove", start + (end - start) * n / 5)
    send("touchEnd", None)


def too_wide(page: Any) -> list[str]:
    """What would make the page scroll sideways; empty where nothing does."""
    if page.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth"):
        return []
    return page.evaluate(
        "[...document.querySelectorAll('body *')].filter(e => e.getBoundingClientRect().right > innerWidth + 1"
        " && !e.closest('.scroll, nav')).map(e => e.outerHTML.slice(0, 80))"
    )


def contrast(page: Any, colour: str, ground: str) -> float:
    """Contrast of two of the page's colours (WCAG 2.2, 1.4.3)."""
    first, second = sorted((_luminance(page, name) for name in (colour, ground)), reverse=True)
    return (first + 0.05) / (second + 0.05)


def faults_of_structure(page: Any) -> list[str]:
    """Headings that skip a level, pictures without words, controls without a name."""
    levels = page.evaluate("[...document.querySelectorAll('h1, h2, h3, h4')].map(h => Number(h.tagName[1]))")
    # the first is h1
    faults = [f"h{b} after h{a}" for a, b in zip([0, *levels], levels, strict=False) if b > a + 1]
    faults += page.evaluate(
        "[...document.querySelectorAll('img')].filter(i => !i.alt).map(i => 'no alt: ' + i.outerHTML.slice(0, 40))"
    )
    faults += page.evaluate(
        "[...document.querySelectorAll('svg, input, button, video')].filter(e => !(e.ariaLabel ||"
        " e.textContent.trim() || e.closest('label'))).map(e => 'no name: ' + e.outerHTML.slice(0, 60))"
    )
    return faults


def outline(pdf: bytes) -> list[str]:
    """Titles of the headings in a PDF that Chromium printed with its outline."""
    titles = re.findall(rb"/Title\s*(?:\(((?:\\.|[^\\)])*)\)|<([0-9A-Fa-f]+)>)", pdf)
    return [_pdf_text(plain, coded) for plain, coded in titles]


def _pdf_text(plain: bytes, coded: bytes) -> str:
    data = bytes.fromhex(coded.decode()) if coded else re.sub(rb"\\(.)", rb"\1", plain)
    return data[2:].decode("utf-16-be") if data.startswith(b"\xfe\xff") else data.decode("latin-1")


def _luminance(page: Any, name: str) -> float:
    value = page.evaluate(
        "n => getComputedStyle(document.documentElement).getPropertyValue(n).trim()", name
    ).lstrip("#")
    channels = [int(value[n : n + 2], 16) / 255 for n in (0, 2, 4)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
