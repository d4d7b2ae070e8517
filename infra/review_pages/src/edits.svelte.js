// Clicks of a user, with undo, redo and autosave.
//
// Every edit includes the value that it replaces (`was`). The server accepts the edit if it still has that
// value. Otherwise another user has changed the value first, and the page asks which of the two values to keep. An
// edit keeps its id until the server has acknowledged it, so the server stores an edit that it receives twice only once.

import { matchPath, newId, post, Refusal } from "./api.js";

const same = (a, b) => JSON.stringify(a ?? null) === JSON.stringify(b ?? null);
const RETRY = 2000; // [ms]

export class Edits {
  points = $state({});
  drawn = $state({});
  done = $state([]);
  undone = $state([]);
  state = $state("saved"); // saved, saving, unsaved, refused
  problem = $state("");
  conflict = $state(null);
  #waiting = [];
  #sending = false;

  constructor(match, owner, frame, clicked) {
    this.match = match;
    this.owner = owner;
    this.frame = frame;
    this.points = { ...clicked.points };
    this.drawn = { ...clicked.drawn };
  }

  value(kind, name) {
    return kind === "point" ? (this.points[name] ?? null) : (this.drawn[name] ?? []);
  }

  // What is on the screen, before it is an edit: while something is dragged.
  show(kind, name, xy) {
    const shown = kind === "point" ? this.points : this.drawn;
    if (xy === null || xy.length === 0) delete shown[name];
    else shown[name] = xy;
  }

  // An edit of what was `was` before it was shown.
  commit(kind, name, was, xy) {
    this.show(kind, name, xy);
    if (same(was, xy)) return;
    this.done.push({ kind, name, was, xy });
    this.undone = [];
    this.#keep({ kind, name, was, xy });
  }

  // Several markings as one edit, for undo and redo.
  commitTogether(drawn) {
    const group = newId("redrawn_marking");
    for (const [name, xy] of Object.entries(drawn)) {
      const edit = { kind: "marking", name, was: this.value("marking", name), xy, group };
      this.show(edit.kind, name, xy);
      this.done.push(edit);
      this.#keep(edit);
    }
    this.undone = [];
  }

  undo() {
    const edit = this.done.pop();
    if (!edit) return null;
    this.undone.push(edit);
    this.show(edit.kind, edit.name, edit.was);
    this.#keep({ ...edit, was: edit.xy, xy: edit.was });
    return edit.group && this.done.at(-1)?.group === edit.group ? this.undo() : edit;
  }

  redo() {
    const edit = this.undone.pop();
    if (!edit) return null;
    this.done.push(edit);
    this.show(edit.kind, edit.name, edit.xy);
    this.#keep(edit);
    return edit.group && this.undone.at(-1)?.group === edit.group ? this.redo() : edit;
  }

  get pending() {
    return this.#waiting.length;
  }

  // Somebody else was quicker: theirs stays, or mine goes over it.
  settle(mine) {
    const { kind, name, now } = this.conflict;
    const ours = this.#waiting.filter((each) => each.kind === kind && each.name === name);
    this.#waiting = this.#waiting.filter((each) => !ours.includes(each));
    this.conflict = null;
    // What was done to it here is no longer a step from one state to the next.
    const others = (edit) => edit.kind !== kind || edit.name !== name;
    this.done = this.done.filter(others);
    this.undone = this.undone.filter(others);
    const wanted = ours[ours.length - 1]?.xy;
    this.show(kind, name, now);
    if (mine && ours.length) this.commit(kind, name, now, wanted);
    else this.#send();
  }

  #keep(edit) {
    const kind = edit.kind === "point" ? "moved_point" : "redrawn_marking";
    const id = newId(kind);
    this.#waiting.push({ ...edit, id });
    this.#send();
  }

  async #send() {
    if (this.#sending || this.conflict) return;
    if (!this.#waiting.length) {
      this.state = "saved";
      return;
    }
    this.#sending = true;
    this.state = "saving";
    const batch = this.#waiting.slice(0, 50);
    try {
      await post(`${matchPath(this.match)}/corrections`, {
        edits: batch.map((each) => ({
          id: each.id,
          edit: {
            kind: each.kind === "point" ? "moved_point" : "redrawn_marking",
            camera: this.owner,
            frame: this.frame,
            marking: each.name,
            was: each.was,
            xy: each.xy,
          },
        })),
      });
      this.#waiting.splice(0, batch.length);
      this.problem = "";
      this.#sending = false;
      this.#send();
    } catch (error) {
      this.#sending = false;
      this.problem = error.message;
      if (error instanceof Refusal && error.status === 409) {
        const difference = error.body.difference;
        const kind = batch.find((each) => each.name === difference.marking)?.kind ?? "point";
        this.conflict = { ...difference, kind, name: difference.marking };
        this.state = "refused";
      } else if (error instanceof Refusal && error.status < 500) {
        this.state = "refused"; // sent again it would be refused again
      } else {
        this.state = "unsaved";
        setTimeout(() => this.#send(), RETRY);
      }
    }
  }
}
