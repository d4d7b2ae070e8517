// Which key presses are shortcuts of a page.

const FIELDS = "textarea, select, [contenteditable], input:not([type=range], [type=checkbox], [type=radio])";

// Whether a key is text that a person writes, or belongs to an open dialog: then it is no shortcut.
export function isTyping(event) {
  return event.defaultPrevented || event.isComposing || Boolean(event.target.closest?.(FIELDS)) || document.querySelector("dialog[open]") !== null;
}

// Whether a held key repeats what its first press did: only moving on may be repeated, as by `more` keys of a part.
export const isHeld = (event, more = "") => event.repeat && !/^(Arrow\w+|Tab|[-+=jk])$/.test(event.key) && !more.includes(event.key);

// The part of a page that was used last has the shortcuts; a page with one part has no areas.
let area = "";
export const enter = (name) => (area = name);
export const isIn = (...names) => area === "" || names.includes(area);

// By how many frames a key moves on: by one, with Shift by a second, or to an end; 0 of another key.
const MOVES = { ArrowLeft: -1, ArrowRight: 1, Home: -Infinity, End: Infinity };
export const moveOf = (event, fps) => (event.altKey ? 0 : (MOVES[event.key] ?? 0) * (event.shiftKey ? Math.round(fps) : 1));
