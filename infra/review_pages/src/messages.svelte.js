// What the server refused: the newest takes the place of the one before, until a person dismisses it or leaves the page.
class Messages {
  text = $state("");

  tell(text) {
    this.text = text;
  }

  clear() {
    this.text = "";
  }
}

export const messages = new Messages();
