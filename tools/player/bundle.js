// The frames of a film, and the blocks of a .sway file; see docs/bundle.md and gaussian_swaying/player/film/page.py.
import { reader, writeNodes } from "./gaussians.js";

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
  constructor({ frames, nodes, step }) {
    this.step = step;
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

  // Writes the displacements of all nodes in a frame, four numbers each.
  write(data, frame) {
    writeNodes(data, this.near.subarray(frame * this.row, (frame + 1) * this.row), this.far[frame], this.step);
  }
}

async function inflate(packed) {
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// The blocks of a .sway file, one after the other while it comes.
export async function* blocks(url) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(`${url} cannot be read (${answer.status})`);
  const source = answer.body.getReader();
  let held = new Uint8Array(0);
  // The next bytes, or null at the end of the file.
  const take = async (count) => {
    while (held.length < count) {
      const { done, value } = await source.read();
      if (done && held.length === 0) return null;
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
  const heading = await take(8);
  if (heading === null || String.fromCharCode(...heading.subarray(0, 4)) !== "SWAY") throw new Error(`${url} is no .sway file`);
  if (number(heading.slice(4)) !== 1) throw new Error(`${url} is of a later version`);
  for (let size = await take(4); size !== null; size = await take(4)) yield inflate(await take(number(size)));
}
