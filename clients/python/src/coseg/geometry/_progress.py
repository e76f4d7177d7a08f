"""Progress of long calls: a bar, or a function of the caller's."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

#: ``True``: a bar (of tqdm, if it is installed). A function gets stage, done, expected.
Progress = bool | Callable[[str, int, int], None] | None


def reporter(progress: Progress) -> Callable[[str, int, int], None] | None:
    """What the native module calls, in the calling thread."""
    if progress is True:
        return _bar()
    return progress or None


def _bar() -> Callable[[str, int, int], None]:
    try:
        from tqdm.auto import tqdm
    except ImportError:
        return _line
    bar: Any = tqdm(desc="coseg", leave=False)

    def update(stage: str, done: int, expected: int) -> None:
        bar.set_description(stage, refresh=False)
        bar.total, bar.n = expected or None, done
        bar.refresh()

    return update


def _line(stage: str, done: int, expected: int) -> None:
    counts = f" {done}/{expected}" if expected else ""
    print(f"\r{stage}{counts}\x1b[K", end="", file=sys.stderr, flush=True)
