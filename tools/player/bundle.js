// The frames of a film, and the blocks of a .sway file; see docs/bundle.md and gaussian_swaying/player/film/page.py.
export const WIDTH = 2048; // of the textures with a texel for each Gaussian or node

/** Numbers out of planes: each call gives the next ones. @param {Uint8Array} bytes */
export function reader(bytes) {
  let at = 0;
  return (Kind, count) => {
    const size = Kind.BYTES_PER_ELEMENT;
    const out = new Uint8Array(count * size);
    for (let plane = 0; plane < size; plane++)
      for (let i = 0; i < count; i++) out[i * size + plane] = bytes[at++];
    return new Kind(out.buffer);
  };
}

/** Writes the displacements of all nodes [m], four numbers each: `near` has steps, `far` index and displacement of the few that swing far. */
export function writeNodes(data, near, far, step) {
  for (let i = 0, at = 0; i < near.length; i += 3, at += 4) {
    data[at] = step * near[i];
    data[at + 1] = step * near[i + 1];
    data[at + 2] = step * near[i + 2];
  }
  for (let i = 0; i < far.rows.length; i += 4) data.set(far.values.subarray(i + 1, i + 4), 4 * far.rows[i]);
}

// Bytes of a Gaussian, in the texels of each of its textures, as RECORD in page.py lists them: position and colour; rotation,
// size and growth; for those that move also their place in the grid, their stencil, and their normal.
export const TEXELS = { still: { rest: 16, shape: 15 }, moving: { rest: 16, shape: 15, place: 16, facing: 8 } };
const STEP = 16; // bytes of a texel

/** The numbers of a texture with four for each Gaussian, or node. */
export const texels = (count, Kind = Uint32Array) => new Kind(4 * WIDTH * Math.max(1, Math.ceil(count / WIDTH)));

/** Writes Gaussians of a kind into the textures with some names, from a place on, and returns how many; see pack_splats in page.py. */
export function fill(kind, bytes, from, /** @type {(name: string) => Uint32Array} */ texture) {
  const sizes = TEXELS[kind];
  const count = bytes.length / Object.values(sizes).reduce((sum, size) => sum + size);
  let at = 0;
  for (const name in sizes) {
    const out = new Uint8Array(texture(name).buffer, STEP * from, STEP * count);
    for (let k = 0; k < sizes[name]; k++) for (let i = k; i < out.length; i += STEP) out[i] = bytes[at++];
  }
  return count;
}

/** The 27 nodes of each stencil, as their rows in the list of nodes, in nine texels: those along z are together. */
export function rowsOf(stencils) {
  const rows = texels(stencils.length / 3);
  stencils.forEach((row, k) => (rows[4 * Math.floor(k / 3) + (k % 3)] = row));
  return rows;
}

/** Light of a head, as the shader takes it: direction, then (two-sided, ambient, relative, on). */
export function lightOf({ shader }) {
  const { light, two_sided, ambient, relative } = shader ?? { light: [0, 0, 1] };
  return { light, kind: [two_sided, ambient, relative, shader !== null].map((value) => Number(value ?? 0)) };
}

/** By how much a Gaussian may grow, as the shader takes it. */
export const limitOf = ({ max_stretch: most }) => (most === null ? 1e30 : most ** 2 - 1);

/** Head and stencils of a file. @param {(name: string) => Promise<Uint8Array>} read */
export async function readHead(read) {
  const head = JSON.parse(new TextDecoder().decode(await read("head")));
  return [head, reader(await read("stencils"))(Uint32Array, 27 * head.stencils)];
}

// The few nodes of each frame that swing far: index and displacement.
function readFar(bytes, frames) {
  const counts = reader(bytes.subarray(0, 4 * frames))(Uint32Array, frames);
  const rows = reader(bytes.subarray(4 * frames))(Int32Array, (bytes.length - 4 * frames) / 4);
  const values = new Float32Array(rows.buffer);
  let at = 0;
  return Array.from(counts, (count) => {
    const begin = at;
    at += 4 * count;
    return { rows: rows.subarray(begin, at), values: values.subarray(begin, at) };
  });
}

// The displacements of a film, which come in parts of some frames.
export class Frames {
  constructor({ frames, nodes, step, frame_dt }) {
    Object.assign(this, { step, interval: frame_dt, duration: frames * frame_dt });
    this.row = 3 * nodes;
    this.near = new Int16Array(frames * this.row);
    this.far = [];
  }

  get loaded() {
    return this.far.length;
  }

  add(bytes, count) {
    const begin = this.loaded * this.row;
    const end = begin + count * this.row;
    const size = 2 * (end - begin);
    const folded = reader(bytes.subarray(0, size))(Uint16Array, end - begin); // differences to the frame before, the sign in the last bit
    folded.forEach((value, k) => (this.near[begin + k] = ((value >> 1) ^ -(value & 1)) + (this.near[begin + k - this.row] ?? 0)));
    this.far.push(...readFar(bytes.subarray(size), count));
  }

  // The frame at a time [s], which starts anew after the end, as far as frames have come.
  at(seconds) {
    return Math.min(Math.floor((seconds % this.duration) / this.interval + 1e-6), this.loaded - 1);
  }

  // Writes the displacements of all nodes in a frame, four numbers each.
  write(data, frame) {
    writeNodes(data, this.near.subarray(frame * this.row, (frame + 1) * this.row), this.far[frame], this.step);
  }
}

async function inflate(packed) {
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Opens a .sway file: what is returned gives its blocks, one after the other while it comes. */
export async function blocks(url) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(`${url} cannot be read (${answer.status})`);
  const source = answer.body.getReader();
  let held = new Uint8Array(0);
  const take = async (count) => {
    while (held.length < count) {
      const { done, value } = await source.read();
      if (done) throw new Error(`${url} is cut short`);
      const both = new Uint8Array(held.length + value.length);
      both.set(held);
      both.set(value, held.length);
      held = both;
    }
    const found = held.slice(0, count);
    held = held.subarray(count);
    return found;
  };
  const number = (bytes) => new DataView(bytes.buffer).getUint32(0, true);
  const heading = await take(8).catch(() => [0]);
  if (String.fromCharCode(...heading.slice(0, 4)) !== "SWAY") throw new Error(`${url} is no .sway file`);
  if (number(heading.slice(4)) !== 1) throw new Error(`${url} is of a later version`);
  return async () => inflate(await take(number(await take(4))));
}

/** Reads a .sway film. @param {(head: any, stencils: Uint32Array, frames: Frames) => void} begin @param {(kind: string, bytes: Uint8Array) => void} add takes Gaussians */
export async function readFilm(url, begin, add) {
  const next = await blocks(url);
  const [head, stencils] = await readHead(next);
  const frames = new Frames(head);
  begin(head, stencils, frames);
  for (const [kind, first, last] of head.parts) {
    const bytes = await next();
    if (kind === "frames") frames.add(bytes, last - first);
    else add(kind, bytes);
  }
}
