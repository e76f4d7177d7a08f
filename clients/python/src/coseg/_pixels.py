"""Pictures as arrays, their colours, and PNG; without the native module."""

from __future__ import annotations

import base64
import html as escaping
import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

#: Of labels; Okabe and Ito 2008, told apart by everybody.
PALETTE = np.array(
    [
        (0, 114, 178),
        (230, 159, 0),
        (0, 158, 115),
        (204, 121, 167),
        (86, 180, 233),
        (213, 94, 0),
        (240, 228, 66),
        (120, 120, 120),
    ]
)
#: Of numbers: five colours of viridis, interpolated.
RAMP = np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)])
#: Where there is no number and no label.
NOTHING = (150, 150, 150)


@dataclass(frozen=True, eq=False)
class Picture:
    """An RGB picture (height, width, 3) that Jupyter shows."""

    pixels: NDArray[np.uint8]

    @property
    def png(self) -> bytes:
        """As a PNG file."""
        height, width, _ = self.pixels.shape
        rows = np.zeros((height, 1 + 3 * width), np.uint8)
        rows[:, 1:] = self.pixels.reshape(height, -1)

        def chunk(kind: bytes, data: bytes) -> bytes:
            check = zlib.crc32(kind + data)
            return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", check)

        header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
        body = chunk(b"IDAT", zlib.compress(rows.tobytes(), 6))
        return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + body + chunk(b"IEND", b"")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a PNG file."""
        Path(path).write_bytes(self.png)

    def html(self, caption: str) -> str:
        """As HTML that needs no other file."""
        data = base64.b64encode(self.png).decode()
        image = f'<img src="data:image/png;base64,{data}" alt="{escaping.escape(caption)}">'
        return f"<div>{image}<br><code>{escaping.escape(caption)}</code></div>"

    def _repr_png_(self) -> bytes:
        return self.png

    def __repr__(self) -> str:
        return f"Picture({self.pixels.shape[1]} x {self.pixels.shape[0]})"


def ramp(numbers: Doubles) -> Doubles:
    """Colours (n, 3), 0 to 255, of numbers (n,) from the least to the greatest."""
    known = np.isfinite(numbers)
    low, high = (numbers[known].min(), numbers[known].max()) if known.any() else (0.0, 1.0)
    at = (np.where(known, numbers, low) - low) / max(high - low, 1e-300) * (len(RAMP) - 1)
    below = np.minimum(at.astype(np.int64), len(RAMP) - 2)
    share = (at - below)[:, None]
    found: Doubles = (1 - share) * RAMP[below] + share * RAMP[below + 1]
    found[~known] = NOTHING
    return found
