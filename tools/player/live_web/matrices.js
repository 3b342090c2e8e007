// 3x3 matrices as nine numbers in rows, and their principal stretches.

/** @typedef {Float64Array} Matrix Nine numbers, row by row. */

/**
 * The largest two eigenvalues of a symmetric matrix.
 * @param {number} a00 @param {number} a01 @param {number} a02 @param {number} a11 @param {number} a12 @param {number} a22
 * @param {Float64Array} out gets the largest, then the middle one
 */
export function largestEigenvalues(a00, a01, a02, a11, a12, a22, out) {
  const mean = (a00 + a11 + a22) / 3;
  const [b00, b11, b22] = [a00 - mean, a11 - mean, a22 - mean];
  const off = a01 * a01 + a02 * a02 + a12 * a12;
  const size = Math.sqrt((b00 * b00 + b11 * b11 + b22 * b22 + 2 * off) / 6);
  if (!(size > 0)) {
    out[0] = out[1] = mean;
    return;
  }
  const det = b00 * (b11 * b22 - a12 * a12) - a01 * (a01 * b22 - a12 * a02) + a02 * (a01 * a12 - b11 * a02);
  const angle = Math.acos(Math.min(1, Math.max(-1, det / (2 * size * size * size)))) / 3;
  out[0] = mean + 2 * size * Math.cos(angle);
  out[1] = mean + 2 * size * Math.cos(angle + (4 * Math.PI) / 3);
}

/**
 * F = U diag(a) V^T with rotations U and V; the stretches fall in size, and the last is negative for an inverted F.
 * @param {Matrix} F @param {Matrix} U @param {Float64Array} a three stretches @param {Matrix} V
 */
export function singular(F, U, a, V) {
  // one-sided Jacobi rotations make the columns of B = F V orthogonal
  const B = Float64Array.from(F);
  V.fill(0);
  V[0] = V[4] = V[8] = 1;
  for (let sweep = 0; sweep < 12; sweep++) {
    let worst = 0;
    for (let p = 0; p < 2; p++)
      for (let q = p + 1; q < 3; q++) {
        const alpha = B[p] * B[p] + B[3 + p] * B[3 + p] + B[6 + p] * B[6 + p];
        const beta = B[q] * B[q] + B[3 + q] * B[3 + q] + B[6 + q] * B[6 + q];
        const gamma = B[p] * B[q] + B[3 + p] * B[3 + q] + B[6 + p] * B[6 + q];
        if (!(Math.abs(gamma) > 1e-15 * Math.sqrt(alpha * beta))) continue;
        worst = 1;
        const zeta = (beta - alpha) / (2 * gamma);
        const t = (zeta < 0 ? -1 : 1) / (Math.abs(zeta) + Math.sqrt(1 + zeta * zeta));
        const c = 1 / Math.sqrt(1 + t * t);
        const s = c * t;
        for (const M of [B, V])
          for (let i = 0; i < 9; i += 3) {
            const [x, y] = [M[i + p], M[i + q]];
            M[i + p] = c * x - s * y;
            M[i + q] = s * x + c * y;
          }
      }
    if (worst === 0) break;
  }
  const size = [0, 1, 2].map((k) => Math.hypot(B[k], B[3 + k], B[6 + k]));
  const order = [0, 1, 2].sort((i, k) => size[k] - size[i]);
  const [first, second, third] = order;
  const even = (first + 1) % 3 === second; // V stays a rotation
  const own = Float64Array.from(V);
  for (let i = 0; i < 9; i += 3) {
    V[i] = own[i + first];
    V[i + 1] = own[i + second];
    V[i + 2] = even ? own[i + third] : -own[i + third];
  }
  a[0] = size[first];
  a[1] = size[second];
  let [x0, x1, x2] = a[0] > 0 ? [B[first] / a[0], B[3 + first] / a[0], B[6 + first] / a[0]] : [V[0], V[3], V[6]];
  let [y0, y1, y2] = [B[second], B[3 + second], B[6 + second]];
  if (!(a[1] > 1e-12 * a[0])) [y0, y1, y2] = Math.abs(x0) < 0.6 ? [1, 0, 0] : [0, 1, 0];
  const along = x0 * y0 + x1 * y1 + x2 * y2;
  [y0, y1, y2] = [y0 - along * x0, y1 - along * x1, y2 - along * x2];
  const length = Math.hypot(y0, y1, y2);
  [y0, y1, y2] = [y0 / length, y1 / length, y2 / length];
  const [z0, z1, z2] = [x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0];
  const sign = even ? 1 : -1;
  a[2] = sign * (z0 * B[third] + z1 * B[3 + third] + z2 * B[6 + third]);
  U.set([x0, y0, z0, x1, y1, z1, x2, y2, z2]);
}
