"""Shapes of many loose pieces with known parts, for `coseg-bench labels`: chairs of 14 boards, cars of 50 pieces.

    python3 comparisons/pieces.py pieces                       # pieces/chairs, pieces/cars; standard library only
    coseg-bench labels --data pieces --up +y

No two pieces share a vertex; they touch or overlap, as in assets that were assembled and never united.
"""

from __future__ import annotations

import math
import random
import sys
from pathlib import Path

Point = tuple[float, float, float]


class Shape:
    """Triangles with a label each."""

    def __init__(self) -> None:
        self.vertices: list[Point] = []
        self.faces: list[tuple[int, int, int]] = []
        self.labels: list[int] = []
        self.n_pieces = 0

    def piece(self, vertices: list[Point], faces: list[tuple[int, int, int]], label: int) -> None:
        first = len(self.vertices)
        self.vertices += vertices
        self.faces += [(a + first, b + first, c + first) for a, b, c in faces]
        self.labels += [label] * len(faces)
        self.n_pieces += 1

    def box(self, low: Point, high: Point, label: int, n: int = 4) -> None:
        """A box whose sides are `n` by `n` squares, each two triangles."""
        index: dict[tuple[int, int, int], int] = {}
        vertices: list[Point] = []

        def at(i: int, j: int, k: int) -> int:
            if (i, j, k) not in index:
                index[i, j, k] = len(vertices)
                t = (i / n, j / n, k / n)
                vertices.append(tuple(a + (b - a) * x for a, b, x in zip(low, high, t)))  # type: ignore[arg-type]
            return index[i, j, k]

        faces = []
        for axis in range(3):
            for side in (0, n):
                for u in range(n):
                    for v in range(n):
                        corners = []
                        for du, dv in ((0, 0), (1, 0), (1, 1), (0, 1)):
                            place = [0, 0, 0]
                            place[axis], place[(axis + 1) % 3], place[(axis + 2) % 3] = side, u + du, v + dv
                            corners.append(at(*place))
                        a, b, c, d = corners if side else corners[::-1]
                        faces += [(a, b, c), (a, c, d)]
        self.piece(vertices, faces, label)

    def disc(self, centre: Point, radius: float, width: float, label: int, n: int = 28) -> None:
        """A closed cylinder about the z axis."""
        x, y, z = centre
        rings = [(radius, -width / 2), (radius, width / 2)]
        vertices: list[Point] = [(x, y, z - width / 2), (x, y, z + width / 2)]
        for r, dz in rings:
            vertices += [
                (x + r * math.cos(2 * math.pi * i / n), y + r * math.sin(2 * math.pi * i / n), z + dz) for i in range(n)
            ]
        faces = []
        for i in range(n):
            j = (i + 1) % n
            a, b, c, d = 2 + i, 2 + j, 2 + n + j, 2 + n + i
            faces += [(a, b, c), (a, c, d), (0, b, a), (1, d, c)]
        self.piece(vertices, faces, label)

    def write(self, path: Path) -> None:
        lines = [f"OFF\n{len(self.vertices)} {len(self.faces)} 0"]
        lines += ["%.6g %.6g %.6g" % p for p in self.vertices]
        lines += ["3 %d %d %d" % f for f in self.faces]
        path.with_suffix(".off").write_text("\n".join(lines) + "\n")
        path.with_suffix(".labels.txt").write_text("\n".join(map(str, self.labels)) + "\n")


def chair(dice: random.Random) -> Shape:
    """Legs 0, seat 1, back 2, stretchers 3: fourteen boards."""
    s = Shape()
    w, d, h = dice.uniform(0.42, 0.55), dice.uniform(0.4, 0.5), dice.uniform(0.42, 0.5)
    leg, board, back = dice.uniform(0.035, 0.06), dice.uniform(0.03, 0.06), dice.uniform(0.4, 0.65)
    for x in (0.0, w - leg):
        for z in (0.0, d - leg):
            s.box((x, 0, z), (x + leg, h, z + leg), 0)
    s.box((-0.01, h, -0.01), (w + 0.01, h + board, d + 0.01), 1, 8)
    for x in (0.0, w - leg):
        s.box((x, h + board, 0), (x + leg, h + board + back, leg), 2)
    for i in range(4):
        y = h + board + back * (0.25 + 0.2 * i)
        s.box((leg * 0.8, y, leg * 0.2), (w - leg * 0.8, y + 0.1 * back, leg * 0.8), 2)
    t, y = leg * 0.5, dice.uniform(0.1, 0.18)
    for x in (leg * 0.25, w - leg * 0.75):
        s.box((x, y, leg * 0.9), (x + t, y + t, d - leg * 0.9), 3)
    s.box((leg * 0.6, y, d * 0.5), (w - leg * 0.6, y + t, d * 0.5 + t), 3)
    assert s.n_pieces == 14
    return s


def car(dice: random.Random) -> Shape:
    """Wheels 0 (tyre, hub and five bolts each), body 1 (hull, bonnet, boot, doors, sills, bumpers, lights and more),
    cabin 2 (roof, pillars, panes): fifty pieces."""
    s = Shape()
    length, width, floor = dice.uniform(3.6, 4.6), dice.uniform(1.5, 1.8), dice.uniform(0.25, 0.4)
    r, waist, roof = dice.uniform(0.28, 0.36), dice.uniform(0.6, 0.75), dice.uniform(0.5, 0.62)
    front, rear = 0.2 * length, 0.8 * length
    for x in (front, rear):
        for side in (-1, 1):
            z = side * width / 2
            s.disc((x, r, z), r, 0.2, 0)
            s.disc((x, r, z + side * 0.1), 0.6 * r, 0.05, 0, 20)
            for i in range(5):
                a = 2 * math.pi * i / 5
                s.disc((x + 0.3 * r * math.cos(a), r + 0.3 * r * math.sin(a), z + side * 0.13), 0.06 * r, 0.04, 0, 8)
    half, top = width / 2 - 0.02, floor + waist
    s.box((0, floor, -half), (length, top, half), 1, 8)
    s.box((0.02, top, -half * 0.95), (0.3 * length, top + 0.04, half * 0.95), 1)
    s.box((0.85 * length, top, -half * 0.95), (length - 0.02, top + 0.04, half * 0.95), 1)
    for side in (-1, 1):
        z = side * half
        for x in (0.33, 0.53):
            s.box((x * length, floor + 0.05, z - 0.03), ((x + 0.19) * length, top, z + 0.03), 1)
        s.box((0.3 * length, floor - 0.08, z - 0.05), (0.7 * length, floor, z + 0.05), 1)
        for x in (-0.03, length - 0.03):
            s.box((x, top - 0.2, z * 0.8 - 0.12), (x + 0.06, top - 0.08, z * 0.8 + 0.12), 1)
    s.box((-0.1, floor, -half), (0, floor + 0.2, half), 1)
    s.box((length, floor, -half), (length + 0.1, floor + 0.2, half), 1)
    x0, x1, y = 0.32 * length, 0.82 * length, top + roof
    s.box((x0 + 0.2, y, -half * 0.85), (x1 - 0.1, y + 0.05, half * 0.85), 2)
    for x in (x0 + 0.2, 0.55 * length):
        for side in (-1, 1):
            z = side * half * 0.85
            s.box((x - 0.03, top, z - 0.03), (x + 0.03, y, z + 0.03), 2)
    s.box((x0 + 0.18, top, -half * 0.8), (x0 + 0.2, y, half * 0.8), 2)
    s.box((x1 - 0.12, top, -half * 0.8), (x1 - 0.1, y, half * 0.8), 2)
    assert s.n_pieces == 50, s.n_pieces
    return s


def main() -> None:
    out = Path(sys.argv[1])
    for family, make, count in (("chairs", chair, 12), ("cars", car, 12)):
        (out / family).mkdir(parents=True, exist_ok=True)
        dice = random.Random(1)
        for i in range(count):
            make(dice).write(out / family / f"{family[:-1]}-{i + 1:03}")


if __name__ == "__main__":
    main()
