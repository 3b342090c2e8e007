// Contact of the samples of the surface with obstacles, as in gaussian_swaying/mpm/contact.py, without pairs. `meet` finds what acts, `weigh` how much it moves the nodes,
// and `resolve` iterates in one group, which waits for itself. It follows substep.wgsl, which has what it shares.

struct Obstacle { center: vec3f, kind: u32, first: vec4f, x: vec3f, friction: f32, y: vec3f, gap: f32, z: vec3f, unused: f32 }

/** An obstacle at a sample; `acts` is 0 or 1. */
struct Touch { normal: vec3f, step: f32, applied: vec3f, wanted: f32, last: vec3f, acts: f32, next: vec3f, friction: f32 }

@group(0) @binding(18) var<storage, read> places: array<vec4f>; // of the samples, and half of the thickness
@group(0) @binding(19) var<storage, read> reach: array<Share>; // 27 nodes of each sample
@group(0) @binding(20) var<storage, read> obstacles: array<Obstacle>;
@group(0) @binding(21) var<storage, read> readers: array<u32>; // where the list of each node begins, and then in `reach` what names it
@group(0) @binding(22) var<storage, read_write> touches: array<Touch>; // those of a sample one after the other
@group(0) @binding(23) var<storage, read_write> impulses: array<vec4f>; // of a sample, and how many obstacles act on it
@group(0) @binding(24) var<storage, read_write> loads: array<f32>; // of a node, 0 if nothing touches it

override SAMPLES: u32;
override ITERATIONS: u32;
override DX: f32;

const HALF_SPACE = 0u;
const CAPSULE = 1u;
const PUSH = 0.01;
const PUSH_CELLS = 0.004;
const CREEP = 0.01;
const SLACK = 0.02;
const TOLERANCE = 5e-5;
const TINY = 1e-30;
const TOGETHER = 256u;

fn outwards(v: vec3f) -> vec4f {
  let size = length(v);
  return select(vec4f(0, 0, 1, size), vec4f(v / max(size, TINY), size), size > 1e-18);
}

/** Unit normal of an obstacle, and the distance from it; the place is relative to its centre. */
fn away(o: Obstacle, at: vec3f) -> vec4f {
  if (o.kind == HALF_SPACE) { return vec4f(o.first.xyz, dot(at, o.first.xyz)); }
  if (o.kind == CAPSULE) {
    let axis = o.first.yzw;
    let along = clamp(dot(at, axis) / max(dot(axis, axis), TINY), -1.0, 1.0);
    return outwards(at - along * axis) - vec4f(0, 0, 0, o.first.x);
  }
  let place = at.x * o.x + at.y * o.y + at.z * o.z; // along its sides
  let beyond = abs(place) - o.first.xyz;
  let deepest = max(max(beyond.x, beyond.y), beyond.z);
  var found = outwards(max(beyond, vec3f()));
  if (deepest <= 0) {
    let y = select(vec3f(0, 0, 1), vec3f(0, 1, 0), beyond.y == deepest);
    found = vec4f(select(y, vec3f(1, 0, 0), beyond.x == deepest), deepest);
  }
  let n = select(found.xyz, -found.xyz, place < vec3f());
  return vec4f(dot(n, o.x), dot(n, o.y), dot(n, o.z), found.w);
}

fn movingAt(s: u32) -> vec3f {
  var sum = vec3f();
  for (var k = 27 * s; k < 27 * s + 27; k++) { sum += reach[k].weight * velocity[reach[k].node].xyz; }
  return sum;
}

@compute @workgroup_size(64)
fn meet(@builtin(global_invocation_id) id: vec3u) {
  let s = id.x;
  if (s >= SAMPLES) { return; }
  var place = places[s].xyz;
  for (var k = 27 * s; k < 27 * s + 27; k++) { place += reach[k].weight * displacement[reach[k].node].xyz; }
  let moving = movingAt(s);
  var acting = 0.0;
  for (var o = 0u; o < OBSTACLES; o++) {
    let obstacle = obstacles[o];
    let found = away(obstacle, place - obstacle.center);
    let gap = found.w - obstacle.gap - places[s].w;
    let ahead = gap + now.dt * dot(moving, found.xyz);
    var acts = 0.0;
    if ((now.obstacles & (1u << o)) != 0 && gap <= DX && min(ahead, gap) < SLACK * DX) { acts = 1.0; }
    acting += acts;
    let wanted = select(min(-gap * PUSH, PUSH_CELLS * DX), -gap, gap > 0) / now.dt;
    touches[OBSTACLES * s + o] = Touch(found.xyz, 0, vec3f(), wanted, vec3f(), acts, vec3f(), obstacle.friction);
  }
  impulses[s] = vec4f(0, 0, 0, acting);
}

@compute @workgroup_size(64)
fn weigh(@builtin(global_invocation_id) id: vec3u) {
  let k = id.x;
  if (k >= NODES) { return; }
  var sum = 0.0;
  for (var e = readers[k]; e < readers[k + 1]; e++) { sum += abs(reach[readers[e]].weight) * impulses[readers[e] / 27].w; }
  loads[k] = sum * nodes[k].inverse;
}

var<workgroup> parts: array<f32, TOGETHER>;

/** The sum over the group. */
fn summed(thread: u32, own: f32) -> f32 {
  parts[thread] = own;
  for (var half = TOGETHER / 2; half > 0; half /= 2) {
    workgroupBarrier();
    if (thread < half) { parts[thread] += parts[thread + half]; }
  }
  let sum = workgroupUniformLoad(&parts[0]);
  return sum;
}

/** The largest over the group. */
fn most(thread: u32, own: f32) -> f32 {
  parts[thread] = own;
  for (var half = TOGETHER / 2; half > 0; half /= 2) {
    workgroupBarrier();
    if (thread < half) { parts[thread] = max(parts[thread], parts[thread + half]); }
  }
  let found = workgroupUniformLoad(&parts[0]);
  return found;
}

/** Gives the impulses of all samples to the nodes. */
fn give(thread: u32) {
  storageBarrier();
  for (var k = thread; k < NODES; k += TOGETHER) {
    if (loads[k] == 0) { continue; }
    var sum = vec3f();
    for (var e = readers[k]; e < readers[k + 1]; e++) { sum += reach[readers[e]].weight * impulses[readers[e] / 27].xyz; }
    velocity[k] += vec4f(nodes[k].inverse * sum, 0);
  }
  storageBarrier();
}

@compute @workgroup_size(TOGETHER)
fn resolve(@builtin(local_invocation_id) id: vec3u) {
  let thread = id.x;
  var acting = 0.0;
  for (var s = thread; s < SAMPLES; s += TOGETHER) {
    if (impulses[s].w == 0) { continue; }
    acting = 1.0;
    var sum = 0.0;
    for (var k = 27 * s; k < 27 * s + 27; k++) {
      if (reach[k].node < NODES) { sum += abs(reach[k].weight) * loads[reach[k].node]; }
    }
    for (var i = OBSTACLES * s; i < OBSTACLES * (s + 1); i++) { touches[i].step = select(0.0, 1.0 / sum, sum > 0); }
  }
  if (most(thread, acting) == 0) { return; }
  var theta = 1.0;
  var back = false; // whether the momentum led the wrong way: it then starts again
  for (var round = 0u; round < ITERATIONS; round++) {
    var lacks = 0.0;
    for (var s = thread; s < SAMPLES; s += TOGETHER) {
      if (impulses[s].w == 0) { continue; }
      let moving = movingAt(s);
      for (var i = OBSTACLES * s; i < OBSTACLES * (s + 1); i++) {
        let own = touches[i];
        if (own.acts == 0) { continue; }
        let along = dot(moving, own.normal);
        let lacking = own.wanted - along;
        lacks = max(lacks, lacking);
        let ahead = dot(own.applied, own.normal);
        let press = max(ahead + own.step * lacking, 0.0);
        let rub = (1.0 - CREEP) * (own.applied - ahead * own.normal) - own.step * (moving - along * own.normal);
        touches[i].next = press * own.normal + min(own.friction * press / max(length(rub), TINY), 1.0) * rub;
      }
    }
    lacks = most(thread, lacks);
    if (round > 0 && lacks * now.dt < TOLERANCE * DX) { break; }
    let following = 0.5 * (1.0 + sqrt(1.0 + 4.0 * theta * theta));
    let momentum = select((theta - 1.0) / following, 0.0, back || round == ITERATIONS - 1);
    theta = select(following, 1.0, back);
    var against = 0.0;
    for (var s = thread; s < SAMPLES; s += TOGETHER) {
      if (impulses[s].w == 0) { continue; }
      var sum = vec3f();
      for (var i = OBSTACLES * s; i < OBSTACLES * (s + 1); i++) {
        let own = touches[i];
        if (own.acts == 0) { continue; }
        let applied = own.next + momentum * (own.next - own.last);
        against += dot(own.applied - own.next, own.next - own.last);
        sum += applied - own.applied;
        touches[i].applied = applied;
        touches[i].last = own.next;
      }
      impulses[s] = vec4f(sum, impulses[s].w);
    }
    back = summed(thread, against) > 0;
    give(thread);
  }
  for (var s = thread; s < SAMPLES; s += TOGETHER) {
    if (impulses[s].w == 0) { continue; }
    var sum = vec3f();
    for (var i = OBSTACLES * s; i < OBSTACLES * (s + 1); i++) { sum += touches[i].last - touches[i].applied; }
    impulses[s] = vec4f(sum, impulses[s].w);
  }
  give(thread);
}
