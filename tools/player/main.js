// What pages find: window.playFilm for films, window.watchWind for the live page, window.swayInWind for the page without a server.
import { play } from "./film.js";
import { watch } from "./live.js";
import { sway } from "./live_web/page.js";
import { Playback } from "./playback.js";

Object.assign(window, { playFilm: play, watchWind: watch, swayInWind: sway, Playback });
