"""Makes the blocking client from the asyncio one: the same text without the asynchronous words.

``python tools/make_sync.py`` writes the file, ``--check`` fails if it is not what would be written.
"""

import re
import sys
from pathlib import Path

SOURCE = Path(__file__).parent.parent / "src" / "coseg" / "_async_client.py"
TARGET = SOURCE.with_name("_client.py")
WORDS = [
    (r"\basync (def|for|with)\b", r"\1"),
    (r"\bawait ", ""),
    (r"\bAsync(Library|Collection|Transport|Subscription|Iterator)\b", r"\1"),
    (r"\b_async_transport\b", "_sync_transport"),
    (r"\b__a(enter|exit)__\b", r"__\1__"),
]
HEAD = '"""The client. Made from ``_async_client.py`` by ``tools/make_sync.py``: change that file."""'


def make(text: str) -> str:
    """The blocking client's text."""
    for pattern, replacement in WORDS:
        text = re.sub(pattern, replacement, text)
    _, rest = text.split("\n", 1)
    return f"{HEAD}\n{rest}"


def main() -> None:
    """Writes, or checks."""
    made = make(SOURCE.read_text())
    if "--check" in sys.argv:
        if TARGET.read_text() != made:
            raise SystemExit(f"{TARGET.name} is not what tools/make_sync.py makes of {SOURCE.name}")
    else:
        TARGET.write_text(made)


if __name__ == "__main__":
    main()
