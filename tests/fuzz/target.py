"""What a fuzzing target is, and what the targets share: cuts of a stream, values for comparing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

CORPUS = Path(__file__).parents[1] / "corpus"
SIZES = (1, 1, 1, 2, 3, 8, 31, 100, 1000, 1 << 20)
"""Bytes of a read; a stream is cut into some of these."""


@dataclass(frozen=True)
class Target:
    """One reader of foreign bytes.

    run: reads one input; raises what is a finding, and nothing for input that is refused as documented. seeds: inputs
    to begin with. covers: paths of the modules whose lines count for it. most_bytes: the longest input that is tried.
    """

    name: str
    run: Callable[[bytes], object]
    seeds: Callable[[], Iterable[bytes]]
    covers: tuple[str, ...]
    most_bytes: int = 4096

    def corpus(self) -> list[tuple[str, bytes]]:
        """Read the inputs that are kept, with their names."""
        return [(path.name, path.read_bytes()) for path in sorted((CORPUS / self.name).glob("*"))]


def chances(seed: int) -> Iterator[int]:
    """Yield numbers of 16 bits that a byte determines; cheaper than ``random.Random``."""
    state = seed * 2654435761 + 12345
    while True:
        state = (state * 6364136223846793005 + 1442695040888963407) % 2**64
        yield state >> 48


def cut(data: bytes, seed: int) -> Iterator[bytes]:
    """Cut a stream into reads that a byte determines."""
    chance, at = chances(seed), 0
    while at < len(data):
        size = SIZES[next(chance) % len(SIZES)]
        yield data[at : at + size]
        at += size


def comparable(value: Any) -> str:
    """Write a value so that equal ones are written alike: NaN equals NaN, an array its list."""
    return repr(_plain(value))


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [str(value.dtype), value.shape, value.tolist()]
    if isinstance(value, msgspec.Struct) or hasattr(value, "__dataclass_fields__"):
        names = value.__struct_fields__ if isinstance(value, msgspec.Struct) else value.__dataclass_fields__
        return [type(value).__name__, *(_plain(getattr(value, name)) for name in names)]
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, dict):
        return [(key, _plain(each)) for key, each in value.items()]
    return value


def require_same(what: str, first: object, second: object) -> None:
    """Raise AssertionError where two values differ."""
    if first != second:
        raise AssertionError(f"{what}:\n  {str(first)[:2000]}\n  {str(second)[:2000]}")
