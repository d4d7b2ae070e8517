// The people in one frame of a camera: what is seen, what the other cameras say, what was corrected.

import { get, matchPath, newId, post } from "./api.js";
import { messages } from "./messages.svelte.js";

export class People {
  info = $state(null);
  problem = $state("");
  who = $state(null); // number of a detection
  joint = $state(null); // its place in COCO-17
  views = $state(null); // what the other cameras say of the chosen person
  queue = $state(null); // unreviewed detections
  done = $state([]); // ids of corrections made here
  busy = $state(false);

  scene = null; // address of the people in 3D, with its run; null without any

  #last = Promise.resolve();
  #pending = 0; // steps that are not done yet
  #frame = null; // the frame asked for last
  #asking = false;
  #wanted = null;
  #unseen = null; // why the other cameras said nothing

  constructor(match, owner) {
    this.owner = owner;
    this.path = matchPath(match);
    this.where = `${this.path}/detections/${encodeURIComponent(owner)}`;
  }

  get chosen() {
    return this.info?.people.find((each) => each.detection === this.who);
  }

  async load(number = this.#frame) {
    this.#frame = number;
    try {
      const found = await get(number === null ? this.where : `${this.where}?frame=${number}`);
      found.placed = await this.#placed(found);
      if (number !== this.#frame) return; // another one is wanted now
      this.info = found;
      if (!found.people.some((each) => each.detection === this.who)) this.choose(null);
      else this.ask();
      this.problem = "";
    } catch (error) {
      this.problem = error.message;
    }
  }

  // The people in 3D, projected into the image.
  async #placed(found) {
    if (!this.scene) return [];
    const [address, run] = this.scene.split("?");
    try {
      return (await get(`${address}/views/${encodeURIComponent(this.owner)}?${run}&frame=${found.frame}`)).people;
    } catch (error) {
      found.note ||= `The people in 3D are not shown: ${error.message}`;
      return [];
    }
  }

  async loadQueue() {
    try {
      this.queue = await get(`${this.where}/queue`);
    } catch (error) {
      this.problem = error.message;
    }
  }

  choose(who, joint = null) {
    if (who !== this.who) this.views = null;
    this.who = who;
    this.joint = joint;
    this.ask();
  }

  // What the other cameras say, of the joint at a place while it is dragged; the last question counts.
  ask(at = null) {
    this.#wanted = this.who === null ? null : { who: this.who, joint: this.joint, at };
    if (this.who === null) this.views = null;
    else if (!this.#asking) this.#answer();
  }

  async #answer() {
    this.#asking = true;
    while (this.#wanted) {
      const { who, joint, at } = this.#wanted;
      this.#wanted = null;
      const asked = new URLSearchParams({ frame: this.info.frame, detection: who });
      if (joint !== null) asked.set("joint", joint);
      if (at) ["x", "y"].forEach((name, k) => asked.set(name, at[k]));
      try {
        const found = await get(`${this.where}/views?${asked}`);
        if (who === this.who) this.views = found;
        if (this.problem === this.#unseen) this.problem = "";
      } catch (error) {
        this.views = null;
        this.problem = this.#unseen = error.message;
      }
    }
    this.#asking = false;
  }

  // One after the other.
  #inTurn(step) {
    this.#pending += 1;
    this.#last = this.#last.then(async () => {
      this.busy = true;
      try {
        await step();
      } catch (error) {
        messages.tell(error.message);
        await this.load();
      } finally {
        this.#pending -= 1;
        this.busy = false;
      }
    });
    return this.#last;
  }

  // Another run numbers detections anew; what was corrected before is of the one before.
  renew() {
    return this.#inTurn(async () => {
      this.choose(null);
      await this.load();
    });
  }

  // The edit is of the frame that is shown now, whichever is shown in its turn.
  #correct(edit) {
    const id = newId(edit.kind);
    const whole = { camera: this.owner, frame: this.info.frame, ...edit };
    return this.#inTurn(async () => {
      await post(`${this.path}/corrections`, { edits: [{ id, edit: whole }] });
      await this.#show(id);
    });
  }

  // What is saved; what waits for its turn is on the screen already.
  async #show(id) {
    if (this.#pending === 1) await this.load();
    this.done.push(id);
    this.loadQueue();
  }

  move(detection, joint, was, xy) {
    // On the screen at once, where it was put.
    this.info.people.find((each) => each.detection === detection).keypoints[joint] = xy;
    return this.#correct({ kind: "moved_keypoint", detection, joint: this.info.joints[joint], was, xy });
  }

  hide() {
    const was = this.joint === null ? null : this.chosen?.keypoints[this.joint];
    if (was) return this.move(this.who, this.joint, was, null);
  }

  // A joint that is not seen is put where the other cameras expect it.
  putExpected() {
    const xy = this.joint === null ? null : this.views?.here?.expected[this.joint];
    if (xy && this.chosen) return this.move(this.who, this.joint, this.chosen.keypoints[this.joint], xy);
  }

  // The chosen keypoint moves along a straight line from its last correction to here.
  fillIn() {
    if (this.joint === null || !this.chosen) return;
    const what = { frame: this.info.frame, detection: this.who, joint: this.info.joints[this.joint] };
    return this.#inTurn(async () => {
      const { kept } = await post(`${this.where}/interpolation`, what);
      await this.#show(kept);
    });
  }

  drop() {
    const { chosen, who: detection } = this;
    if (!chosen) return;
    this.info.people = this.info.people.filter((each) => each.detection !== detection);
    return this.#correct({ kind: "deleted_detection", detection, was: chosen.box });
  }

  async add(box, keypoints) {
    const detection = this.info.free;
    await this.#correct({ kind: "added_detection", detection, box, keypoints });
    if (this.info.people.some((each) => each.detection === detection)) this.choose(detection);
  }

  undo() {
    return this.#inTurn(async () => {
      if (!this.done.length) return;
      for (const correction of [this.done.at(-1)].flat()) await post(`${this.path}/withdrawals`, { correction });
      await this.load();
      this.done.pop();
      this.loadQueue();
    });
  }

  accept(what) {
    return this.#inTurn(async () => {
      this.queue = await post(`${this.where}/acceptances`, what);
    });
  }
}
