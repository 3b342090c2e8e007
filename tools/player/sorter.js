// Sorts Gaussians by depth, the farthest first. It stands in for Spark's own sorter, which needs its WebAssembly.

const FEW = 1 << 16; // numbers that are sorted at once; more of them are sorted in a worker

// This function is sent to the worker as text, too, so it uses nothing from outside.
function makeSort() {
  const INFINITE = 0x7f800000; // bits of a float32; those of negative numbers and of NaN are larger
  const low = new Uint32Array(65536);
  const high = new Uint32Array(65536);
  let half = new Uint32Array(0);

  // Turns counts of digits into the place of each digit's first number, the largest digit first.
  function places(counts) {
    let sum = 0;
    for (let digit = 65535; digit >= 0; digit--) {
      const count = counts[digit];
      counts[digit] = sum;
      sum += count;
    }
    return sum;
  }

  // Two passes of 16 bits; bits of positive floats are in the order of the numbers. Returns how many there are.
  return ({ numSplats, readback, ordering }) => {
    if (half.length < numSplats) half = new Uint32Array(numSplats);
    low.fill(0);
    high.fill(0);
    for (let i = 0; i < numSplats; i++) {
      if (readback[i] >= INFINITE) continue;
      low[readback[i] & 65535]++;
      high[readback[i] >>> 16]++;
    }
    const activeSplats = places(low);
    places(high);
    for (let i = 0; i < numSplats; i++) if (readback[i] < INFINITE) half[low[readback[i] & 65535]++] = i;
    for (let k = 0; k < activeSplats; k++) ordering[high[readback[half[k]] >>> 16]++] = half[k];
    return activeSplats;
  };
}

const WORK = `
  const sort = (${makeSort})();
  self.onmessage = ({ data }) => {
    const { readback, ordering } = data;
    self.postMessage({ activeSplats: sort(data), readback, ordering }, [readback.buffer, ordering.buffer]);
  };
`;

// A `sortWorker` of Spark. `readback` holds the bits of the depths; what is infinitely far or has a negative depth is left out.
export function makeSorter() {
  const sort = makeSort();
  const url = URL.createObjectURL(new Blob([WORK], { type: "text/javascript" }));
  const waiting = []; // the worker answers in the order of the calls
  let worker = null;

  function start() {
    worker = new Worker(url);
    worker.onmessage = ({ data }) => waiting.shift().resolve(data);
    worker.onerror = (event) => waiting.shift()?.reject(new Error(event.message));
  }

  return {
    call: async (name, args) => {
      if (args.numSplats <= FEW) return { ...args, activeSplats: sort(args) };
      if (worker === null) start();
      return new Promise((resolve, reject) => {
        waiting.push({ resolve, reject });
        worker.postMessage(args, [args.readback.buffer, args.ordering.buffer]);
      });
    },
    dispose: () => worker?.terminate(),
  };
}
