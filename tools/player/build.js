// Writes film.min.js of the package, the programs of films and of both live pages with what they use of Spark and three.js,
// sway.min.js and sway-playcanvas.min.js for scenes of others, and worker.min.js, the solver in a browser.
import { build } from "esbuild";
import { createHash } from "node:crypto";
import { readFile } from "node:fs/promises";

const OWN = "brush.js build.js bundle.js film.glsl.js film.js gaussians.js live.js main.js panel.js playback.js sorter.js timeline.js tunnel.js view.js".split(" ");
OWN.push("live_web/page.js");
const SOLVER = "block.js body.js modal.js solver.js webgpu.js wind.js worker.js"
  .split(" ")
  .map((name) => `live_web/${name}`);
const SOURCES = [...OWN, "package-lock.json"]; // a test compares their checksum

// Spark's WebAssembly, in it and in its worker, reads files of splats, builds levels of detail and sorts. A film needs only
// the sorting, which sorter.js does. Each pattern must match once, so that another Spark is not cut without a look at it.
const CUTS = [
  [/^const WASM = decode64\(.*\n/gm, ""],
  [/^const WASM_MODULE = WebAssembly\.compile\(WASM\);$/gm, "const WASM_MODULE = Promise.resolve(null);"],
  [/^const initialization = __wbg_init\([^]*?\n\);$/gm, "const initialization = Promise.resolve();"],
  [/^const jsContent = .*$/gm, 'const jsContent = "";'],
];

async function cutSpark({ path }) {
  let contents = await readFile(path, "utf8");
  for (const [pattern, instead] of CUTS) {
    const found = contents.match(pattern)?.length ?? 0;
    if (found !== 1) throw new Error(`Expected ${pattern} once in ${path}, but found it ${found} times.`);
    contents = contents.replace(pattern, instead);
  }
  return { contents };
}

async function banner(sources) {
  const checksum = createHash("sha256");
  for (const name of sources) checksum.update(await readFile(name));
  return { js: `// Made by tools/player from ${checksum.digest("hex")}` };
}

await build({
  entryPoints: ["main.js"],
  outfile: "../../gaussian_swaying/player/film/page/film.min.js",
  bundle: true,
  minify: true,
  format: "iife",
  banner: await banner(SOURCES),
  legalComments: "eof", // the full licences are in LICENSES.txt, which stands in each film
  logLevel: "info",
  plugins: [{ name: "cut-spark", setup: (made) => made.onLoad({ filter: /spark\.module\.js$/ }, cutSpark) }],
});

// What plays a film in scenes of others, with the engine as its user has it.
for (const [name, own] of [["sway", ["gaussians.js", "sorter.js"]], ["sway-playcanvas", []]])
  await build({
    entryPoints: [`${name}.js`],
    outfile: `../../gaussian_swaying/player/film/page/${name}.min.js`,
    bundle: true,
    minify: true,
    format: "esm",
    external: ["three", "@sparkjsdev/spark", "playcanvas"],
    banner: await banner(["build.js", "bundle.js", "film.glsl.js", ...own, `${name}.js`]),
    logLevel: "info",
  });

await build({
  entryPoints: ["live_web/worker.js"],
  outfile: "../../gaussian_swaying/player/live_web/page/worker.min.js",
  target: "es2022",
  bundle: true,
  minify: true,
  format: "iife",
  banner: await banner(["build.js", "bundle.js", ...SOLVER, "package-lock.json"]),
  logLevel: "info",
});
