"""Numbers of bytes as messages tell them."""

from __future__ import annotations

_UNITS = (("TiB", 1 << 40), ("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10))


def in_words(n: int) -> str:
    """``64 MiB`` where it is just that, ``76.3 MiB (80000000 bytes)`` where it is rounded."""
    for name, unit in _UNITS:
        if n >= unit:
            return f"{n // unit} {name}" if n % unit == 0 else f"{n / unit:.1f} {name} ({n} bytes)"
    return "1 byte" if n == 1 else f"{n} bytes"


def beyond(what: str, found: int, limit: int, key: str) -> str:
    """That something is larger than a limit, and which setting of the daemon raises that."""
    return f"{what} {in_words(found)}, the limit is {in_words(limit)} ({key} of the daemon's configuration)"
