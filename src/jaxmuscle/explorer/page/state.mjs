// What the page shows as text: in a link, and as steps that can be undone.

const VERSION = 1;

export function toFragment(state) {
  const bytes = new TextEncoder().encode(JSON.stringify({ v: VERSION, ...state }));
  return btoa(String.fromCharCode(...bytes))
    .replaceAll("+", "-")
    .replaceAll("/", "_")
    .replaceAll("=", "");
}

// The state of a link, or null where there is none; an Error for a link that is damaged or of another version.
export function fromFragment(fragment) {
  if (!fragment) return null;
  let state;
  try {
    const text = atob(fragment.replaceAll("-", "+").replaceAll("_", "/"));
    state = JSON.parse(new TextDecoder().decode(Uint8Array.from(text, (c) => c.charCodeAt(0))));
  } catch {
    throw new Error("This link is damaged. Copy it anew from the page that made it.");
  }
  if (state.v !== VERSION || !state.table) throw new Error("This link was made by another version of the page.");
  delete state.v;
  return state;
}

export class History {
  constructor(state) {
    this.past = [JSON.stringify(state)];
    this.future = [];
  }
  get first() {
    return JSON.parse(this.past[0]);
  }
  keep(state) {
    const text = JSON.stringify(state);
    if (text === this.past[this.past.length - 1]) return;
    this.past.push(text);
    this.future = [];
  }
  undo() {
    if (this.past.length > 1) this.future.push(this.past.pop());
    return JSON.parse(this.past[this.past.length - 1]);
  }
  redo() {
    if (this.future.length) this.past.push(this.future.pop());
    return JSON.parse(this.past[this.past.length - 1]);
  }
}
