// The force of the wind on the patches of a point; the definition is gaussian_swaying/wind/force.py.

/** Laws by their number in the file. */
const PAPER = 0;
const LINEAR = 2;
const CROSS_FLOW = 3;

/**
 * @typedef {object} Aero
 * @property {number} drag C_D @property {number} friction C_F @property {number} lift C_L
 * @property {number} airDensity [kg/m³] @property {number} law
 * @property {boolean} implicit drag_step is "semi_implicit"
 * @property {number} maxAreaRatio Infinity for no cap
 */

/** Adds up to a force [N] in `out` 0 to 2; 3 is the resistance of a semi-implicit drag [kg/s]. */
function terms(/** @type {Aero} */ aero, scale, area, wind, r0, r1, r2, face, across, pressed, tangent, out) {
  const square = r0 * r0 + r1 * r1 + r2 * r2;
  const speed = Math.sqrt(square);
  const blowing = aero.law === LINEAR ? Math.sqrt(wind[0] * wind[0] + wind[1] * wind[1] + wind[2] * wind[2]) : speed;
  const rub = aero.friction * speed;
  const pushed = aero.law === PAPER ? face : aero.law === CROSS_FLOW ? pressed : across;
  const push = aero.drag * (aero.law === PAPER ? square : aero.law === CROSS_FLOW ? 1 : blowing);
  const l0 = r1 * face[2] - r2 * face[1], l1 = r2 * face[0] - r0 * face[2], l2 = r0 * face[1] - r1 * face[0];
  const side = aero.lift * speed;
  out[0] = scale * (push * pushed[0] + rub * tangent[0] + side * l0);
  out[1] = scale * (push * pushed[1] + rub * tangent[1] + side * l1);
  out[2] = scale * (push * pushed[2] + rub * tangent[2] + side * l2);
  out[3] = aero.implicit
    ? 0.5 * aero.airDensity * area * (aero.drag * blowing + (aero.friction + Math.abs(aero.lift)) * speed)
    : 0;
}

const face = new Float64Array(3);
const across = new Float64Array(3);
const pressed = new Float64Array(3);
const tangent = new Float64Array(3);

/**
 * The force on the patches of a point that has several directions, see gaussian_swaying/wind/patches.py.
 * @param {Aero} aero @param {Float64Array} wind @param {number} v0 @param {number} v1 @param {number} v2 @param {Float64Array} F
 * @param {Float64Array} tensor six numbers of the sum of A N N^T for each point @param {number} at index of those of the point
 * @param {Float64Array} vectors area vectors, three numbers each @param {number} first of the point @param {number} last excluded
 * @param {Float64Array} out
 */
export function onGroup(aero, wind, v0, v1, v2, F, tensor, at, vectors, first, last, out) {
  const t00 = tensor[at], t01 = tensor[at + 1], t02 = tensor[at + 2], t11 = tensor[at + 3], t12 = tensor[at + 4], t22 = tensor[at + 5];
  const rest = t00 + t11 + t22;
  const f0 = F[0], f1 = F[1], f2 = F[2], f3 = F[3], f4 = F[4], f5 = F[5], f6 = F[6], f7 = F[7], f8 = F[8];
  const c0 = f4 * f8 - f5 * f7, c1 = f5 * f6 - f3 * f8, c2 = f3 * f7 - f4 * f6;
  const c3 = f2 * f7 - f1 * f8, c4 = f0 * f8 - f2 * f6, c5 = f1 * f6 - f0 * f7;
  const c6 = f1 * f5 - f2 * f4, c7 = f2 * f3 - f0 * f5, c8 = f0 * f4 - f1 * f3;
  const r0 = wind[0] - v0, r1 = wind[1] - v1, r2 = wind[2] - v2;
  const w0 = c0 * r0 + c3 * r1 + c6 * r2, w1 = c1 * r0 + c4 * r1 + c7 * r2, w2 = c2 * r0 + c5 * r1 + c8 * r2;
  // rows of cof(F) times the tensor
  const m0 = c0 * t00 + c1 * t01 + c2 * t02, m1 = c0 * t01 + c1 * t11 + c2 * t12, m2 = c0 * t02 + c1 * t12 + c2 * t22;
  const m3 = c3 * t00 + c4 * t01 + c5 * t02, m4 = c3 * t01 + c4 * t11 + c5 * t12, m5 = c3 * t02 + c4 * t12 + c5 * t22;
  const m6 = c6 * t00 + c7 * t01 + c8 * t02, m7 = c6 * t01 + c7 * t11 + c8 * t12, m8 = c6 * t02 + c7 * t12 + c8 * t22;
  const grown = m0 * c0 + m1 * c1 + m2 * c2 + m3 * c3 + m4 * c4 + m5 * c5 + m6 * c6 + m7 * c7 + m8 * c8;
  const growth = Math.sqrt(Math.max(grown / rest, 1e-30));
  across[0] = (m0 * w0 + m1 * w1 + m2 * w2) / growth;
  across[1] = (m3 * w0 + m4 * w1 + m5 * w2) / growth;
  across[2] = (m6 * w0 + m7 * w1 + m8 * w2) / growth;
  let s0 = 0, s1 = 0, s2 = 0, p0 = 0, p1 = 0, p2 = 0;
  for (let k = 3 * first; k < 3 * last; k += 3) {
    const b0 = vectors[k], b1 = vectors[k + 1], b2 = vectors[k + 2];
    const dot = b0 * w0 + b1 * w1 + b2 * w2;
    const sign = dot < 0 ? -1 : 1;
    s0 += sign * b0, s1 += sign * b1, s2 += sign * b2;
    if (aero.law === CROSS_FLOW) {
      const flow = (dot * Math.abs(dot)) / (b0 * b0 + b1 * b1 + b2 * b2);
      p0 += flow * b0, p1 += flow * b1, p2 += flow * b2;
    }
  }
  face[0] = c0 * s0 + c1 * s1 + c2 * s2;
  face[1] = c3 * s0 + c4 * s1 + c5 * s2;
  face[2] = c6 * s0 + c7 * s1 + c8 * s2;
  if (aero.law === CROSS_FLOW) {
    pressed[0] = (c0 * p0 + c1 * p1 + c2 * p2) / (growth * growth);
    pressed[1] = (c3 * p0 + c4 * p1 + c5 * p2) / (growth * growth);
    pressed[2] = (c6 * p0 + c7 * p1 + c8 * p2) / (growth * growth);
  }
  const whole = growth * rest;
  tangent[0] = whole * r0 - across[0], tangent[1] = whole * r1 - across[1], tangent[2] = whole * r2 - across[2];
  const cap = Math.min(aero.maxAreaRatio / growth, 1);
  terms(aero, 0.5 * aero.airDensity * cap, whole * cap, wind, r0, r1, r2, face, across, pressed, tangent, out);
}
