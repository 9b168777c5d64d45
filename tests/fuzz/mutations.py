"""Damage as files meet it: flipped bits, cut ends, doubled parts, and numbers that no program expects."""

from __future__ import annotations

import re
import struct

import numpy as np

NUMBERS = (
    b"nan", b"inf", b"-inf", b"1e400", b"-1", b"0", b"99999999999999999999", b"4611686018427387904", b"0x10",
    b"1e-320", b"-0.0", b"9" * 5000, b"1_0", b"1,5", b"true", b"null", b'""', b"[]", b"{}", b"%s%n%s%n",
)  # fmt: skip
TEXTS = (
    b"[" * 3000, b"{" * 3000, b'{"a":' * 3000, b"\0", b"\xff\xfe", b"\r\n\r\n", b"\x1b[2J", b"<!DOCTYPE a>",
    b"../../etc/passwd", b"a" * 5000, b"\n[a]\n[a]\n", b"=", b"#", b"''", b'"""',
)  # fmt: skip
BINARY = (
    struct.pack("<f", np.nan), struct.pack("<f", np.inf), struct.pack("<f", 2.9e9), struct.pack("<f", -1.0),
    struct.pack("<f", 347.9), struct.pack("<i", -1), struct.pack("<i", 2**31 - 1), struct.pack("<h", -1),
    struct.pack("<h", 32767), struct.pack("<h", 0), struct.pack("<q", 2**62), b"\0\0\0\0", b"\x7f",
)  # fmt: skip
VALUES = (np.nan, np.inf, -np.inf, 1e9, 1e300, 5e-324, -1.0, 0.0)
NUMBER = re.compile(rb"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?(?![\w.])")


def replaced_number(rng: np.random.Generator, content: bytes) -> bytes:
    """Return content with another value in the place of one of its numbers."""
    value = float(VALUES[int(rng.integers(len(VALUES)))])
    with np.errstate(over="ignore"):
        words = [repr(value).encode(), struct.pack("<f", np.float32(value)), struct.pack("<d", value)]
    if b"\0" not in content:
        spans = [found.span() for found in NUMBER.finditer(content)]
        start, end = spans[int(rng.integers(len(spans)))]
        return content[:start] + words[0] + content[end:]
    word = words[1 + int(rng.integers(2))]
    start = 2 * int(rng.integers(len(content) // 2))
    return (content[:start] + word + content[start + len(word) :])[: len(content)]


def mutated(rng: np.random.Generator, content: bytes, first_bytes: int | None = None) -> bytes:
    """Return damaged content.

    Args:
        first_bytes: Damage only what comes before this byte; everything if None.
    """
    head, rest = (content, b"") if first_bytes is None else (content[:first_bytes], content[first_bytes:])
    for _ in range(int(rng.integers(1, 4))):
        kinds = (_flip, _overwrite, _number, _text, _drop, _double, _swap) + ((_cut,) if not rest else ())
        head = kinds[int(rng.integers(len(kinds)))](rng, head)
    return head + rest


def _place(rng: np.random.Generator, content: bytes) -> int:
    return int(rng.integers(len(content))) if content else 0


def _flip(rng: np.random.Generator, content: bytes) -> bytes:
    at = _place(rng, content)
    return (
        content[:at]
        + bytes(b ^ (1 << int(rng.integers(8))) for b in content[at : at + 1])
        + content[at + 1 :]
    )


def _overwrite(rng: np.random.Generator, content: bytes) -> bytes:
    new = BINARY[int(rng.integers(len(BINARY)))]
    at = _place(rng, content) & ~1
    return (content[:at] + new + content[at + len(new) :])[: max(len(content), at)]


def _number(rng: np.random.Generator, content: bytes) -> bytes:
    places = list(re.finditer(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?", content))
    if not places:
        return _flip(rng, content)
    place = places[int(rng.integers(len(places)))]
    return content[: place.start()] + NUMBERS[int(rng.integers(len(NUMBERS)))] + content[place.end() :]


def _text(rng: np.random.Generator, content: bytes) -> bytes:
    at = _place(rng, content)
    return content[:at] + TEXTS[int(rng.integers(len(TEXTS)))] + content[at:]


def _drop(rng: np.random.Generator, content: bytes) -> bytes:
    at = _place(rng, content)
    return content[:at] + content[at + int(rng.integers(1, 40)) :]


def _double(rng: np.random.Generator, content: bytes) -> bytes:
    at = _place(rng, content)
    part = content[at : at + int(rng.integers(1, 200))]
    return content[:at] + part + content[at:]


def _swap(rng: np.random.Generator, content: bytes) -> bytes:
    lines = content.split(b"\n")
    a, b = rng.integers(len(lines), size=2)
    lines[int(a)], lines[int(b)] = lines[int(b)], lines[int(a)]
    return b"\n".join(lines)


def _cut(rng: np.random.Generator, content: bytes) -> bytes:
    return content[: _place(rng, content)]
