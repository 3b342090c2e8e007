// What pages find: window.playFilm for films, window.watchWind for the live page, window.swayInWind for the page without a server.
import { dyno, SparkRenderer, SplatGenerator } from "@sparkjsdev/spark";
import { DataTexture, FloatType, Group, PerspectiveCamera, RGBAFormat, RGBAIntegerFormat, Scene, UnsignedIntType, Vector3, Vector4, WebGLRenderer } from "three";
import { play } from "./film.js";
import { positionsOf } from "./gaussians.js";
import { watch } from "./live.js";
import { sway } from "./live_web/page.js";
import { Playback } from "./playback.js";
import { makeSorter } from "./sorter.js";

// For tests of sway.js, which brings no engine.
const three = { DataTexture, FloatType, Group, PerspectiveCamera, RGBAFormat, RGBAIntegerFormat, Scene, UnsignedIntType, Vector3, Vector4, WebGLRenderer };
const engine = { three, spark: { dyno, SparkRenderer, SplatGenerator }, makeSorter, positionsOf };

Object.assign(window, { engine, playFilm: play, watchWind: watch, swayInWind: sway, Playback });
