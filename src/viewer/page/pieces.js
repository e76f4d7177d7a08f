// Finds pieces of a mesh by their labels, and colours of its vertices.

/** Returns connected pieces of equal label, with their shares of the area. */
function piecesOf(mesh) {
  const { nFaces, labels } = mesh;
  const normals = mesh.faceNormals;
  const area = (f) => Math.hypot(normals[3 * f], normals[3 * f + 1], normals[3 * f + 2]);
  const seen = new Uint8Array(nFaces);
  const pieces = [];
  let all = 0;
  for (let f = 0; f < nFaces; f++) {
    all += area(f);
    if (seen[f]) continue;
    const faces = new Set(mesh.flood(f, (g) => labels[g] === labels[f]));
    let sum = 0;
    for (const g of faces) {
      seen[g] = 1;
      sum += area(g);
    }
    pieces.push({ label: labels[f], share: sum, faces });
  }
  for (const piece of pieces) piece.share /= all || 1;
  return pieces;
}

/** Returns the colour of each vertex: that of the labels around it. */
function labelColours(mesh, app) {
  const of = new Int32Array(mesh.positions.length / 3).fill(-1);
  for (let c = 0; c < mesh.faces.length; c++) of[mesh.faces[c]] = mesh.labels[(c / 3) | 0];
  return (v) => app.colour(of[v]);
}

/** Returns the colour of each vertex by its position, so that the map's targets can be seen. */
function placeColours(mesh) {
  const p = mesh.positions;
  const low = [1, 1, 1];
  const high = [-1, -1, -1];
  for (let i = 0; i < p.length; i++) {
    low[i % 3] = Math.min(low[i % 3], p[i]);
    high[i % 3] = Math.max(high[i % 3], p[i]);
  }
  return (v) =>
    [0, 1, 2].map((i) => 40 + (205 * (p[3 * v + i] - low[i])) / (high[i] - low[i] || 1));
}
