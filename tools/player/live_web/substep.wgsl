// A substep in compute shaders, in single precision; the definitions are gaussian_swaying/mpm/total.py, mpm/laws and wind/force.py.
// touch.wgsl has contact. `particles` works on a point, `spread` on three nodes of a cell, `accelerate` on a node; none of them adds to
// what another one writes, so that the order of all sums is the same every time.

struct Point {
  fraction: vec3f, cell: u32,
  volume: f32, mass: f32, mu: f32, lam: f32,
  law: u32, area: f32, first: u32, last: u32, // its area vectors
  upper: vec3f, own: f32, // of the sum of A N N^T: xx, xy, xz; own is its trace
  lower: vec3f, unused: f32, // yy, yz, zz
}

struct Node { inverse: f32, damping: f32, held: u32, first: u32, last: u32 }
struct Share { node: u32, weight: f32 }

/** What differs from substep to substep. `obstacles` has a bit for each one that acts. */
struct Step {
  wind: vec3f, kick: f32,
  aim: vec3f, dt: f32,
  stiffness: f32, pulled: u32, obstacles: u32, slot: u32,
}

@group(0) @binding(0) var<storage, read> points: array<Point>;
@group(0) @binding(1) var<storage, read> cellNodes: array<u32>;
@group(0) @binding(2) var<storage, read> vectors: array<vec4f>;
@group(0) @binding(3) var<storage, read> held: array<vec4f>; // where a point is pulled to, relative to the aim and its rest, and its share
@group(0) @binding(4) var<storage, read_write> displacement: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> velocity: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> stresses: array<vec4f>; // of a point: three columns with a force, and a resistance
@group(0) @binding(7) var<storage, read> cellStart: array<u32>;
@group(0) @binding(8) var<storage, read_write> sums: array<vec4f>; // of a node of a cell: force and resistance
@group(0) @binding(9) var<storage, read> nodes: array<Node>;
@group(0) @binding(10) var<storage, read> entries: array<u32>; // of `sums`, node by node
@group(0) @binding(12) var<storage, read> rows: array<Share>;
@group(0) @binding(13) var<storage, read_write> rates: array<vec4f>;
@group(0) @binding(14) var<storage, read> affected: array<u32>;
@group(0) @binding(15) var<storage, read> push: array<f32>;
@group(0) @binding(16) var<storage, read_write> speeds: array<f32>;
@group(0) @binding(17) var<storage, read_write> fastest: array<atomic<u32>>;
@group(1) @binding(0) var<uniform> now: Step;

override POINTS: u32;
override SPREAD: u32; // rows of three nodes of all cells
override NODES: u32;
override ROWS: u32;
override AFFECTED: u32;
override OBSTACLES: u32;
override INVERSE: f32; // 1/dx
override GRAVITY_X: f32;
override GRAVITY_Y: f32;
override GRAVITY_Z: f32;
override DAMPING: f32;
override VISCOUS: f32;
override WINDY: bool;
override DRAG: f32;
override FRICTION: f32;
override LIFT: f32;
override AIR: f32;
override AERO_LAW: u32;
override IMPLICIT: bool;
override MOST_AREA: f32;
override QUICK: f32;
override STRONGEST: f32;

const LEAST = 0.05;
const COROTATED = 0u;
const NEO_HOOKEAN = 1u;
const HENCKY = 2u;
const PAPER = 0u;
const LINEAR = 2u;
const CROSS_FLOW = 3u;

// ---- weights

fn weights(f: f32) -> vec3f {
  let a = vec3f(1.5 - f, f - 1.0, f - 0.5);
  return vec3f(0.5 * a.x * a.x, 0.75 - a.y * a.y, 0.5 * a.z * a.z);
}

fn slopes(f: f32) -> vec3f {
  return INVERSE * vec3f(f - 1.5, 2.0 - 2.0 * f, f - 0.5);
}

/** Fields of the nodes at a point. The columns of F are along x, y and z. */
struct Fields { F: mat3x3f, L: mat3x3f, place: vec3f, speed: vec3f }

/** Adds what three nodes along z give. */
fn add(found: ptr<function, Fields>, at: u32, x: f32, y: f32, z: f32, wz: vec3f, gz: vec3f) {
  let a = cellNodes[at];
  let b = cellNodes[at + 1];
  let c = cellNodes[at + 2];
  var q = mat3x3f(displacement[a].xyz, displacement[b].xyz, displacement[c].xyz);
  var s = q * wz;
  (*found).F += mat3x3f(x * s, y * s, z * (q * gz));
  (*found).place += z * s;
  q = mat3x3f(velocity[a].xyz, velocity[b].xyz, velocity[c].xyz);
  s = q * wz;
  if (VISCOUS > 0) { (*found).L += mat3x3f(x * s, y * s, z * (q * gz)); }
  (*found).speed += z * s;
}

fn fieldsOf(point: Point) -> Fields {
  let wx = weights(point.fraction.x);
  let wy = weights(point.fraction.y);
  let wz = weights(point.fraction.z);
  let gx = slopes(point.fraction.x);
  let gy = slopes(point.fraction.y);
  let gz = slopes(point.fraction.z);
  var found = Fields(mat3x3f(1, 0, 0, 0, 1, 0, 0, 0, 1), mat3x3f(), vec3f(), vec3f());
  let at = 27 * point.cell;
  add(&found, at, gx.x * wy.x, wx.x * gy.x, wx.x * wy.x, wz, gz);
  add(&found, at + 3, gx.x * wy.y, wx.x * gy.y, wx.x * wy.y, wz, gz);
  add(&found, at + 6, gx.x * wy.z, wx.x * gy.z, wx.x * wy.z, wz, gz);
  add(&found, at + 9, gx.y * wy.x, wx.y * gy.x, wx.y * wy.x, wz, gz);
  add(&found, at + 12, gx.y * wy.y, wx.y * gy.y, wx.y * wy.y, wz, gz);
  add(&found, at + 15, gx.y * wy.z, wx.y * gy.z, wx.y * wy.z, wz, gz);
  add(&found, at + 18, gx.z * wy.x, wx.z * gy.x, wx.z * wy.x, wz, gz);
  add(&found, at + 21, gx.z * wy.y, wx.z * gy.y, wx.z * wy.y, wz, gz);
  add(&found, at + 24, gx.z * wy.z, wx.z * gy.z, wx.z * wy.z, wz, gz);
  return found;
}

// ---- matrices

fn cofactors(F: mat3x3f) -> mat3x3f {
  return mat3x3f(cross(F[1], F[2]), cross(F[2], F[0]), cross(F[0], F[1]));
}

fn inner(a: mat3x3f, b: mat3x3f) -> f32 {
  return dot(a[0], b[0]) + dot(a[1], b[1]) + dot(a[2], b[2]);
}

struct Singular { U: mat3x3f, a: vec3f, V: mat3x3f }

/** Makes two columns orthogonal; true if they were not. */
fn turned(p: ptr<function, vec3f>, q: ptr<function, vec3f>, vp: ptr<function, vec3f>, vq: ptr<function, vec3f>) -> bool {
  let alpha = dot(*p, *p);
  let beta = dot(*q, *q);
  let gamma = dot(*p, *q);
  if (!(abs(gamma) > 1e-7 * sqrt(alpha) * sqrt(beta))) { return false; }
  let zeta = (beta - alpha) / (2.0 * gamma);
  let t = select(1.0, -1.0, zeta < 0) / (abs(zeta) + sqrt(1.0 + zeta * zeta));
  let c = inverseSqrt(1.0 + t * t);
  let s = c * t;
  let x = *p;
  let vx = *vp;
  *p = c * x - s * *q;
  *q = s * x + c * *q;
  *vp = c * vx - s * *vq;
  *vq = s * vx + c * *vq;
  return true;
}

/** Makes the first column the longer one; V stays a rotation. */
fn sorted(p: ptr<function, vec3f>, q: ptr<function, vec3f>, vp: ptr<function, vec3f>, vq: ptr<function, vec3f>) {
  if (dot(*p, *p) >= dot(*q, *q)) { return; }
  let x = *p;
  let vx = *vp;
  *p = *q;
  *q = -x;
  *vp = *vq;
  *vq = -vx;
}

fn singular(F: mat3x3f) -> Singular {
  var b0 = F[0];
  var b1 = F[1];
  var b2 = F[2];
  var v0 = vec3f(1, 0, 0);
  var v1 = vec3f(0, 1, 0);
  var v2 = vec3f(0, 0, 1);
  for (var sweep = 0; sweep < 8; sweep++) {
    var some = turned(&b0, &b1, &v0, &v1);
    some = turned(&b0, &b2, &v0, &v2) || some;
    some = turned(&b1, &b2, &v1, &v2) || some;
    if (!some) { break; }
  }
  sorted(&b0, &b1, &v0, &v1);
  sorted(&b0, &b2, &v0, &v2);
  sorted(&b1, &b2, &v1, &v2);
  let a0 = length(b0);
  let a1 = length(b1);
  let x = select(v0, b0 / max(a0, 1e-30), a0 > 0);
  var y = b1;
  if (!(a1 > 1e-6 * a0)) { y = select(vec3f(0, 1, 0), vec3f(1, 0, 0), abs(x.x) < 0.6); }
  y = normalize(y - dot(x, y) * x);
  let z = cross(x, y);
  return Singular(mat3x3f(x, y, z), vec3f(a0, a1, dot(z, b2)), mat3x3f(v0, v1, v2));
}

/** The largest two eigenvalues of F^T F. */
fn squares(F: mat3x3f) -> vec2f {
  let A = transpose(F) * F;
  let mean = (A[0].x + A[1].y + A[2].z) / 3.0;
  let b = vec3f(A[0].x, A[1].y, A[2].z) - mean;
  let off = vec3f(A[0].y, A[0].z, A[1].z);
  let size = sqrt((dot(b, b) + 2.0 * dot(off, off)) / 6.0);
  if (!(size > 1e-6 * mean)) { return vec2f(mean + 2.0 * size, mean + size); }
  let c = off / size;
  let d = b / size;
  let det = d.x * (d.y * d.z - c.z * c.z) - c.x * (c.x * d.z - c.z * c.y) + c.y * (c.x * c.z - d.y * c.y);
  let angle = acos(clamp(0.5 * det, -1.0, 1.0)) / 3.0;
  return mean + 2.0 * size * vec2f(cos(angle), cos(angle + 4.1887902));
}

// ---- laws

fn continuedLog(x: f32) -> f32 {
  return select(log(max(x, LEAST)), log(LEAST) + (x - LEAST) / LEAST, x < LEAST);
}

fn logs(x: vec3f) -> vec3f {
  return vec3f(continuedLog(x.x), continuedLog(x.y), continuedLog(x.z));
}

fn springPull(square: f32) -> f32 {
  let inside = max(square, LEAST * LEAST);
  let root = sqrt(inside);
  return (root + (square - inside) / (2.0 * root) - 1.0) / root;
}

fn pullSlope(square: f32) -> f32 {
  let inside = max(square, LEAST * LEAST);
  return 0.5 / (inside * select(1.0, sqrt(inside), square >= LEAST * LEAST));
}

fn pulls(x: vec3f) -> vec3f {
  let half = 0.5 * (dot(x, x) - x * x);
  return vec3f(springPull(half.x), springPull(half.y), springPull(half.z));
}

/** Derivatives of the energy by the principal stretches. */
fn principal(law: u32, x: vec3f, mu: f32, lam: f32) -> vec3f {
  if (law == HENCKY) {
    let l = logs(x);
    return (2.0 * mu * l + lam * (l.x + l.y + l.z)) / max(x, vec3f(LEAST));
  }
  let least = max(min(mu, lam), 0.0);
  let pull = pulls(x);
  let all = pull.x + pull.y + pull.z;
  let whole = springPull(dot(x, x) / 3.0);
  let mean = (2.0 / 21.0) * (x - 1.0) + x * ((8.0 / 105.0) * (all - pull) + (3.0 / 35.0) * whole);
  return 15.0 * least * mean + 2.0 * (mu - least) * (x - 1.0) + (lam - least) * (x.x + x.y + x.z - 3.0);
}

/** Second derivatives of the same. */
fn curvature(law: u32, x: vec3f, mu: f32, lam: f32) -> mat3x3f {
  if (law == HENCKY) {
    let l = logs(x);
    let s = 1.0 / max(x, vec3f(LEAST));
    let own = (2.0 * mu) * s * s - (2.0 * mu * l + lam * (l.x + l.y + l.z)) * select(s * s, vec3f(), x < vec3f(LEAST));
    return mat3x3f(lam * s.x * s + vec3f(own.x, 0, 0), lam * s.y * s + vec3f(0, own.y, 0), lam * s.z * s + vec3f(0, 0, own.z));
  }
  let least = max(min(mu, lam), 0.0);
  let pull = pulls(x);
  let half = 0.5 * (dot(x, x) - x * x);
  let t = vec3f(pullSlope(half.x), pullSlope(half.y), pullSlope(half.z));
  let whole = dot(x, x) / 3.0;
  let own = 15.0 * least * ((2.0 / 21.0) + (8.0 / 105.0) * (pull.x + pull.y + pull.z - pull) + (3.0 / 35.0) * springPull(whole)) + 2.0 * (mu - least);
  let w = (2.0 / 35.0) * pullSlope(whole);
  // the pull that leaves out axis j changes with all other stretches
  let others = vec3f(t.y + t.z, t.x + t.z, t.x + t.y);
  let mixed = vec3f(t.x, t.y, t.z); // of the axes y and z, x and z, x and y
  let scale = 15.0 * least;
  let rest = lam - least;
  let xy = scale * x.x * x.y * ((8.0 / 105.0) * mixed.z + w) + rest;
  let xz = scale * x.x * x.z * ((8.0 / 105.0) * mixed.y + w) + rest;
  let yz = scale * x.y * x.z * ((8.0 / 105.0) * mixed.x + w) + rest;
  let d = own + scale * x * x * ((8.0 / 105.0) * others + w) + rest;
  return mat3x3f(d.x, xy, xz, xy, d.y, yz, xz, yz, d.z);
}

fn corotated(F: mat3x3f, mu: f32, lam: f32) -> mat3x3f {
  var X = F;
  var C = cofactors(F);
  var det = dot(F[0], C[0]);
  let volumetric = (lam * (det - 1.0)) * C;
  for (var step = 0; step < 8; step++) {
    let inverse = 1.0 / select(max(det, 1e-9), min(det, -1e-9), det < 0);
    let zeta = sqrt(sqrt(max(inner(C, C) * inverse * inverse / max(inner(X, X), 1e-9), 1e-37)));
    let change = (0.5 * zeta - 1.0) * X + (0.5 * inverse / zeta) * C;
    X += change;
    C = cofactors(X);
    det = dot(X[0], C[0]);
    if (!(inner(change, change) > 1e-7)) { break; } // the next change is below 1e-7
  }
  if (det < 0) {
    let s = singular(F);
    X = s.U * transpose(s.V);
  }
  return (2.0 * mu) * (F - X) + volumetric;
}

fn stress(law: u32, F: mat3x3f, mu: f32, lam: f32) -> mat3x3f {
  if (law == COROTATED) { return corotated(F, mu, lam); }
  if (law == NEO_HOOKEAN) {
    let C = cofactors(F);
    let det = dot(F[0], C[0]);
    return mu * F + ((lam * continuedLog(det) - mu) / max(det, LEAST)) * C;
  }
  let s = singular(F);
  let y = principal(law, s.a, mu, lam);
  return mat3x3f(y.x * s.U[0], y.y * s.U[1], y.z * s.U[2]) * transpose(s.V);
}

/** Kelvin and Voigt's stress. */
fn viscousStress(F: mat3x3f, L: mat3x3f, mu: f32, lam: f32) -> mat3x3f {
  let E = transpose(F) * L;
  return VISCOUS * ((lam * (E[0].x + E[1].y + E[2].z)) * F + mu * (F * (E + transpose(E))));
}

fn pair(yi: f32, yk: f32, ai: f32, ak: f32, hi: f32, hk: f32, mixed: f32) -> f32 {
  let twist = (yi + yk) / max(ai + ak, 1e-7);
  let gap = ai - ak;
  // closer together, rounding is more than the difference
  let flip = select(0.5 * (hi + hk) - mixed, (yi - yk) / select(gap, 1.0, gap == 0), abs(gap) > 1e-2);
  return max(twist - mixed, flip + mixed);
}

fn waveModulus(law: u32, F: mat3x3f, mu: f32, lam: f32) -> f32 {
  let rest = 2.0 * mu + lam;
  if (law >= HENCKY) {
    let a = singular(F).a;
    let y = principal(law, a, mu, lam);
    let H = curvature(law, a, mu, lam);
    let most = max(max(rest, H[0].x), max(H[1].y, H[2].z));
    let xy = pair(y.x, y.y, a.x, a.y, H[0].x, H[1].y, H[0].y);
    let xz = pair(y.x, y.z, a.x, a.z, H[0].x, H[2].z, H[0].z);
    let yz = pair(y.y, y.z, a.y, a.z, H[1].y, H[2].z, H[1].z);
    return max(max(most, xy), max(xz, yz));
  }
  let two = squares(F);
  let area = max(two.x, 0.0) * max(two.y, 0.0);
  if (law == COROTATED) { return 2.0 * mu + lam * max(area, 1.0); }
  let det = determinant(F);
  let slope = 1.0 / max(det, LEAST);
  let second = select(-slope * slope, 0.0, det < LEAST);
  let bulk = lam * slope * slope + (lam * continuedLog(det) - mu) * second;
  return max(rest, mu + max(bulk, 0.0) * area);
}

// ---- wind

/** Force [N] and resistance [kg/s] of the wind on the patches of a point; see `onGroup` in aero.js. */
fn blow(point: Point, F: mat3x3f, moving: vec3f) -> vec4f {
  let C = cofactors(F);
  let T = mat3x3f(point.upper, vec3f(point.upper.y, point.lower.xy), vec3f(point.upper.z, point.lower.yz));
  let r = now.wind - moving;
  let w = r * C;
  let M = C * T;
  let growth = sqrt(max(inner(M, C) / point.own, 1e-30));
  let across = M * w / growth;
  var s = vec3f();
  var p = vec3f();
  for (var k = point.first; k < point.last; k++) {
    let b = vectors[k].xyz;
    let along = dot(b, w);
    let square = dot(b, b);
    s += select(b, -b, along < 0);
    if (AERO_LAW == CROSS_FLOW) { p += (along * abs(along) / square) * b; }
  }
  let face = C * s;
  let whole = growth * point.own;
  let tangent = whole * r - across;
  let cap = min(MOST_AREA / growth, 1.0);
  let square = dot(r, r);
  let speed = sqrt(square);
  let blowing = select(speed, length(now.wind), AERO_LAW == LINEAR);
  var pushed = (DRAG * blowing) * across;
  if (AERO_LAW == PAPER) { pushed = (DRAG * square) * face; }
  if (AERO_LAW == CROSS_FLOW) { pushed = (DRAG / (growth * growth)) * (C * p); }
  let side = (LIFT * speed) * cross(r, face);
  let force = (0.5 * AIR * cap) * (pushed + FRICTION * speed * tangent + side);
  let drag = 0.5 * AIR * whole * cap * (DRAG * blowing + (FRICTION + abs(LIFT)) * speed);
  return vec4f(force, select(0.0, drag, IMPLICIT));
}

// ---- a substep

@compute @workgroup_size(64)
fn particles(@builtin(global_invocation_id) id: vec3u) {
  let p = id.x;
  if (p >= POINTS) { return; }
  let point = points[p];
  let at = fieldsOf(point);
  var P = (-point.volume * now.stiffness) * stress(point.law, at.F, point.mu, point.lam);
  if (VISCOUS > 0) { P += (-point.volume * now.stiffness) * viscousStress(at.F, at.L, point.mu, point.lam); }
  var b = vec4f();
  if (WINDY && point.area > 0) { b = blow(point, at.F, at.speed); }
  if (now.pulled > 0) {
    let own = held[p];
    let x = QUICK * QUICK * (now.aim + own.xyz - at.place);
    let damping = 2.0 * QUICK * own.w;
    b += vec4f(own.w * STRONGEST / max(length(x), STRONGEST) * x - damping * at.speed, damping);
  }
  stresses[4 * p] = vec4f(P[0], b.x);
  stresses[4 * p + 1] = vec4f(P[1], b.y);
  stresses[4 * p + 2] = vec4f(P[2], b.z);
  stresses[4 * p + 3] = vec4f(0, 0, 0, b.w);
}

@compute @workgroup_size(64)
fn spread(@builtin(global_invocation_id) id: vec3u) {
  let k = id.x;
  if (k >= SPREAD) { return; }
  let cell = k / 9;
  let row = vec2u((k % 9) / 3, k % 3);
  // weights along x and y are scale * distance² + offset
  let middle = 1.5 - 0.5 * vec2f(row);
  let scale = select(vec2f(0.5), vec2f(-1), row == vec2u(1));
  let offset = select(vec2f(), vec2f(0.75), row == vec2u(1));
  var sum = array<vec4f, 3>();
  for (var p = cellStart[cell]; p < cellStart[cell + 1]; p++) {
    let f = points[p].fraction;
    let far = f.xy - middle;
    let w = scale * far * far + offset;
    let g = 2.0 * INVERSE * scale * far;
    let wz = weights(f.z);
    let gz = slopes(f.z);
    let x = stresses[4 * p];
    let y = stresses[4 * p + 1];
    let z = stresses[4 * p + 2];
    let whole = w.x * w.y;
    let own = vec4f((g.x * w.y) * x.xyz + (w.x * g.y) * y.xyz + whole * vec3f(x.w, y.w, z.w), whole * stresses[4 * p + 3].w);
    let along = vec4f(whole * z.xyz, 0);
    sum[0] += wz.x * own + gz.x * along;
    sum[1] += wz.y * own + gz.y * along;
    sum[2] += wz.z * own + gz.z * along;
  }
  for (var l = 0u; l < 3; l++) {
    sums[3 * k + l] = sum[l];
  }
}

@compute @workgroup_size(64)
fn accelerate(@builtin(global_invocation_id) id: vec3u) {
  let k = id.x;
  if (k >= NODES) { return; }
  let node = nodes[k];
  var force = vec4f();
  for (var e = node.first; e < node.last; e++) { force += sums[entries[e]]; }
  let decay = exp(-now.kick * (DAMPING + node.damping));
  let kick = now.kick / (1.0 + now.kick * force.w * node.inverse);
  let V = decay * (velocity[k].xyz + kick * (force.xyz * node.inverse + vec3f(GRAVITY_X, GRAVITY_Y, GRAVITY_Z)));
  if (OBSTACLES > 0) {
    velocity[k] = vec4f(V, 0);
  } else {
    end(k, node, V);
  }
}

/** What follows contact. */
@compute @workgroup_size(64)
fn finish(@builtin(global_invocation_id) id: vec3u) {
  let k = id.x;
  if (k < NODES) { end(k, nodes[k], velocity[k].xyz); }
}

/** Pins of nodes, and the motion. */
fn end(k: u32, node: Node, free: vec3f) {
  var V = free;
  if (node.held > 0) { V = vec3f(); }
  velocity[k] = vec4f(V, 0);
  displacement[k] += vec4f(now.dt * V, 0);
}

/** Velocities of the held points. */
@compute @workgroup_size(64)
fn rate(@builtin(global_invocation_id) id: vec3u) {
  let r = id.x;
  if (r >= ROWS) { return; }
  var sum = vec4f();
  for (var k = 27 * r; k < 27 * r + 27; k++) { sum += rows[k].weight * velocity[rows[k].node]; }
  rates[r] = sum;
}

/** Stops the held points exactly; their nodes have moved already. */
@compute @workgroup_size(64)
fn hold(@builtin(global_invocation_id) id: vec3u) {
  let k = id.x;
  if (k >= AFFECTED) { return; }
  var sum = vec4f();
  for (var r = 0u; r < ROWS; r++) { sum += push[ROWS * k + r] * rates[r]; }
  velocity[affected[k]] -= sum;
  displacement[affected[k]] -= now.dt * sum;
}

/** The fastest wave, as the square of its speed at the stiffness in the file, the largest stretch, and the speeds of all points. */
@compute @workgroup_size(64)
fn look(@builtin(global_invocation_id) id: vec3u) {
  let p = id.x;
  if (p >= POINTS) { return; }
  let point = points[p];
  let at = fieldsOf(point);
  speeds[p] = length(at.speed);
  let square = waveModulus(point.law, at.F, point.mu, point.lam) * point.volume / point.mass;
  atomicMax(&fastest[2 * now.slot], bitcast<u32>(square)); // of positive numbers, the larger one has the larger bits
  if (VISCOUS > 0) { atomicMax(&fastest[2 * now.slot + 1], bitcast<u32>(max(squares(at.F).x, 1.0))); }
}
