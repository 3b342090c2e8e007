// Stress of the elastic laws, and the speed of waves in them; the definitions are those of gaussian_swaying/mpm/laws.
import { largestEigenvalues, singular } from "./matrices.js";

/** @typedef {import("./matrices.js").Matrix} Matrix */

/** Laws by their number in the file, see LAWS in viewer/live_web/block.py. */
export const COROTATED = 0;
export const NEO_HOOKEAN = 1;
export const HENCKY = 2;

const LEAST = 0.05; // stretch, or volume ratio, below which logarithms are continued by their tangent
const SETTLED = 1e-10; // squared last change of Newton's iteration: the next one is below 1e-10

const U = new Float64Array(9);
const V = new Float64Array(9);
const a = new Float64Array(3);
const y = new Float64Array(3);
const two = new Float64Array(2);

const continuedLog = (/** @type {number} */ x) => (x < LEAST ? Math.log(LEAST) + (x - LEAST) / LEAST : Math.log(x));
const logSlope = (/** @type {number} */ x) => 1 / Math.max(x, LEAST);

/** Square root, continued by its tangent where it is below 0.05. */
function continuedRoot(/** @type {number} */ x) {
  const inside = Math.max(x, LEAST * LEAST);
  const root = Math.sqrt(inside);
  return root + (x - inside) / (2 * root);
}

const springPull = (/** @type {number} */ square) =>
  (continuedRoot(square) - 1) / Math.sqrt(Math.max(square, LEAST * LEAST));

/** Derivatives of the energy of a law by the principal stretches x, into `out`. */
function principal(law, x, mu, lam, out) {
  if (law === HENCKY) {
    const logs = [continuedLog(x[0]), continuedLog(x[1]), continuedLog(x[2])];
    const sum = lam * (logs[0] + logs[1] + logs[2]);
    for (let k = 0; k < 3; k++) out[k] = (2 * mu * logs[k] + sum) * logSlope(x[k]);
    return;
  }
  const least = Math.max(Math.min(mu, lam), 0);
  const total = x[0] * x[0] + x[1] * x[1] + x[2] * x[2];
  const pull = [0, 1, 2].map((k) => springPull(0.5 * (total - x[k] * x[k])));
  const whole = springPull(total / 3);
  const [all, stretch] = [pull[0] + pull[1] + pull[2], x[0] + x[1] + x[2] - 3];
  for (let k = 0; k < 3; k++) {
    const mean = (2 / 21) * (x[k] - 1) + x[k] * ((8 / 105) * (all - pull[k]) + (3 / 35) * whole);
    out[k] = 15 * least * mean + 2 * (mu - least) * (x[k] - 1) + (lam - least) * stretch;
  }
}

/** U diag(x) V^T, into `out`. */
function composed(x, out) {
  for (let i = 0; i < 9; i += 3)
    for (let k = 0; k < 3; k++)
      out[i + k] = U[i] * x[0] * V[3 * k] + U[i + 1] * x[1] * V[3 * k + 1] + U[i + 2] * x[2] * V[3 * k + 2];
}

/** The nearest rotation of a matrix whose Newton iteration ends at a reflection, into `R`. */
export function unreflected(/** @type {Matrix} */ F, R) {
  singular(F, U, a, V);
  composed([1, 1, 1], R);
}

const R = new Float64Array(9);

/** P = 2 mu (F - R) + lam (J - 1) cof F. */
function corotated(/** @type {Matrix} */ F, mu, lam, /** @type {Matrix} */ P) {
  const f0 = F[0], f1 = F[1], f2 = F[2], f3 = F[3], f4 = F[4], f5 = F[5], f6 = F[6], f7 = F[7], f8 = F[8];
  let c0 = f4 * f8 - f5 * f7, c1 = f5 * f6 - f3 * f8, c2 = f3 * f7 - f4 * f6;
  let c3 = f2 * f7 - f1 * f8, c4 = f0 * f8 - f2 * f6, c5 = f1 * f6 - f0 * f7;
  let c6 = f1 * f5 - f2 * f4, c7 = f2 * f3 - f0 * f5, c8 = f0 * f4 - f1 * f3;
  let det = f0 * c0 + f1 * c1 + f2 * c2;
  const p = lam * (det - 1);
  const k0 = p * c0, k1 = p * c1, k2 = p * c2, k3 = p * c3, k4 = p * c4, k5 = p * c5, k6 = p * c6, k7 = p * c7, k8 = p * c8;
  let x0 = f0, x1 = f1, x2 = f2, x3 = f3, x4 = f4, x5 = f5, x6 = f6, x7 = f7, x8 = f8;
  for (let step = 0; step < 8; step++) {
    const square = x0 * x0 + x1 * x1 + x2 * x2 + x3 * x3 + x4 * x4 + x5 * x5 + x6 * x6 + x7 * x7 + x8 * x8;
    const inverse = 1 / (det < 0 ? Math.min(det, -1e-9) : Math.max(det, 1e-9));
    const cofs = c0 * c0 + c1 * c1 + c2 * c2 + c3 * c3 + c4 * c4 + c5 * c5 + c6 * c6 + c7 * c7 + c8 * c8;
    const zeta = Math.sqrt(Math.sqrt((cofs * inverse * inverse) / Math.max(square, 1e-9)));
    const own = 0.5 * zeta, other = (0.5 * inverse) / zeta;
    const d0 = own * x0 + other * c0 - x0, d1 = own * x1 + other * c1 - x1, d2 = own * x2 + other * c2 - x2;
    const d3 = own * x3 + other * c3 - x3, d4 = own * x4 + other * c4 - x4, d5 = own * x5 + other * c5 - x5;
    const d6 = own * x6 + other * c6 - x6, d7 = own * x7 + other * c7 - x7, d8 = own * x8 + other * c8 - x8;
    x0 += d0, x1 += d1, x2 += d2, x3 += d3, x4 += d4, x5 += d5, x6 += d6, x7 += d7, x8 += d8;
    c0 = x4 * x8 - x5 * x7, c1 = x5 * x6 - x3 * x8, c2 = x3 * x7 - x4 * x6;
    det = x0 * c0 + x1 * c1 + x2 * c2;
    const change = d0 * d0 + d1 * d1 + d2 * d2 + d3 * d3 + d4 * d4 + d5 * d5 + d6 * d6 + d7 * d7 + d8 * d8;
    if (change < SETTLED) break;
    c3 = x2 * x7 - x1 * x8, c4 = x0 * x8 - x2 * x6, c5 = x1 * x6 - x0 * x7;
    c6 = x1 * x5 - x2 * x4, c7 = x2 * x3 - x0 * x5, c8 = x0 * x4 - x1 * x3;
  }
  if (det < 0) {
    unreflected(F, R);
    x0 = R[0], x1 = R[1], x2 = R[2], x3 = R[3], x4 = R[4], x5 = R[5], x6 = R[6], x7 = R[7], x8 = R[8];
  }
  const m = 2 * mu;
  P[0] = m * (f0 - x0) + k0, P[1] = m * (f1 - x1) + k1, P[2] = m * (f2 - x2) + k2;
  P[3] = m * (f3 - x3) + k3, P[4] = m * (f4 - x4) + k4, P[5] = m * (f5 - x5) + k5;
  P[6] = m * (f6 - x6) + k6, P[7] = m * (f7 - x7) + k7, P[8] = m * (f8 - x8) + k8;
}

/** P = mu F + (lam l - mu) l'(J) cof F. */
function neoHookean(/** @type {Matrix} */ F, mu, lam, /** @type {Matrix} */ P) {
  const f0 = F[0], f1 = F[1], f2 = F[2], f3 = F[3], f4 = F[4], f5 = F[5], f6 = F[6], f7 = F[7], f8 = F[8];
  const c0 = f4 * f8 - f5 * f7, c1 = f5 * f6 - f3 * f8, c2 = f3 * f7 - f4 * f6;
  const det = f0 * c0 + f1 * c1 + f2 * c2;
  const s = (lam * continuedLog(det) - mu) * logSlope(det);
  P[0] = mu * f0 + s * c0, P[1] = mu * f1 + s * c1, P[2] = mu * f2 + s * c2;
  P[3] = mu * f3 + s * (f2 * f7 - f1 * f8), P[4] = mu * f4 + s * (f0 * f8 - f2 * f6), P[5] = mu * f5 + s * (f1 * f6 - f0 * f7);
  P[6] = mu * f6 + s * (f1 * f5 - f2 * f4), P[7] = mu * f7 + s * (f2 * f3 - f0 * f5), P[8] = mu * f8 + s * (f0 * f4 - f1 * f3);
}

/**
 * First Piola-Kirchhoff stress [Pa].
 * @param {number} law @param {Matrix} F @param {number} mu [Pa] @param {number} lam [Pa] @param {Matrix} P gets it
 */
export function stress(law, F, mu, lam, P) {
  if (law === COROTATED) return corotated(F, mu, lam, P);
  if (law === NEO_HOOKEAN) return neoHookean(F, mu, lam, P);
  singular(F, U, a, V);
  principal(law, a, mu, lam, y);
  composed(y, P);
}

/** Second derivatives of the energies of `principal`, by differences that are exact to eight digits. */
function curvature(law, mu, lam, hessian) {
  const step = 1e-6;
  const [shifted, high, low] = [new Float64Array(3), new Float64Array(3), new Float64Array(3)];
  for (let k = 0; k < 3; k++) {
    shifted.set(a);
    shifted[k] = a[k] + step;
    principal(law, shifted, mu, lam, high);
    shifted[k] = a[k] - step;
    principal(law, shifted, mu, lam, low);
    for (let i = 0; i < 3; i++) hessian[3 * i + k] = (high[i] - low[i]) / (2 * step);
  }
}

/** The two largest squared stretches, into `two`. */
function squares(/** @type {Matrix} */ F) {
  largestEigenvalues(
    F[0] * F[0] + F[3] * F[3] + F[6] * F[6],
    F[0] * F[1] + F[3] * F[4] + F[6] * F[7],
    F[0] * F[2] + F[3] * F[5] + F[6] * F[8],
    F[1] * F[1] + F[4] * F[4] + F[7] * F[7],
    F[1] * F[2] + F[4] * F[5] + F[7] * F[8],
    F[2] * F[2] + F[5] * F[5] + F[8] * F[8],
    two,
  );
}

/** The square of the largest stretch, at least 1. @param {Matrix} F */
export function largestSquare(F) {
  squares(F);
  return Math.max(two[0], 1);
}

const H = new Float64Array(9);

/**
 * The modulus that bounds density times the square of any wave speed [Pa], never below that at rest.
 * @param {number} law @param {Matrix} F @param {number} mu @param {number} lam
 */
export function waveModulus(law, F, mu, lam) {
  const rest = 2 * mu + lam;
  if (law >= HENCKY) {
    singular(F, U, a, V);
    principal(law, a, mu, lam, y);
    curvature(law, mu, lam, H);
    let most = Math.max(rest, H[0], H[4], H[8]);
    for (const [i, k] of [[0, 1], [0, 2], [1, 2]]) {
      const twist = (y[i] + y[k]) / Math.max(a[i] + a[k], 1e-7);
      const gap = a[i] - a[k];
      const mixed = H[3 * i + k];
      const flip = Math.abs(gap) > 1e-4 ? (y[i] - y[k]) / gap : 0.5 * (H[4 * i] + H[4 * k]) - mixed;
      most = Math.max(most, twist - mixed, flip + mixed);
    }
    return most;
  }
  squares(F);
  const area = Math.max(two[0], 0) * Math.max(two[1], 0); // the largest eigenvalue of cof F^T cof F
  if (law === COROTATED) return 2 * mu + lam * Math.max(area, 1);
  const det = F[0] * (F[4] * F[8] - F[5] * F[7]) + F[1] * (F[5] * F[6] - F[3] * F[8]) + F[2] * (F[3] * F[7] - F[4] * F[6]);
  const [log, first] = [continuedLog(det), logSlope(det)];
  const second = det < LEAST ? 0 : -first * first;
  const bulk = lam * first * first + (lam * log - mu) * second;
  return Math.max(rest, mu + Math.max(bulk, 0) * area);
}
