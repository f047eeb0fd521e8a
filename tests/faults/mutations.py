"""Damage to files, decided by a generator of random numbers: what transfers, cards and strangers do to them."""

import json
import re
from collections.abc import Callable

import numpy as np

Mutation = Callable[[bytes, np.random.Generator], bytes]

WORDS_32 = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
FRONT = 4096  # bytes in which headers are
NUMBERS = (
    "0", "-1", "1e308", "-1e308", "1e-320", "NaN", "Infinity", "null", "true", '"text"', "[]", "{}", "9" * 400,
    "1" * 5000, "2147483648", "18446744073709551616", "0.5", "[[[[1]]]]", "",
)  # fmt: skip


def flips(data: bytes, rng: np.random.Generator) -> bytes:
    """Up to 64 bits turned anywhere."""
    out = bytearray(data)
    for at in rng.integers(0, len(out), int(rng.integers(1, 65))):
        out[at] ^= 1 << int(rng.integers(8))
    return bytes(out)


def front(data: bytes, rng: np.random.Generator) -> bytes:
    """Up to eight bytes of the header replaced."""
    out = bytearray(data)
    for at in rng.integers(0, min(FRONT, len(out)), int(rng.integers(1, 9))):
        out[at] = int(rng.integers(256))
    return bytes(out)


def word(data: bytes, rng: np.random.Generator) -> bytes:
    """A count or a size, which headers and indexes are made of, becomes an extreme one."""
    out = bytearray(data)
    reach = min(FRONT, len(out)) if rng.random() < 0.7 else len(out)
    at = int(rng.integers(0, max(1, reach - 4)))
    value = int(rng.choice(WORDS_32))
    out[at : at + 4] = value.to_bytes(4, "big" if rng.random() < 0.5 else "little")
    return bytes(out)


def truncated(data: bytes, rng: np.random.Generator) -> bytes:
    """The copy was cut short."""
    return data[: int(rng.integers(0, len(data)))]


def zeroed(data: bytes, rng: np.random.Generator) -> bytes:
    """A block was never written."""
    start = int(rng.integers(0, len(data)))
    length = int(rng.integers(1, max(2, len(data) // 4)))
    return data[:start] + bytes(min(length, len(data) - start)) + data[start + length :]


def inserted(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes that do not belong there."""
    at = int(rng.integers(0, len(data) + 1))
    return data[:at] + rng.bytes(int(rng.integers(1, 600))) + data[at:]


def removed(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes that are gone."""
    at = int(rng.integers(0, len(data)))
    return data[:at] + data[at + int(rng.integers(1, 600)) :]


def repeated(data: bytes, rng: np.random.Generator) -> bytes:
    """A block that stands twice."""
    at, length = int(rng.integers(0, len(data))), int(rng.integers(1, 2000))
    return data[:at] + data[at : at + length] + data[at:]


def headless(data: bytes, rng: np.random.Generator) -> bytes:
    """The beginning of another kind of file."""
    heads = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0\x00\x10JFIF", b"PK\x03\x04", b"RIFF\xff\xff\xff\xffAVI ",
             b"II*\0", b"\x00\x00\x00\x18ftypmp42", b"%!PS-Adobe-3.0 EPSF-3.0\n", b"<?xml version='1.0'?>",
             b"\x93NUMPY\x01\x00", b"\x80\x04.", b"%YAML:1.0\n", b"\xef\xbb\xbf", b"BM", b"#!/bin/sh\n")  # fmt: skip
    head = heads[int(rng.integers(len(heads)))]
    return head + data[len(head) :]


def number(data: bytes, rng: np.random.Generator) -> bytes:
    """A number of a text becomes another, or none."""
    text = data.decode("utf-8", "surrogateescape")
    found = list(re.finditer(r"-?\d+(\.\d+)?([eE][-+]?\d+)?", text))
    if not found:
        return flips(data, rng)
    at = found[int(rng.integers(len(found)))]
    new = NUMBERS[int(rng.integers(len(NUMBERS)))]
    return (text[: at.start()] + new + text[at.end() :]).encode("utf-8", "surrogateescape")


def line(data: bytes, rng: np.random.Generator) -> bytes:
    """A line is gone, stands twice, or elsewhere."""
    lines = data.splitlines(keepends=True)
    at, kind = int(rng.integers(len(lines))), int(rng.integers(3))
    taken = [lines[at]] if kind == 1 else [lines.pop(at)]
    place = int(rng.integers(len(lines) + 1))
    return b"".join([*lines[:place], *(taken if kind else []), *lines[place:]])


def value(data: bytes, rng: np.random.Generator) -> bytes:
    """A value of a JSON file becomes another, or is gone."""
    tree = json.loads(data)
    here, trail = tree, []
    while isinstance(here, dict | list) and here:
        keys = list(here) if isinstance(here, dict) else list(range(len(here)))
        trail.append((here, keys[int(rng.integers(len(keys)))]))
        here = here[trail[-1][1]]
        if rng.random() < 0.25:
            break
    place, key = trail[-1]
    new = NUMBERS[int(rng.integers(len(NUMBERS) - 1))]
    if rng.random() < 0.2:
        del place[key]
    else:
        place[key] = "\0hole\0"
    return json.dumps(tree).replace('"\\u0000hole\\u0000"', new).encode()


BINARY: tuple[Mutation, ...] = (
    flips, front, front, word, word, word, truncated, zeroed, inserted, removed, repeated, headless,
)  # fmt: skip
TEXT: tuple[Mutation, ...] = (number, number, number, line, flips, truncated, inserted, zeroed, headless)
JSON: tuple[Mutation, ...] = (value, value, value, value, *TEXT)
