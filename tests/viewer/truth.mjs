// The known labels of made shapes, and how well a collection agrees with them.

import { readFileSync } from "node:fs";
import { coseg } from "./page.mjs";

/** Area of each face of an OFF file. */
function areasOf(file) {
  const numbers = readFileSync(file, "utf8")
    .replace(/#.*/g, "")
    .trim()
    .split(/\s+/)
    .slice(1)
    .map(Number);
  const [nVertices, nFaces] = numbers;
  const point = (v) => numbers.slice(3 + 3 * v, 6 + 3 * v);
  let at = 3 + 3 * nVertices;
  return Array.from({ length: nFaces }, () => {
    const corners = numbers.slice(at + 1, at + 1 + numbers[at]).map(point);
    at += 1 + numbers[at];
    let area = 0;
    for (let i = 1; i + 1 < corners.length; i++) {
      const [u, v] = [corners[i], corners[i + 1]].map((p) => p.map((x, k) => x - corners[0][k]));
      const normal = [0, 1, 2].map(
        (k) => u[(k + 1) % 3] * v[(k + 2) % 3] - u[(k + 2) % 3] * v[(k + 1) % 3],
      );
      area += Math.hypot(...normal) / 2;
    }
    return area;
  });
}

/** What made shapes in a folder truly are. */
export class Truth {
  constructor(folder, collection) {
    this.collection = collection;
    const lines = readFileSync(`${folder}/LABEL_NAMES.txt`, "utf8").trim().split("\n");
    this.names = lines.map((line) => line.split(/\s+/).at(-1));
    this.shapes = new Map();
    for (const { name } of coseg("ls", "--collection", collection).shapes) {
      const labels = readFileSync(`${folder}/${name}.labels.txt`, "utf8")
        .trim()
        .split(/\s+/)
        .map(Number);
      this.shapes.set(name, { labels, areas: areasOf(`${folder}/${name}.off`) });
    }
  }

  /** The true name of the larger part of some faces of a shape, and its share of their area. */
  most(shape, faces) {
    const { labels, areas } = this.shapes.get(shape);
    const of = this.names.map(() => 0);
    for (const f of faces) of[labels[f]] += areas[f];
    const best = of.indexOf(Math.max(...of));
    return { name: this.names[best], share: of[best] / (of.reduce((a, b) => a + b, 0) || 1) };
  }

  /** Areas that labels share with true names: a row for each label in use. */
  overlaps(labelled) {
    const rows = new Map();
    for (const [shape, given] of labelled) {
      const { labels, areas } = this.shapes.get(shape);
      given.forEach((label, f) => {
        if (!rows.has(label))
          rows.set(
            label,
            this.names.map(() => 0),
          );
        rows.get(label)[labels[f]] += areas[f] / this.area(shape);
      });
    }
    return rows;
  }

  area(shape) {
    const of = this.shapes.get(shape);
    return (of.total ??= of.areas.reduce((a, b) => a + b, 0));
  }

  /**
   * The share of the area that has the right label, each shape counting alike. A label with a true
   * name is that; of the others, at most one stands for each name that no label has, such that the
   * share is greatest.
   */
  measure() {
    const { collection, names } = this;
    const labelled = [...this.shapes.keys()].map((shape) => [
      shape,
      coseg("labels", shape, "--collection", collection, "--no-wait").labels,
    ]);
    const rows = this.overlaps(labelled);
    const named = new Map(
      coseg("show", "--collection", collection).labels.map((l) => [l.id, l.name]),
    );
    let sum = 0;
    let taken = 0;
    const free = [];
    for (const [label, row] of rows) {
      const at = names.indexOf(named.get(label));
      if (at >= 0) [sum, taken] = [sum + row[at], taken | (1 << at)];
      else free.push(row);
    }
    // The best for each set of names that are taken.
    let best = new Map([[taken, 0]]);
    for (const row of free) {
      const next = new Map(best);
      for (const [set, value] of best)
        row.forEach((share, at) => {
          const with1 = set | (1 << at);
          if (with1 !== set) next.set(with1, Math.max(next.get(with1) ?? 0, value + share));
        });
      best = next;
    }
    return { accuracy: (sum + Math.max(...best.values())) / this.shapes.size, rows, named };
  }
}
