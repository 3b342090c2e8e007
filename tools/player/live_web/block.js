// Reads the block that player/live_web/block.py packs: the length of its head, the head, and its arrays.

const WHOLE = { i1: Int8Array, i2: Int16Array, i4: Int32Array };

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
    const part = bytes.slice(at, at + length).buffer;
    if (part.byteLength !== length) throw new Error("the block of the solver is too short");
    arrays[name] = kind === "f4" ? Float64Array.from(new Float32Array(part)) : new WHOLE[kind](part);
    at += length;
  }
  return { head, arrays };
}
