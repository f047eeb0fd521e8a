"""Pages from templates: every text that comes from outside is escaped there, unless it is marked as ready HTML.

A page needs no other file: styles, scripts, drawings and pictures stand in it.
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import ChainableUndefined, Environment, FileSystemLoader

from devrf.pipelines.report.run_reader import is_number
from devrf.pipelines.terminal.console import duration

FOLDER = Path(__file__).parent
MADE_BY = '<meta name="generator" content="devrf">'  # in the head of every page: what tells it from others


def render(template: str, values: Mapping[str, Any]) -> str:
    """A page, or a section of one, from a file in `templates/`."""
    return _environment().get_template(template).render(values)


def readable(value: int | float, digits: int = 2, sign: bool = False) -> str:
    """Fixed decimals; two significant digits where they would all be zero; spaces between thousands."""
    small = value != 0 and abs(value) < 0.5 * 10**-digits
    shown = f"{value:.2g}" if small else f"{value:,.{digits}f}".replace(",", "\u202f").replace("-", "\u2212")
    return f"+{shown}" if sign and value > 0 else shown


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader([FOLDER / "templates", FOLDER]),
        autoescape=True,
        undefined=ChainableUndefined,  # what a run did not measure is left out
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"readable": readable, "duration": duration}
    environment.tests |= {
        "finite": is_number,
        "whole": lambda value: is_number(value) and value == int(value),
    }
    return environment
