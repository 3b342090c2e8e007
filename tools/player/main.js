// What pages find: window.playFilm for films, window.watchWind for the live page, window.swayInWind for the page without a server.
import { dyno, SparkRenderer, SplatGenerator } from "@sparkjsdev/spark";
import { DataTexture, FloatType, Group, PerspectiveCamera, RGBAFormat, RGBAIntegerFormat, Scene, UnsignedIntType, Vector3, Vector4, WebGLRenderer } from "three";
import { blocks } from "./bundle.js";
import { play } from "./film.js";
import { positionsOf } from "./gaussians.js";
import { live } from "./live.js";
import { sway } from "./live_web/page.js";
import { element } from "./panel.js";
import { Playback } from "./playback.js";
import { makeSorter } from "./sorter.js";

// For tests of sway.js, which brings no engine.
const three = { DataTexture, FloatType, Group, PerspectiveCamera, RGBAFormat, RGBAIntegerFormat, Scene, UnsignedIntType, Vector3, Vector4, WebGLRenderer };
const engine = { three, spark: { dyno, SparkRenderer, SplatGenerator }, makeSorter, positionsOf };

// Plays a .sway file at an address.
async function playFile(url) {
  const message = element("message");
  try {
    await play(await blocks(url), (sentence) => Object.assign(element("note"), { textContent: sentence, hidden: false }));
    message.hidden = true;
  } catch (error) {
    message.textContent = error.message;
  }
}

Object.assign(window, { engine, playFile, playFilm: play, watchWind: live, swayInWind: sway, Playback });
