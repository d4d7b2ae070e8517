// Which key presses are shortcuts of a page.

const FIELDS = "textarea, select, [contenteditable], input:not([type=range], [type=checkbox], [type=radio])";

// Whether a key is text that a person writes, or belongs to an open dialog: then it is no shortcut.
export function isTyping(event) {
  return event.defaultPrevented || event.isComposing || Boolean(event.target.closest?.(FIELDS)) || document.querySelector("dialog[open]") !== null;
}

// Whether a held key repeats what its first press did: only moving on may be repeated.
export const isHeld = (event) => event.repeat && !/^(Arrow\w+|[jk])$/.test(event.key);

// The part of a page that was used last has the shortcuts; a page with one part has no areas.
let area = "";
export const enter = (name) => (area = name);
export const isIn = (...names) => area === "" || names.includes(area);
