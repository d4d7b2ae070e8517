// What the server refused: it stays on every page until a person dismisses it.
class Messages {
  list = $state([]);
  #last = 0;

  tell(text) {
    if (this.list.some((each) => each.text === text)) return;
    this.list.push({ id: ++this.#last, text });
  }

  dismiss(id) {
    this.list = this.list.filter((each) => each.id !== id);
  }
}

export const messages = new Messages();
