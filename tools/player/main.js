// What pages find: window.playFilm for films, window.watchWind for the live page.
import { play } from "./film.js";
import { watch } from "./live.js";
import { Playback } from "./playback.js";

Object.assign(window, { playFilm: play, watchWind: watch, Playback });
