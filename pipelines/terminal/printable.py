"""Text of files and names, fit for a terminal: what would steer it is shown instead."""

import re

STEERS = re.compile(  # all controls but line breaks and tabs, what turns the direction of writing, halves of characters
    "[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u200e\\u200f\\u2028-\\u202e\\u2066-\\u2069\\ud800-\\udfff]"
)


def printable(text: str) -> str:
    """A text with `\\x1b` in place of escape, and so on."""
    return STEERS.sub(lambda found: ascii(found[0])[1:-1], text)
