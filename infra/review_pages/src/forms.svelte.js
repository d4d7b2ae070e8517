// Forms of matches being created. A form is saved while its user is on other pages too, until the server has it.
import { get, post, Refusal, retrying } from "./api.js";
import { messages } from "./messages.svelte.js";

const unsaved = new Map(); // by id of the draft

addEventListener("beforeunload", (event) => {
  if (unsaved.size) event.preventDefault();
});

export const openForm = (id) => unsaved.get(id) ?? new Form(id);

// Fields left empty are no keys: the check then says what is needed.
function filled(value) {
  if (Array.isArray(value)) return value.map(filled);
  if (value === null || typeof value !== "object") return value;
  const kept = Object.entries(value).filter(([, each]) => each !== null && each !== undefined && each !== "");
  return Object.fromEntries(kept.map(([key, each]) => [key, filled(each)]));
}

class Form {
  draft = $state(null); // as the server has it: files and problems
  content = $state(null); // match.yaml as it is being filled in
  saving = $state("saved");
  lost = $state("");
  isOvertaken = $state(false); // another page saved the form, and what changed here is not in it
  revision = 0; // of the saved form that `content` began with
  #sent = ""; // content of the last save
  #isSending = false;
  #timer = null;
  #last = Promise.resolve();

  constructor(id) {
    this.id = id;
    this.path = `/api/drafts/${encodeURIComponent(id)}`;
  }

  async load() {
    try {
      this.show(await get(this.path));
      this.lost = "";
    } catch (error) {
      this.lost = retrying(error);
    }
  }

  // Show the draft as the server answers it; a form that another page saved only if nothing is unsaved here.
  show(found) {
    if (!this.draft || found.revision >= this.draft.revision) this.draft = found; // else asked for before the last save
    if (this.content === null) this.take();
    if (this.#isSending || this.draft.revision === this.revision) return;
    if (JSON.stringify(this.draft.content) === this.#sent) this.revision = this.draft.revision; // the answer was lost
    else if (this.saving === "saved") this.take();
    else [this.isOvertaken, this.saving] = [true, "not saved"];
  }

  // Take the form of the server; what is unsaved here is dropped.
  take() {
    this.content = { cameras: [], clips: [], ...$state.snapshot(this.draft.content) };
    this.revision = this.draft.revision;
    this.isOvertaken = false;
    this.settle();
  }

  settle() {
    clearTimeout(this.#timer);
    this.saving = "saved";
    unsaved.delete(this.id);
  }

  change() {
    unsaved.set(this.id, this);
    this.saving = this.isOvertaken ? "not saved" : "saving …";
    this.#saveIn(500);
  }

  // One save at a time: each is of the revision that the one before made.
  #saveIn(milliseconds) {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => (this.#last = this.#last.then(() => this.#send())), milliseconds);
  }

  async #send() {
    if (this.isOvertaken || this.saving === "saved") return;
    const content = filled($state.snapshot(this.content));
    this.#sent = JSON.stringify(content);
    this.#isSending = true;
    const answer = await post(`${this.path}/form`, { revision: this.revision, content }).catch((error) => ({ error }));
    this.#isSending = false;
    if (!answer.error) {
      this.revision = answer.revision;
      this.lost = "";
      if (JSON.stringify(filled($state.snapshot(this.content))) === this.#sent) this.settle();
      this.show(answer);
    } else if (unsaved.has(this.id)) this.#explain(answer.error);
  }

  async #explain(error) {
    this.saving = "not saved";
    if (error.status === 409) {
      await this.load(); // it is overtaken, or the answer to a save was lost
      if (!this.isOvertaken) this.change();
    } else if (error instanceof Refusal && error.status < 500) messages.tell(error.message);
    else {
      this.lost = retrying(error);
      this.#saveIn(3000);
    }
  }
}
