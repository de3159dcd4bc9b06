// The state of the page: the setup, what is pinned, and choices. It is in the address, and undone.

const KEPT = "quell-studio"; // name in the browser's storage
const PAUSE = 400; // changes within this time are one step of undo [ms]
const DEEPEST = 200; // steps of undo

export class Store {
  constructor(onChange) {
    this.onChange = onChange;
    this.past = [];
    this.future = [];
    this.state = null;
    this.committed = null;
  }

  // Replace the state; `structure` tells that forms have to be made again.
  set(state, structure = true, source = "") {
    this.state = state;
    this.onChange(state, structure, source);
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.commit(), PAUSE);
  }

  commit() {
    clearTimeout(this.timer);
    const now = JSON.stringify(this.state);
    if (now === this.committed) return;
    if (this.committed !== null) {
      this.past.push(this.committed);
      this.past.splice(0, Math.max(0, this.past.length - DEEPEST));
      this.future = [];
    }
    this.committed = now;
    this.keep();
  }

  keep() {
    history.replaceState(null, "", "#" + encode(this.committed));
    try {
      localStorage.setItem(KEPT, this.committed);
    } catch {
      // Without storage the address alone has the state.
    }
    this.onChange(this.state, false, "history");
  }

  undo(by = this.past, to = this.future) {
    this.commit();
    if (!by.length) return;
    to.push(this.committed);
    this.committed = by.pop();
    this.state = JSON.parse(this.committed);
    this.onChange(this.state, true, "undo");
    this.keep();
  }

  redo() {
    this.commit();
    if (this.future.length) this.undo(this.future, this.past);
  }

  // Return the state that the address, or else the last visit, has; null if there is none.
  static found() {
    for (const text of [() => decode(location.hash.slice(1)), () => localStorage.getItem(KEPT)]) {
      try {
        const state = JSON.parse(text());
        if (state && typeof state.setup === "object" && state.setup) return state;
      } catch {
        // Not a state: try the next place.
      }
    }
    return null;
  }
}

function encode(text) {
  const bytes = new TextEncoder().encode(text);
  let binary = "";
  for (const byte of bytes) binary += String.fromCharCode(byte);
  return btoa(binary).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}

function decode(text) {
  const binary = atob(text.replaceAll("-", "+").replaceAll("_", "/"));
  return new TextDecoder().decode(Uint8Array.from(binary, (c) => c.charCodeAt(0)));
}

// ---- paths of keys: plant.m1, scenario.disturbances[1].height

export function steps(path) {
  return [...path.matchAll(/([^.[\]]+)|\[(\d+)\]/g)].map((m) => m[1] ?? Number(m[2]));
}

export function at(setup, path) {
  return steps(path).reduce((part, key) => (part == null ? undefined : part[key]), setup);
}

// Return a copy with a value at a path; undefined removes the key.
export function changed(setup, path, value) {
  const copy = structuredClone(setup);
  const keys = steps(path);
  const last = keys.pop();
  let part = copy;
  keys.forEach((key, i) => {
    const next = i + 1 < keys.length ? keys[i + 1] : last;
    if (typeof part[key] === "string") part[key] = { kind: part[key] };
    if (part[key] == null || typeof part[key] !== "object") {
      part[key] = typeof next === "number" ? [] : {};
    }
    part = part[key];
  });
  if (value !== undefined) part[last] = value;
  else if (Array.isArray(part)) part.splice(last, 1);
  else delete part[last];
  return copy;
}
