// The passes of solver.js over points and nodes in WebAssembly (AssemblyScript), four points of a cell at a time: the functions of the
// same names there are the definition. It knows two laws, FixedCorotated and NeoHookean, and the wind on groups of patches.

const VECTOR: usize = 16; // bytes of four numbers
const RECORD: usize = 16 * VECTOR; // of four points, see lanes.js

// laws of the aerodynamic force, see aero.js
const PAPER: i32 = 0;
const LINEAR: i32 = 2;
const CROSS_FLOW: i32 = 3;

/** Gets nine numbers F at a place in memory, and writes the nearest rotation over them. */
// @ts-ignore: decorator
@external("env", "unreflected")
declare function unreflected(at: usize): void;

// the browser's own functions
// @ts-ignore: decorator
@external("env", "log")
declare function log(x: f64): f64;
// @ts-ignore: decorator
@external("env", "cos")
declare function cos(x: f64): f64;
// @ts-ignore: decorator
@external("env", "acos")
declare function acos(x: f64): f64;

const sums = memory.data(81 * 16, 16); // of the four points of a cell, for each component of its nodes
const scratch = memory.data(9 * 4, 16);

// @ts-ignore: decorator
@inline function add(a: v128, b: v128): v128 { return f32x4.add(a, b); }
// @ts-ignore: decorator
@inline function sub(a: v128, b: v128): v128 { return f32x4.sub(a, b); }
// @ts-ignore: decorator
@inline function mul(a: v128, b: v128): v128 { return f32x4.mul(a, b); }
// @ts-ignore: decorator
@inline function mad(c: v128, a: v128, b: v128): v128 { // in one instruction, where the browser has it
  return ASC_FEATURE_RELAXED_SIMD ? f32x4.relaxed_madd(a, b, c) : f32x4.add(c, f32x4.mul(a, b));
}
// @ts-ignore: decorator
@inline function all(x: f32): v128 { return f32x4.splat(x); }
// @ts-ignore: decorator
@inline function get(at: usize, k: usize): v128 { return v128.load(at + k * VECTOR); }
// @ts-ignore: decorator
@inline function dot(a0: v128, a1: v128, a2: v128, b0: v128, b1: v128, b2: v128): v128 {
  return mad(mad(mul(a0, b0), a1, b1), a2, b2);
}
// @ts-ignore: decorator
@inline function cross(a: v128, b: v128, c: v128, d: v128): v128 { return sub(mul(a, b), mul(c, d)); }
// @ts-ignore: decorator
@inline function flip(x: v128, by: v128): v128 { // with the sign of another number: x if it is not negative
  return v128.bitselect(f32x4.neg(x), x, f32x4.lt(by, all(0)));
}
// @ts-ignore: decorator
@inline function largest(x: v128): f32 {
  const pairs = f32x4.max(x, v128.shuffle<f32>(x, x, 2, 3, 0, 1));
  return max(f32x4.extract_lane(pairs, 0), f32x4.extract_lane(pairs, 1));
}

/** First byte that is free. */
export function free(): usize {
  return __heap_base;
}

// F, the cofactors and the stress of four points
let F0: v128, F1: v128, F2: v128, F3: v128, F4: v128, F5: v128, F6: v128, F7: v128, F8: v128;
let C0: v128, C1: v128, C2: v128, C3: v128, C4: v128, C5: v128, C6: v128, C7: v128, C8: v128;
let P0: v128, P1: v128, P2: v128, P3: v128, P4: v128, P5: v128, P6: v128, P7: v128, P8: v128;
let B0: v128, B1: v128, B2: v128;

function corotated(mu: v128, lam: v128): void {
  let x0 = F0, x1 = F1, x2 = F2, x3 = F3, x4 = F4, x5 = F5, x6 = F6, x7 = F7, x8 = F8;
  let c0 = C0, c1 = C1, c2 = C2, c3 = C3, c4 = C4, c5 = C5, c6 = C6, c7 = C7, c8 = C8;
  let det = dot(x0, x1, x2, c0, c1, c2);
  const p = mul(lam, sub(det, all(1)));
  for (let step = 0; step < 6; ++step) {
    const inverse = f32x4.div(all(1), flip(f32x4.max(f32x4.abs(det), all(1e-9)), det));
    let own = all(-0.5), other = mul(all(0.5), inverse);
    const square = add(add(dot(x0, x1, x2, x0, x1, x2), dot(x3, x4, x5, x3, x4, x5)), dot(x6, x7, x8, x6, x7, x8));
    const far = v128.or(f32x4.gt(f32x4.abs(sub(square, all(3))), all(0.5)), f32x4.gt(f32x4.abs(sub(det, all(1))), all(0.3)));
    if (v128.any_true(far)) { // scaled, it converges from everywhere
      const cofs = add(add(dot(c0, c1, c2, c0, c1, c2), dot(c3, c4, c5, c3, c4, c5)), dot(c6, c7, c8, c6, c7, c8));
      const ratio = f32x4.div(mul(cofs, mul(inverse, inverse)), f32x4.max(square, all(1e-9)));
      const zeta = f32x4.sqrt(f32x4.sqrt(f32x4.max(ratio, all(1e-37))));
      own = sub(mul(all(0.5), zeta), all(1));
      other = f32x4.div(other, zeta);
    }
    const d0 = mad(mul(own, x0), other, c0), d1 = mad(mul(own, x1), other, c1), d2 = mad(mul(own, x2), other, c2);
    const d3 = mad(mul(own, x3), other, c3), d4 = mad(mul(own, x4), other, c4), d5 = mad(mul(own, x5), other, c5);
    const d6 = mad(mul(own, x6), other, c6), d7 = mad(mul(own, x7), other, c7), d8 = mad(mul(own, x8), other, c8);
    x0 = add(x0, d0), x1 = add(x1, d1), x2 = add(x2, d2);
    x3 = add(x3, d3), x4 = add(x4, d4), x5 = add(x5, d5);
    x6 = add(x6, d6), x7 = add(x7, d7), x8 = add(x8, d8);
    c0 = cross(x4, x8, x5, x7), c1 = cross(x5, x6, x3, x8), c2 = cross(x3, x7, x4, x6);
    det = dot(x0, x1, x2, c0, c1, c2);
    const change = add(add(dot(d0, d1, d2, d0, d1, d2), dot(d3, d4, d5, d3, d4, d5)), dot(d6, d7, d8, d6, d7, d8));
    if (!(largest(change) > 1e-6)) break; // the next change is below 1e-6
    c3 = cross(x2, x7, x1, x8), c4 = cross(x0, x8, x2, x6), c5 = cross(x1, x6, x0, x7);
    c6 = cross(x1, x5, x2, x4), c7 = cross(x2, x3, x0, x5), c8 = cross(x0, x4, x1, x3);
  }
  if (v128.any_true(f32x4.lt(det, all(0)))) {
    for (let lane = 0; lane < 4; ++lane) {
      if (!(lane_of(det, lane) < 0)) continue;
      store<f32>(scratch, lane_of(F0, lane)), store<f32>(scratch + 4, lane_of(F1, lane)), store<f32>(scratch + 8, lane_of(F2, lane));
      store<f32>(scratch + 12, lane_of(F3, lane)), store<f32>(scratch + 16, lane_of(F4, lane)), store<f32>(scratch + 20, lane_of(F5, lane));
      store<f32>(scratch + 24, lane_of(F6, lane)), store<f32>(scratch + 28, lane_of(F7, lane)), store<f32>(scratch + 32, lane_of(F8, lane));
      unreflected(scratch);
      x0 = with_lane(x0, lane, load<f32>(scratch)), x1 = with_lane(x1, lane, load<f32>(scratch + 4)), x2 = with_lane(x2, lane, load<f32>(scratch + 8));
      x3 = with_lane(x3, lane, load<f32>(scratch + 12)), x4 = with_lane(x4, lane, load<f32>(scratch + 16)), x5 = with_lane(x5, lane, load<f32>(scratch + 20));
      x6 = with_lane(x6, lane, load<f32>(scratch + 24)), x7 = with_lane(x7, lane, load<f32>(scratch + 28)), x8 = with_lane(x8, lane, load<f32>(scratch + 32));
    }
  }
  const m = mul(all(2), mu);
  P0 = mad(mul(p, C0), m, sub(F0, x0)), P1 = mad(mul(p, C1), m, sub(F1, x1)), P2 = mad(mul(p, C2), m, sub(F2, x2));
  P3 = mad(mul(p, C3), m, sub(F3, x3)), P4 = mad(mul(p, C4), m, sub(F4, x4)), P5 = mad(mul(p, C5), m, sub(F5, x5));
  P6 = mad(mul(p, C6), m, sub(F6, x6)), P7 = mad(mul(p, C7), m, sub(F7, x7)), P8 = mad(mul(p, C8), m, sub(F8, x8));
}

function lane_of(x: v128, lane: i32): f32 {
  if (lane == 0) return f32x4.extract_lane(x, 0);
  if (lane == 1) return f32x4.extract_lane(x, 1);
  if (lane == 2) return f32x4.extract_lane(x, 2);
  return f32x4.extract_lane(x, 3);
}

function with_lane(x: v128, lane: i32, value: f32): v128 {
  if (lane == 0) return f32x4.replace_lane(x, 0, value);
  if (lane == 1) return f32x4.replace_lane(x, 1, value);
  if (lane == 2) return f32x4.replace_lane(x, 2, value);
  return f32x4.replace_lane(x, 3, value);
}

function log_of(x: f32): f32 {
  return f32(x < 0.05 ? log(0.05) + (x - 0.05) / 0.05 : log(x));
}

function logs_of(x: v128): v128 {
  return f32x4(
    log_of(f32x4.extract_lane(x, 0)), log_of(f32x4.extract_lane(x, 1)), log_of(f32x4.extract_lane(x, 2)), log_of(f32x4.extract_lane(x, 3)),
  );
}

function neoHookean(mu: v128, lam: v128): void {
  const det = dot(F0, F1, F2, C0, C1, C2);
  const s = f32x4.div(sub(mul(lam, logs_of(det)), mu), f32x4.max(det, all(0.05)));
  P0 = mad(mul(mu, F0), s, C0), P1 = mad(mul(mu, F1), s, C1), P2 = mad(mul(mu, F2), s, C2);
  P3 = mad(mul(mu, F3), s, C3), P4 = mad(mul(mu, F4), s, C4), P5 = mad(mul(mu, F5), s, C5);
  P6 = mad(mul(mu, F6), s, C6), P7 = mad(mul(mu, F7), s, C7), P8 = mad(mul(mu, F8), s, C8);
}

/** A bound of how much an area of the material grows, squared: the largest sum of a row of cof(FᵀF) (Gershgorin). */
function largestArea(): v128 {
  const xy = f32x4.abs(dot(C0, C3, C6, C1, C4, C7)), xz = f32x4.abs(dot(C0, C3, C6, C2, C5, C8)), yz = f32x4.abs(dot(C1, C4, C7, C2, C5, C8));
  const x = dot(C0, C3, C6, C0, C3, C6), y = dot(C1, C4, C7, C1, C4, C7), z = dot(C2, C5, C8, C2, C5, C8);
  return f32x4.max(f32x4.max(add(x, add(xy, xz)), add(y, add(xy, yz))), add(z, add(xz, yz)));
}

/** As `waveModulus` in laws.js. */
function wave(law: f32, lane: i32, mu: f64, lam: f64): f64 {
  const f0: f64 = lane_of(F0, lane), f1: f64 = lane_of(F1, lane), f2: f64 = lane_of(F2, lane);
  const f3: f64 = lane_of(F3, lane), f4: f64 = lane_of(F4, lane), f5: f64 = lane_of(F5, lane);
  const f6: f64 = lane_of(F6, lane), f7: f64 = lane_of(F7, lane), f8: f64 = lane_of(F8, lane);
  const a00 = f0 * f0 + f3 * f3 + f6 * f6, a11 = f1 * f1 + f4 * f4 + f7 * f7, a22 = f2 * f2 + f5 * f5 + f8 * f8;
  const a01 = f0 * f1 + f3 * f4 + f6 * f7, a02 = f0 * f2 + f3 * f5 + f6 * f8, a12 = f1 * f2 + f4 * f5 + f7 * f8;
  const mean = (a00 + a11 + a22) / 3;
  const b00 = a00 - mean, b11 = a11 - mean, b22 = a22 - mean;
  const size = Math.sqrt((b00 * b00 + b11 * b11 + b22 * b22 + 2 * (a01 * a01 + a02 * a02 + a12 * a12)) / 6);
  let one = mean, two = mean;
  if (size > 1e-12 * mean) {
    const det = b00 * (b11 * b22 - a12 * a12) - a01 * (a01 * b22 - a12 * a02) + a02 * (a01 * a12 - b11 * a02);
    const angle = acos(min(1.0, max(-1.0, det / (2 * size * size * size)))) / 3;
    one = mean + 2 * size * cos(angle);
    two = mean + 2 * size * cos(angle + (4 * Math.PI) / 3);
  }
  const area = max(one, 0.0) * max(two, 0.0);
  if (law < 0.5) return 2 * mu + lam * max(area, 1.0);
  const J = f0 * (f4 * f8 - f5 * f7) + f1 * (f5 * f6 - f3 * f8) + f2 * (f3 * f7 - f4 * f6);
  const slope = 1 / max(J, 0.05);
  const l: f64 = log_of(f32(J));
  const bulk = lam * slope * slope - (lam * l - mu) * (J < 0.05 ? 0.0 : slope * slope);
  return max(2 * mu + lam, mu + max(bulk, 0.0) * area);
}

/** The force of the wind on the patches of four points, into B0 to B2; see `onGroup` in aero.js. */
function blow(
  at: usize, vector: usize, count: i32, u0: v128, u1: v128, u2: v128, r0: v128, r1: v128, r2: v128,
  half: f32, drag: f32, friction: f32, lift: f32, law: i32, most: f32,
): void {
  const t00 = get(at, 7), t01 = get(at, 8), t02 = get(at, 9), t11 = get(at, 10), t12 = get(at, 11), t22 = get(at, 12);
  const rest = add(add(t00, t11), t22);
  const w0 = dot(C0, C3, C6, r0, r1, r2), w1 = dot(C1, C4, C7, r0, r1, r2), w2 = dot(C2, C5, C8, r0, r1, r2);
  const m0 = dot(C0, C1, C2, t00, t01, t02), m1 = dot(C0, C1, C2, t01, t11, t12), m2 = dot(C0, C1, C2, t02, t12, t22);
  const m3 = dot(C3, C4, C5, t00, t01, t02), m4 = dot(C3, C4, C5, t01, t11, t12), m5 = dot(C3, C4, C5, t02, t12, t22);
  const m6 = dot(C6, C7, C8, t00, t01, t02), m7 = dot(C6, C7, C8, t01, t11, t12), m8 = dot(C6, C7, C8, t02, t12, t22);
  const grown = add(add(dot(m0, m1, m2, C0, C1, C2), dot(m3, m4, m5, C3, C4, C5)), dot(m6, m7, m8, C6, C7, C8));
  const growth = f32x4.sqrt(f32x4.max(f32x4.div(grown, f32x4.max(rest, all(1e-30))), all(1e-30)));
  const shrunk = f32x4.div(all(1), growth);
  const a0 = mul(dot(m0, m1, m2, w0, w1, w2), shrunk);
  const a1 = mul(dot(m3, m4, m5, w0, w1, w2), shrunk);
  const a2 = mul(dot(m6, m7, m8, w0, w1, w2), shrunk);
  let s0 = all(0), s1 = all(0), s2 = all(0), p0 = all(0), p1 = all(0), p2 = all(0);
  for (let k = 0; k < count; ++k, vector += 3 * VECTOR) {
    const b0 = get(vector, 0), b1 = get(vector, 1), b2 = get(vector, 2);
    const along = dot(b0, b1, b2, w0, w1, w2);
    const sign = v128.and(along, all(-0.0));
    s0 = add(s0, v128.xor(b0, sign)), s1 = add(s1, v128.xor(b1, sign)), s2 = add(s2, v128.xor(b2, sign));
    if (law != CROSS_FLOW) continue;
    const flow = f32x4.div(mul(along, f32x4.abs(along)), f32x4.max(dot(b0, b1, b2, b0, b1, b2), all(1e-30)));
    p0 = mad(p0, flow, b0), p1 = mad(p1, flow, b1), p2 = mad(p2, flow, b2);
  }
  const h0 = dot(C0, C1, C2, s0, s1, s2), h1 = dot(C3, C4, C5, s0, s1, s2), h2 = dot(C6, C7, C8, s0, s1, s2);
  const square = dot(r0, r1, r2, r0, r1, r2);
  const speed = f32x4.sqrt(square);
  let q0 = a0, q1 = a1, q2 = a2, push = speed; // pressure
  if (law == PAPER) {
    q0 = h0, q1 = h1, q2 = h2, push = square;
  } else if (law == LINEAR) {
    push = f32x4.sqrt(dot(u0, u1, u2, u0, u1, u2));
  } else if (law == CROSS_FLOW) {
    push = mul(shrunk, shrunk);
    q0 = dot(C0, C1, C2, p0, p1, p2), q1 = dot(C3, C4, C5, p0, p1, p2), q2 = dot(C6, C7, C8, p0, p1, p2);
  }
  push = mul(push, all(drag));
  const rub = mul(speed, all(friction));
  const whole = mul(growth, rest);
  const l0 = cross(r1, h2, r2, h1), l1 = cross(r2, h0, r0, h2), l2 = cross(r0, h1, r1, h0), side = mul(speed, all(lift));
  const scale = mul(all(half), f32x4.min(mul(all(most), shrunk), all(1)));
  B0 = mul(scale, mad(mad(mul(push, q0), rub, sub(mul(whole, r0), a0)), side, l0));
  B1 = mul(scale, mad(mad(mul(push, q1), rub, sub(mul(whole, r1), a1)), side, l1));
  B2 = mul(scale, mad(mad(mul(push, q2), rub, sub(mul(whole, r2), a2)), side, l2));
}

/**
 * The pass over all points; returns the square of the fastest wave if `looked`. See lanes.js for what lies where.
 */
export function particles(
  cells: i32, cellStart: usize, cellNodes: usize, records: usize, vectors: usize, displacement: usize, velocity: usize, force: usize,
  speeds: usize, inverse: f32, stiffness: f32, wind0: f32, wind1: f32, wind2: f32, half: f32, drag: f32, friction: f32, lift: f32,
  law: i32, most: f32, windy: bool, looked: bool, pushed: bool,
): f64 {
  const u0 = all(wind0), u1 = all(wind1), u2 = all(wind2);
  let fastest: f64 = 0;
  for (let c = 0; c < cells; ++c) {
    const nodes = cellNodes + 27 * 4 * c;
    const from = load<i32>(cellStart + 4 * c), to = load<i32>(cellStart + 4 * c + 4);
    for (let q = from; q < to; ++q) {
      const at = records + RECORD * q;
      const fx = get(at, 0), fy = get(at, 1), fz = get(at, 2);
      const count = load<i32>(at + 14 * VECTOR + 4);
      const blown = windy && count > 0;
      const slow = all(inverse);
      // weights and slopes along z; those along x and y in the loops
      let e = sub(all(1.5), fz), m = sub(fz, all(1)), l = sub(fz, all(0.5));
      const z0 = mul(all(0.5), mul(e, e)), z1 = sub(all(0.75), mul(m, m)), z2 = mul(all(0.5), mul(l, l));
      const y0 = f32x4.neg(mul(e, slow)), y1 = mul(mul(all(-2), m), slow), y2 = mul(l, slow);
      let v0 = all(0), v1 = all(0), v2 = all(0);
      F0 = all(1), F1 = all(0), F2 = all(0), F3 = all(0), F4 = all(1), F5 = all(0), F6 = all(0), F7 = all(0), F8 = all(1);
      let g0 = F0, g1 = F1, g2 = F2, g3 = F3, g4 = F4, g5 = F5, g6 = F6, g7 = F7, g8 = F8;
      for (let i = 0; i < 3; ++i) {
        const wx = weight(fx, i), sx = slope(fx, i, slow);
        for (let j = 0; j < 3; ++j) {
          const wy = weight(fy, j), sy = slope(fy, j, slow);
          const row = nodes + 12 * (3 * i + j);
          const n0 = load<u32>(row), n1 = load<u32>(row + 4), n2 = load<u32>(row + 8);
          let a = displacement + n0, b = displacement + n1, d = displacement + n2;
          let q0 = v128.load32_splat(a), q1 = v128.load32_splat(b), q2 = v128.load32_splat(d);
          const x = mul(sx, wy), y = mul(wx, sy), z = mul(wx, wy);
          let s = dot(z0, z1, z2, q0, q1, q2);
          g0 = mad(g0, x, s), g1 = mad(g1, y, s), g2 = mad(g2, z, dot(y0, y1, y2, q0, q1, q2));
          q0 = v128.load32_splat(a, 4), q1 = v128.load32_splat(b, 4), q2 = v128.load32_splat(d, 4);
          s = dot(z0, z1, z2, q0, q1, q2);
          g3 = mad(g3, x, s), g4 = mad(g4, y, s), g5 = mad(g5, z, dot(y0, y1, y2, q0, q1, q2));
          q0 = v128.load32_splat(a, 8), q1 = v128.load32_splat(b, 8), q2 = v128.load32_splat(d, 8);
          s = dot(z0, z1, z2, q0, q1, q2);
          g6 = mad(g6, x, s), g7 = mad(g7, y, s), g8 = mad(g8, z, dot(y0, y1, y2, q0, q1, q2));
          if (!blown && !looked) continue;
          a = velocity + n0, b = velocity + n1, d = velocity + n2;
          v0 = mad(v0, z, dot(z0, z1, z2, v128.load32_splat(a), v128.load32_splat(b), v128.load32_splat(d)));
          v1 = mad(v1, z, dot(z0, z1, z2, v128.load32_splat(a, 4), v128.load32_splat(b, 4), v128.load32_splat(d, 4)));
          v2 = mad(v2, z, dot(z0, z1, z2, v128.load32_splat(a, 8), v128.load32_splat(b, 8), v128.load32_splat(d, 8)));
        }
      }
      F0 = g0, F1 = g1, F2 = g2, F3 = g3, F4 = g4, F5 = g5, F6 = g6, F7 = g7, F8 = g8;
      C0 = cross(g4, g8, g5, g7), C1 = cross(g5, g6, g3, g8), C2 = cross(g3, g7, g4, g6);
      C3 = cross(g2, g7, g1, g8), C4 = cross(g0, g8, g2, g6), C5 = cross(g1, g6, g0, g7);
      C6 = cross(g1, g5, g2, g4), C7 = cross(g2, g3, g0, g5), C8 = cross(g0, g4, g1, g3);
      const mu = get(at, 4), lam = get(at, 5), laws = get(at, 13);
      if (looked) {
        v128.store(speeds + VECTOR * q, f32x4.sqrt(dot(v0, v1, v2, v0, v1, v2)));
        const real = load<i32>(at + 14 * VECTOR + 8);
        const most = mul(mad(mul(all(2), mu), lam, f32x4.max(largestArea(), all(1))), mul(all(stiffness * 1.0001), get(at, 6)));
        for (let lane = 0; lane < real; ++lane) {
          if (lane_of(laws, lane) < 0.5 && lane_of(most, lane) <= f32(fastest)) continue; // not the fastest
          const modulus = wave(lane_of(laws, lane), lane, lane_of(mu, lane), lane_of(lam, lane));
          const found = modulus * stiffness * lane_of(get(at, 6), lane);
          if (!(found <= fastest)) fastest = found;
        }
        if (!pushed) continue;
      }
      const mixed = f32x4.gt(laws, all(0.5));
      if (!v128.any_true(mixed)) {
        corotated(mu, lam);
      } else {
        neoHookean(mu, lam);
        if (!i32x4.all_true(mixed)) {
          const k0 = P0, k1 = P1, k2 = P2, k3 = P3, k4 = P4, k5 = P5, k6 = P6, k7 = P7, k8 = P8;
          corotated(mu, lam);
          P0 = v128.bitselect(k0, P0, mixed), P1 = v128.bitselect(k1, P1, mixed), P2 = v128.bitselect(k2, P2, mixed);
          P3 = v128.bitselect(k3, P3, mixed), P4 = v128.bitselect(k4, P4, mixed), P5 = v128.bitselect(k5, P5, mixed);
          P6 = v128.bitselect(k6, P6, mixed), P7 = v128.bitselect(k7, P7, mixed), P8 = v128.bitselect(k8, P8, mixed);
        }
      }
      const size = mul(get(at, 3), all(-stiffness));
      const p0 = mul(size, P0), p1 = mul(size, P1), p2 = mul(size, P2), p3 = mul(size, P3), p4 = mul(size, P4);
      const p5 = mul(size, P5), p6 = mul(size, P6), p7 = mul(size, P7), p8 = mul(size, P8);
      B0 = all(0), B1 = all(0), B2 = all(0);
      if (blown) {
        const first = vectors + 3 * VECTOR * load<i32>(at + 14 * VECTOR);
        blow(at, first, count, u0, u1, u2, sub(u0, v0), sub(u1, v1), sub(u2, v2), half, drag, friction, lift, law, most);
      }
      const b0 = B0, b1 = B1, b2 = B2;
      const wx0 = weight(fx, 0), wx1 = weight(fx, 1), wx2 = weight(fx, 2);
      const sx0 = slope(fx, 0, slow), sx1 = slope(fx, 1, slow), sx2 = slope(fx, 2, slow);
      const more = q > from;
      for (let j = 0; j < 3; ++j) {
        const wy = weight(fy, j), sy = slope(fy, j, slow);
        const sum = sums + 9 * VECTOR * j;
        const t0 = mul(p0, wy), t1 = mul(p3, wy), t2 = mul(p6, wy); // along x
        const e0 = mad(mul(b0, wy), p1, sy), e1 = mad(mul(b1, wy), p4, sy), e2 = mad(mul(b2, wy), p7, sy);
        const h0 = mul(p2, wy), h1 = mul(p5, wy), h2 = mul(p8, wy);
        spread(sum, more, wx0, sx0, t0, t1, t2, e0, e1, e2, h0, h1, h2, z0, z1, z2, y0, y1, y2);
        spread(sum + 27 * VECTOR, more, wx1, sx1, t0, t1, t2, e0, e1, e2, h0, h1, h2, z0, z1, z2, y0, y1, y2);
        spread(sum + 54 * VECTOR, more, wx2, sx2, t0, t1, t2, e0, e1, e2, h0, h1, h2, z0, z1, z2, y0, y1, y2);
      }
    }
    if (!pushed) continue;
    for (let k: usize = 0; k < 27; ++k) {
      const out = force + load<u32>(nodes + 4 * k);
      const sum = sums + 3 * VECTOR * k;
      const x = get(sum, 0), y = get(sum, 1), z = get(sum, 2);
      const pair = add(v128.shuffle<f32>(x, y, 0, 4, 1, 5), v128.shuffle<f32>(x, y, 2, 6, 3, 7)); // x02 y02 x13 y13
      const last = add(z, v128.shuffle<f32>(z, z, 2, 3, 0, 1)); // z02 z13 z02 z13
      const all = add(v128.shuffle<f32>(pair, last, 0, 1, 4, 4), v128.shuffle<f32>(pair, last, 2, 3, 5, 5));
      v128.store(out, add(v128.load(out), all));
    }
  }
  return fastest;
}

/** Adds what a point gives to three nodes along z. */
// @ts-ignore: decorator
@inline function spread(
  at: usize, more: bool, wx: v128, sx: v128, t0: v128, t1: v128, t2: v128, e0: v128, e1: v128, e2: v128, h0: v128, h1: v128, h2: v128,
  z0: v128, z1: v128, z2: v128, y0: v128, y1: v128, y2: v128,
): void {
  const a0 = mad(mul(sx, t0), wx, e0), a1 = mad(mul(sx, t1), wx, e1), a2 = mad(mul(sx, t2), wx, e2);
  const c0 = mul(wx, h0), c1 = mul(wx, h1), c2 = mul(wx, h2);
  if (more) {
    v128.store(at, add(get(at, 0), mad(mul(z0, a0), y0, c0)));
    v128.store(at, add(get(at, 1), mad(mul(z0, a1), y0, c1)), 16);
    v128.store(at, add(get(at, 2), mad(mul(z0, a2), y0, c2)), 32);
    v128.store(at, add(get(at, 3), mad(mul(z1, a0), y1, c0)), 48);
    v128.store(at, add(get(at, 4), mad(mul(z1, a1), y1, c1)), 64);
    v128.store(at, add(get(at, 5), mad(mul(z1, a2), y1, c2)), 80);
    v128.store(at, add(get(at, 6), mad(mul(z2, a0), y2, c0)), 96);
    v128.store(at, add(get(at, 7), mad(mul(z2, a1), y2, c1)), 112);
    v128.store(at, add(get(at, 8), mad(mul(z2, a2), y2, c2)), 128);
  } else {
    v128.store(at, mad(mul(z0, a0), y0, c0));
    v128.store(at, mad(mul(z0, a1), y0, c1), 16);
    v128.store(at, mad(mul(z0, a2), y0, c2), 32);
    v128.store(at, mad(mul(z1, a0), y1, c0), 48);
    v128.store(at, mad(mul(z1, a1), y1, c1), 64);
    v128.store(at, mad(mul(z1, a2), y1, c2), 80);
    v128.store(at, mad(mul(z2, a0), y2, c0), 96);
    v128.store(at, mad(mul(z2, a1), y2, c1), 112);
    v128.store(at, mad(mul(z2, a2), y2, c2), 128);
  }
}

// @ts-ignore: decorator
@inline function weight(f: v128, k: i32): v128 {
  if (k == 0) { const e = sub(all(1.5), f); return mul(all(0.5), mul(e, e)); }
  if (k == 1) { const m = sub(f, all(1)); return sub(all(0.75), mul(m, m)); }
  const l = sub(f, all(0.5));
  return mul(all(0.5), mul(l, l));
}

// @ts-ignore: decorator
@inline function slope(f: v128, k: i32, inverse: v128): v128 {
  if (k == 0) return mul(sub(f, all(1.5)), inverse);
  if (k == 1) return mul(mul(all(-2), sub(f, all(1))), inverse);
  return mul(sub(f, all(0.5)), inverse);
}

/** Velocities of the nodes after `kick` seconds of force and gravity; `decays` is what damping leaves of them. */
export function accelerate(
  nodes: i32, velocity: usize, force: usize, inverses: usize, decays: usize, resistances: usize, dragged: bool, kick: f32, g0: f32, g1: f32, g2: f32,
): void {
  const gravity = f32x4(g0, g1, g2, 0);
  let push = all(kick);
  for (let k = 0; k < nodes; ++k, velocity += VECTOR, force += VECTOR, inverses += 4, decays += 4) {
    const inverse = v128.load32_splat(inverses);
    if (dragged) push = all(kick / (1 + kick * load<f32>(resistances + 4 * k) * load<f32>(inverses)));
    const gained = mul(push, add(mul(get(force, 0), inverse), gravity));
    v128.store(velocity, mul(v128.load32_splat(decays), add(get(velocity, 0), gained)));
  }
}

/** Weighted sums over 27 nodes each of a field. */
export function read(rows: i32, node: usize, weight: usize, field: usize, out: usize): void {
  for (let r = 0; r < rows; ++r) {
    let sum = all(0);
    for (let k = 0; k < 27; ++k, node += 4, weight += 4)
      sum = mad(sum, v128.load32_splat(weight), v128.load(field + load<u32>(node)));
    v128.store(out + VECTOR * r, sum);
  }
}

/** Stops the held points exactly; `rates` are their velocities. */
export function hold(velocity: usize, rows: i32, count: i32, affected: usize, push: usize, rates: usize): void {
  for (let k = 0; k < count; ++k, affected += 4) {
    let sum = all(0);
    for (let r = 0; r < rows; ++r, push += 4) sum = mad(sum, v128.load32_splat(push), get(rates, r));
    const at = velocity + load<u32>(affected);
    v128.store(at, sub(v128.load(at), sum));
  }
}

export function move(nodes: i32, displacement: usize, velocity: usize, dt: f32): void {
  const step = all(dt);
  for (let k = 0; k < nodes; ++k, displacement += VECTOR, velocity += VECTOR)
    v128.store(displacement, mad(get(displacement, 0), step, get(velocity, 0)));
}
