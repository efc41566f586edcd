// Rotations of many Gaussians at once, component by component, and rotations of clusters.

/** Rotates in place: rotations [4, N], and factors [9, N] if given, by the rotations with vectors 2 tan(θ/2). */
export function turnBy(vectors, step, rotations, factors) {
  const [vx, vy, vz] = vectors;
  const count = vx.length;
  for (let i = 0; i < count; i++) {
    let [x, y, z] = [vx[i] * step / 2, vy[i] * step / 2, vz[i] * step / 2];
    if (x === 0 && y === 0 && z === 0) continue;
    const w = 1 / Math.sqrt(1 + x * x + y * y + z * z);
    x *= w;
    y *= w;
    z *= w;
    if (factors) turnColumns(factors, count, i, w, x, y, z);
    const [a, b, c, d] = [rotations[i], rotations[count + i], rotations[2 * count + i], rotations[3 * count + i]];
    const found = [w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c, w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a];
    const length = Math.sqrt(found[0] * found[0] + found[1] * found[1] + found[2] * found[2] + found[3] * found[3]);
    for (let k = 0; k < 4; k++) rotations[k * count + i] = found[k] / length;
  }
}

function turnColumns(factors, count, i, w, x, y, z) {
  const m = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
    2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
  for (let k = 0; k < 3; k++) {
    const [p, q, r] = [k * count + i, (3 + k) * count + i, (6 + k) * count + i];
    const [a, b, c] = [factors[p], factors[q], factors[r]];
    factors[p] = m[0] * a + m[1] * b + m[2] * c;
    factors[q] = m[3] * a + m[4] * b + m[5] * c;
    factors[r] = m[6] * a + m[7] * b + m[8] * c;
  }
}

/** Quaternion (w, x, y, z), w ≥ 0, of the rotation closest to a row-major matrix [9]: the dominant eigenvector of Horn's matrix. */
export function nearestTurn(m) {
  const t = [
    [m[0] + m[4] + m[8], m[7] - m[5], m[2] - m[6], m[3] - m[1]],
    [m[7] - m[5], m[0] - m[4] - m[8], m[1] + m[3], m[2] + m[6]],
    [m[2] - m[6], m[1] + m[3], m[4] - m[0] - m[8], m[5] + m[7]],
    [m[3] - m[1], m[2] + m[6], m[5] + m[7], m[8] - m[0] - m[4]],
  ];
  const vectors = jacobi(t);
  let best = 0;
  for (let k = 1; k < 4; k++) if (t[k][k] > t[best][best]) best = k;
  const found = vectors.map((row) => row[best]);
  const first = found.find((value) => Math.abs(value) > 1e-9) ?? 1;
  return first < 0 ? found.map((value) => -value) : found;
}

/** Diagonalizes a symmetric 4×4 matrix in place and returns its eigenvectors as columns. */
function jacobi(t) {
  const v = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]];
  for (let round = 0; round < 24; round++) {
    let off = 0;
    for (let p = 0; p < 3; p++) for (let q = p + 1; q < 4; q++) off += t[p][q] * t[p][q];
    if (off < 1e-26) break;
    for (let p = 0; p < 3; p++) for (let q = p + 1; q < 4; q++) {
      if (t[p][q] === 0) continue;
      const theta = (t[q][q] - t[p][p]) / (2 * t[p][q]);
      const tan = (theta < 0 ? -1 : 1) / (Math.abs(theta) + Math.sqrt(theta * theta + 1));
      const cos = 1 / Math.sqrt(tan * tan + 1);
      const sin = tan * cos;
      for (let k = 0; k < 4; k++) [t[k][p], t[k][q]] = [cos * t[k][p] - sin * t[k][q], sin * t[k][p] + cos * t[k][q]];
      for (let k = 0; k < 4; k++) [t[p][k], t[q][k]] = [cos * t[p][k] - sin * t[q][k], sin * t[p][k] + cos * t[q][k]];
      for (let k = 0; k < 4; k++) [v[k][p], v[k][q]] = [cos * v[k][p] - sin * v[k][q], sin * v[k][p] + cos * v[k][q]];
    }
  }
  return v;
}
