// Uploads in chunks. An upload continues while the user is on other pages, waits while the server does not answer, and
// resumes after a reload when the user chooses the same file again.
import { post, putBytes } from "./api.js";

const SMALLEST = 1 << 16;
const LARGEST = 1 << 23; // as the server takes them
const SECONDS = 1.5; // that one chunk should take: the server allows ten
const AT_ONCE = 2;

class Uploads {
  active = $state({}); // by id of the file: { draft, title, size, sent, problem, waiting }
  #queue = [];
  #running = 0;

  get list() {
    return Object.values(this.active);
  }

  // Begin or continue files; returns what was refused, as texts.
  async add(draft, files) {
    const refused = [];
    for (const file of files) {
      try {
        const given = { name: file.name, size: file.size, modified_ms: file.lastModified };
        const { file: id } = await post(`/api/drafts/${draft}/files`, given);
        if (this.active[id] && !this.active[id].problem) continue;
        this.active[id] = { id, draft, title: file.name, size: file.size, sent: 0, problem: "", waiting: false };
        this.#queue.push({ id, draft, file });
      } catch (error) {
        refused.push(error.message);
      }
    }
    while (this.#running < AT_ONCE && this.#queue.length) this.#work();
    return refused;
  }

  stop(id) {
    this.#queue = this.#queue.filter((each) => each.id !== id);
    delete this.active[id];
  }

  async #work() {
    this.#running++;
    for (let next = this.#queue.shift(); next; next = this.#queue.shift()) {
      if (await this.#send(next)) delete this.active[next.id];
    }
    this.#running--;
  }

  async #send({ id, draft, file }) {
    const path = `/api/drafts/${draft}/files/${id}/bytes?offset=`;
    let size = 1 << 18;
    let pause = 0.5;
    let offset = 0;
    let known = false; // whether the server has said how much of it it has
    while (this.active[id] && (offset < file.size || !known)) {
      let piece;
      try {
        piece = known ? await file.slice(offset, offset + size).arrayBuffer() : new ArrayBuffer(0);
      } catch {
        this.active[id].problem = "The file cannot be read any more: choose it again.";
        return false;
      }
      const begun = performance.now();
      let answer = null;
      try {
        answer = await putBytes(path + offset, piece);
      } catch {
        // the server does not answer
      }
      if (!this.active[id]) return true;
      if (answer?.status === 200 || answer?.status === 409) {
        known = true;
        offset = answer.content.received;
        const seconds = Math.max(0.001, (performance.now() - begun) / 1000);
        if (piece.byteLength) size = Math.min(LARGEST, Math.max(SMALLEST, Math.min(2 * size, (size * SECONDS) / seconds)));
        size = Math.floor(size);
        pause = 0.5;
        this.active[id] = { ...this.active[id], sent: offset, waiting: false };
      } else if (answer && answer.status < 500) {
        this.active[id].problem = answer.content.error ?? `the server answers ${answer.status}`;
        return false;
      } else {
        this.active[id].waiting = answer?.content.error ?? "the server does not answer; trying again";
        size = Math.max(SMALLEST, size >> 2);
        await new Promise((done) => setTimeout(done, 1000 * pause));
        pause = Math.min(10, 2 * pause);
      }
    }
    return true;
  }
}

export const uploads = new Uploads();
