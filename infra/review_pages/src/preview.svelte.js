// The camera that the clicks make, requested after every change; the last answer counts.

import { picturePath, post } from "./api.js";

const QUIET = 500; // [ms] without a change before the search for painted lines

export class Preview {
  now = $state(null); // of the clicks alone
  refined = $state(null); // of clicks and painted lines; null as soon as something changes
  advice = $state("");
  problem = $state("");
  refining = $state(false);
  asking = $state(false);
  #asked = null;
  #busy = false;
  #quiet = null;
  #turn = 0;

  constructor(match, owner, frame, hasPicture, ondrawn) {
    this.path = picturePath(match, owner, "/preview", frame);
    this.hasPicture = hasPicture;
    this.ondrawn = ondrawn;
  }

  // What is clicked has changed.
  ask(clicked) {
    this.#turn++;
    this.refined = null;
    this.#asked = { clicked, since: performance.now() };
    clearTimeout(this.#quiet);
    this.#next();
  }

  stop() {
    this.#turn++;
    this.hasPicture = false;
    this.#asked = null;
    clearTimeout(this.#quiet);
  }

  async #next() {
    if (this.#busy || !this.#asked) return;
    this.#busy = this.asking = true;
    const { clicked, since } = this.#asked;
    this.#asked = null;
    try {
      const found = await post(this.path, clicked);
      this.problem = "";
      this.advice = found.camera ? "" : `${found.expected}. ${found.todo}`;
      this.now = found.camera ? found : null;
      this.ondrawn(this.now);
      this.#shown(since);
      if (!this.#asked) this.#quiet = setTimeout(() => this.#refine(clicked), QUIET);
    } catch (error) {
      this.problem = error.message;
    } finally {
      this.#busy = this.asking = false;
      this.#next();
    }
  }

  // How long it took until the browser has painted it, with all that the page says of it.
  #shown(since) {
    requestAnimationFrame(() => setTimeout(() => performance.measure("preview", { start: since, end: performance.now() })));
  }

  async #refine(clicked) {
    if (!this.hasPicture || !this.now) return;
    const turn = this.#turn;
    this.refining = true;
    try {
      const found = await post(this.path, { ...clicked, refine: true });
      if (turn === this.#turn && found.camera) {
        this.refined = found;
        this.ondrawn(found);
      }
    } catch (error) {
      this.problem = error.message;
    } finally {
      this.refining = false;
    }
  }
}
