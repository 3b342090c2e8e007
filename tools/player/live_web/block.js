// Reads the block that player/live_web/block.py packs: the length of its head, the head, and its arrays.

import { reader, unfold } from "../bundle.js";

const KINDS = { i1: Int8Array, i2: Uint16Array, i4: Int32Array, f4: Float32Array };

/**
 * @param {Uint8Array} bytes
 * @returns {{head: any, arrays: Record<string, any>}} float32 arrays come as float64
 */
export function readBlock(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const size = view.getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + size)));
  let at = 4 + size;
  /** @type {Record<string, Float64Array | Int32Array>} */
  const arrays = {};
  for (const [name, kind, count] of head.arrays) {
    const length = Number(kind[1]) * count;
    const part = bytes.subarray(at, at + length);
    if (part.length !== length) throw new Error("the block of the solver is too short");
    const values = reader(part)(KINDS[kind], count);
    arrays[name] = kind === "f4" ? Float64Array.from(values) : kind === "i2" ? Int16Array.from(values, unfold) : values;
    at += length;
  }
  return { head, arrays };
}
