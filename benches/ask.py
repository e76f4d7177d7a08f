"""Draws accuracy over a person's time: answering questions about parts, beside labelling whole shapes.

    python3 benches/ask.py ASK.json [ASK.json ...] --out docs/images/ask.png

Every ASK.json is the output of `coseg-bench ask --json`; categories in several files are put together. The figures for
labelled shapes are those of the first table of docs/accuracy.md. A part answered counts 2 s, a whole shape 2 s for each
of its parts and 20 s for drawing boundaries, as `coseg-bench ask` counts them. Needs matplotlib, and prints what it draws.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path
from statistics import mean
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parents[1]
#: Numbers of labelled shapes in the table of docs/accuracy.md.
LABELLED = (1, 3, 5)
ROW = re.compile(r"^\| (\w+) \| \d+ \|" + r" ([0-9.]+) \([0-9.]+\) \|" * (1 + len(LABELLED)) + "$")


def whole_shapes() -> dict[str, list[float]]:
    """Accuracy by category for each number of labelled shapes, from docs/accuracy.md."""
    found: dict[str, list[float]] = {}
    for line in (ROOT / "docs" / "accuracy.md").read_text().splitlines():
        if row := ROW.match(line):
            found.setdefault(row[1], [float(x) for x in row.groups()[2:]])
    return found


def main() -> None:
    """Prints both curves and draws them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    reports: list[dict[str, Any]] = [json.loads(path.read_text()) for path in args.files]
    categories = {c["category"]: c for report in reports for c in report["categories"]}
    seconds = {n: s for report in reports for n, s in report["person_seconds"].items()}
    shapes = whole_shapes()
    both = sorted(name for name in categories if name in shapes)
    if not both:
        raise SystemExit(f"none of {sorted(categories)} is in the first table of docs/accuracy.md")
    answered = [(seconds[n], mean(categories[c]["accuracy"][n] for c in both)) for n in seconds]
    a_shape = mean(categories[c]["person_seconds_per_shape"] for c in both)
    drawn = [(n * a_shape, mean(shapes[c][i] for c in both)) for i, n in enumerate(LABELLED)]
    print(f"mean of {len(both)}: {', '.join(both)}")
    for name, curve in (("parts answered", answered), ("whole shapes", drawn)):
        print(f"{name}: " + ", ".join(f"{s:.0f} s {accuracy:.3f}" for s, accuracy in curve))
    figure, axes = plt.subplots(figsize=(6.4, 4.0))
    for name in both:
        axes.plot([seconds[n] for n in seconds], categories[name]["accuracy"].values(), color="0.85", linewidth=1)
    axes.plot(*zip(*answered, strict=True), "o-", color="C0", label="parts answered")
    axes.plot(*zip(*drawn, strict=True), "s--", color="C1", label="whole shapes labelled")
    axes.set_xlabel("seconds of a person's time")
    axes.set_ylabel("accuracy by id")
    axes.set_ylim(0, 1)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    figure.tight_layout()
    figure.savefig(args.out, dpi=120, metadata={"Software": None})


if __name__ == "__main__":
    main()
