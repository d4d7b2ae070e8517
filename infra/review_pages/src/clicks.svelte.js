// What is clicked in one picture: what is chosen, put, dragged, nudged and taken back.

const hundredth = (value) => Math.round(100 * value) / 100;

export class Clicks {
  chosen = $state(null); // { kind, name, vertex }
  loupe = $state(null);
  loupeLeft = $state(false);
  frame = null;

  #dragging = null; // { kind, name, was }
  #nudging = null; // { kind, name, was, timer }

  constructor(info, edits, preview) {
    this.info = info;
    this.edits = edits;
    this.preview = preview;
    this.found = $derived(preview.refined ?? preview.now);
    this.wrong = $derived(new Set(preview.now?.wrong ?? []));
    this.names = $derived([
      ...Object.keys(edits.points).map((name) => ({ kind: "point", name })),
      ...Object.keys(edits.drawn).map((name) => ({ kind: "marking", name })),
    ]);
    this.status = $derived(Object.fromEntries(this.names.map(({ name }) => [name, this.wrong.has(name) ? "wrong" : "good"])));
    this.next = $derived((preview.now?.add_next ?? []).filter((name) => !this.status[name]));
    this.expected = $derived(
      this.chosen?.kind === "point" && !edits.points[this.chosen.name] ? (this.found?.points[this.chosen.name] ?? null) : null,
    );
  }

  // Mouse events of an image's frame.
  handlers = {
    click: (place) => this.#clicked(place),
    clickMark: (mark, vertex, place) => this.#clickedMark(mark, vertex, place),
    dragStart: (mark, vertex) => {
      this.settleNudge();
      this.chosen = { kind: mark.kind, name: mark.name, vertex };
      this.#dragging = { kind: mark.kind, name: mark.name, was: this.edits.value(mark.kind, mark.name) };
    },
    dragMove: (mark, vertex, place) => this.#drag(mark, vertex, place),
    dragEnd: (mark, vertex, place) => {
      this.#drag(mark, vertex, place);
      const { kind, name, was } = this.#dragging;
      this.#dragging = null;
      this.loupe = null;
      this.edits.commit(kind, name, was, this.edits.value(kind, name));
      this.ask();
    },
  };

  ask() {
    this.preview.ask({ points: { ...this.edits.points }, drawn: { ...this.edits.drawn } });
  }

  // The marks as they are drawn.
  marks() {
    const { edits, chosen, wrong } = this;
    const points = Object.entries(edits.points).map(([name, place]) => ({
      kind: "point", name, places: [place], wrong: wrong.has(name), chosen: chosen?.name === name,
    }));
    const drawn = Object.entries(edits.drawn).map(([name, places]) => ({
      kind: "marking", name, places, line: places, wrong: wrong.has(name),
      chosen: chosen?.name === name, vertex: chosen?.name === name ? chosen.vertex : undefined,
    }));
    return [...points, ...drawn];
  }

  #within(place) {
    return place.map((value, k) => Math.max(-0.5, Math.min(this.info.size[k] - 0.5, hundredth(value))));
  }

  #with(kind, name, vertex, at) {
    return kind === "point" ? at : this.edits.drawn[name].map((each, k) => (k === vertex ? at : each));
  }

  #drag(mark, vertex, place) {
    const at = this.#within(place);
    this.edits.show(mark.kind, mark.name, this.#with(mark.kind, mark.name, vertex, at));
    this.loupe = at;
    this.loupeLeft = this.frame.stage.getPointerPosition()?.x > this.frame.stage.width() / 2;
    this.ask();
  }

  #clicked(place) {
    this.settleNudge();
    if (!this.chosen) return;
    const at = this.#within(place);
    if (at[0] !== hundredth(place[0]) || at[1] !== hundredth(place[1])) return; // beside the picture
    this.#put(at);
  }

  // What is to be put here may lie upon another mark.
  #clickedMark(mark, vertex, at) {
    const { chosen, edits } = this;
    const drawing = chosen && chosen.name !== mark.name && (chosen.kind === "marking" || !edits.points[chosen.name]);
    if (drawing) this.#clicked(at);
    else {
      this.settleNudge();
      this.chosen = { kind: mark.kind, name: mark.name, vertex };
    }
  }

  #put(at) {
    const { kind, name } = this.chosen;
    const was = this.edits.value(kind, name);
    if (kind === "point") this.edits.commit(kind, name, was, at);
    else {
      this.edits.commit(kind, name, was, [...was, at]);
      this.chosen = { kind, name, vertex: was.length };
    }
    this.ask();
  }

  putExpected() {
    if (this.expected) this.#put(this.#within(this.expected));
  }

  choose(kind, name) {
    this.settleNudge();
    const value = this.edits.value(kind, name);
    this.chosen = { kind, name, vertex: kind === "marking" && value.length ? value.length - 1 : 0 };
  }

  #place() {
    if (!this.chosen) return null;
    const value = this.edits.value(this.chosen.kind, this.chosen.name);
    return this.chosen.kind === "point" ? value : (value[this.chosen.vertex] ?? null);
  }

  closeUp() {
    const at = this.#place() ?? this.expected;
    if (at) this.frame.lookAt(at);
  }

  nudge(dx, dy) {
    const at = this.#place();
    if (!at) return;
    const { kind, name, vertex } = this.chosen;
    this.#nudging ??= { kind, name, was: this.edits.value(kind, name) };
    const moved = this.#within([at[0] + dx, at[1] + dy]);
    this.edits.show(kind, name, this.#with(kind, name, vertex, moved));
    if (!this.frame.isInView(moved)) this.frame.lookAt(moved, this.frame.stage.scaleX());
    this.loupe = moved;
    this.loupeLeft = false;
    this.ask();
    clearTimeout(this.#nudging.timer);
    this.#nudging.timer = setTimeout(() => this.settleNudge(), 700);
  }

  // Nudges in a row are one edit.
  settleNudge() {
    if (!this.#nudging) return;
    clearTimeout(this.#nudging.timer);
    const { kind, name, was } = this.#nudging;
    this.#nudging = null;
    this.loupe = null;
    this.edits.commit(kind, name, was, this.edits.value(kind, name));
  }

  remove() {
    this.settleNudge();
    if (!this.chosen) return;
    const { kind, name, vertex } = this.chosen;
    const was = this.edits.value(kind, name);
    if (!was || !was.length) return;
    const left = kind === "point" ? null : was.filter((_, k) => k !== vertex);
    this.edits.commit(kind, name, was, left);
    if (kind === "marking" && left.length) this.chosen = { kind, name, vertex: Math.min(vertex, left.length - 1) };
    this.ask();
  }

  undo = () => this.#again(() => this.edits.undo());
  redo = () => this.#again(() => this.edits.redo());

  #again(step) {
    this.settleNudge();
    const edit = step();
    if (edit) this.choose(edit.kind, edit.name);
    this.ask();
  }

  settle(mine) {
    this.edits.settle(mine);
    this.ask();
  }

  worst = () => {
    const residuals = this.preview.now?.residuals ?? [];
    if (!residuals.length) return;
    const at = residuals.findIndex((each) => each.name === this.chosen?.name);
    this.choose("point", residuals[(at + 1) % residuals.length].name);
    this.closeUp();
  };

  suggest = () => {
    if (!this.next.length) return;
    const name = this.next[(this.next.indexOf(this.chosen?.name) + 1) % this.next.length];
    this.choose(name in this.info.pitch.points ? "point" : "marking", name);
    if (this.expected) this.closeUp();
  };

  cycle(step) {
    if (!this.names.length) return;
    const at = this.names.findIndex((each) => each.name === this.chosen?.name);
    const each = this.names[(at + step + this.names.length) % this.names.length];
    this.choose(each.kind, each.name);
    this.closeUp();
  }
}
