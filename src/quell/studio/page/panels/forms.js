// Forms for the tables of a setup, made from the server's description of their keys.

import { element, field, input, select } from "../dom.js";
import { at } from "../store.js";
import { rovingSliders } from "./roving.js";
import { takes, typedList, typedNumber } from "./typed.js";

const TITLES = {
  plant: "Plant", observer: "Observer", controller: "Controller", learner: "Learner",
  guard: "Guard", prefilter: "Prefilter of the reference", scenario: "Scenario",
};
const NAMES = {
  omega_c: "ω_c [rad/s]", omega_o: "ω_o [rad/s]", u_min: "u_min", u_max: "u_max",
  disturbances: "disturbance", at: "at [s]", duration: "duration [s]", delay: "delay [s]",
  signals: "names and units", disturbance_order: "extended states of f",
};
// Keys with a field of their own even if the setup lacks them, and ranges of whole numbers.
const SHOWN = ["disturbance_order"];
const RANGES = { disturbance_order: [1, 3] };
const OPTIONAL = ["observer", "learner", "guard", "prefilter"];
const OPEN = ["plant", "observer", "controller"];
const PARTS = ["observer", "controller", "learner", "guard"]; // of one of several axes
const POLYNOMIALS = ["num", "den"];
const WHOLE = "whole number";

export class Forms {
  // `change(path, value, structure)` is called for each change.
  constructor(home, change) {
    this.home = home;
    this.change = change;
    this.kinds = null; // what the server says of the groups: of one axis, and of several
    this.anchors = new Map();
    this.unfolded = new Map();
    this.rove = rovingSliders(home);
  }

  build(setup) {
    this.setup = setup;
    const focus = document.activeElement?.dataset?.path;
    const kind = document.activeElement?.type;
    this.groups = setup.axis ? this.kinds.several : this.kinds.one;
    const parts = [this.sampling(), ...(setup.axis ? this.axes() : this.sections(Object.keys(TITLES)))];
    this.home.replaceChildren(...parts);
    if (focus) {
      const same = [...this.home.querySelectorAll("[data-path]")].filter((e) => e.dataset.path === focus);
      (same.find((e) => e.type === kind) ?? same[0])?.focus();
    }
    this.rove();
  }

  // Show another value of a path in the same form, in all its controls but the one that set it.
  refresh(setup, path, except) {
    this.setup = setup;
    for (const input of this.home.querySelectorAll("[data-path]")) {
      const own = input.dataset.path;
      const related = own.startsWith(path) || path.startsWith(own);
      if (!related || input === except || !input.showValue) continue;
      input.showValue(at(setup, own));
      input.recheck?.();
    }
  }

  sampling() {
    const entry = { key: "dt", type: "number", about: "sample time of the loop [s].", needed: true };
    const box = element("div", "plain");
    box.append(this.number(entry, "dt", "sample time [s]", false));
    return box;
  }

  sections(groups) {
    return groups.map((group) => this.section(group, TITLES[group], group, OPTIONAL.includes(group)));
  }

  section(group, title, path, optional) {
    const table = at(this.setup, path);
    const box = this.details(path, title, OPEN.includes(group) || (table != null && group !== "scenario"));
    if (optional) {
      const on = input("checkbox", path + "!", `Use: ${title}`);
      on.checked = table != null;
      on.onchange = () => this.change(path, on.checked ? this.fresh(group) : undefined, true);
      box.append(field(`Use`, on));
    }
    if (table != null) box.append(...this.table(group, table, path));
    return box;
  }

  // Return the sections of a setup of several axes: those of an axis are named after it.
  axes() {
    const ofAxis = (axis, i) => {
      const name = axis.name || `axis${i + 1}`;
      const parts = PARTS.map((group) => this.section(group, `${name}: ${TITLES[group].toLowerCase()}`, `axis[${i}].${group}`, ["learner", "guard"].includes(group)));
      const box = this.details(`axis[${i}] signals`, `${name}: reference and noise`, false);
      for (const key of ["reference", "noise"]) {
        const about = key === "noise" ? "signal added to y before the controller." : "signal that y has to follow.";
        box.append(this.signal({ key, about }, `axis[${i}].${key}`, key, axis[key]));
      }
      return [...parts, box];
    };
    return [
      ...this.sections(["plant"]), this.section("axes", "B0 and actuators", "axes", true),
      ...this.setup.axis.flatMap(ofAxis), ...this.sections(["scenario"]),
    ];
  }

  details(path, title, open) {
    const box = element("details", "group");
    box.open = this.unfolded.get(path) ?? open;
    box.ontoggle = () => this.unfolded.set(path, box.open);
    box.append(element("summary", "", title));
    return box;
  }

  // Return the fields of a table of one of the kinds of a group.
  table(group, table, path) {
    const kinds = this.groups[group];
    const names = Object.keys(kinds);
    const given = typeof table === "string" ? { kind: table } : table;
    const kind = given.kind ?? (group === "controller" ? "adrc" : names[0]);
    const parts = [];
    if (names.length > 1) {
      const choice = select(names, kind, path + ".kind", TITLES[group] ?? "kind");
      choice.onchange = () => this.change(path, this.fresh(group, choice.value), true);
      parts.push(field("kind", choice));
    }
    const about = kinds[kind];
    if (!about) return parts;
    if (names.length > 1 && about.about) parts.push(element("p", "about", about.about));
    const rest = [];
    for (const entry of about.keys) {
      const found = this.entry(entry, `${path}.${entry.key}`, given[entry.key]);
      const shown = entry.needed || SHOWN.includes(entry.key) || (given[entry.key] !== undefined && entry.group !== "labels");
      (shown ? parts : rest).push(found);
    }
    if (rest.length) {
      const more = element("details", "more");
      more.open = this.unfolded.get(path + " more") ?? false;
      more.ontoggle = () => this.unfolded.set(path + " more", more.open);
      more.append(element("summary", "", "More"), ...rest);
      parts.push(more);
    }
    return parts;
  }

  entry(entry, path, value) {
    const name = NAMES[entry.key] ?? entry.key.replaceAll("_", " ");
    if (entry.group === "signal") return this.signal(entry, path, name, value);
    if (entry.group === "feedforward") return this.feedforward(entry, path, name, value);
    if (entry.group) return this.inner(entry, path, name, value);
    if (entry.list_of) return this.list(entry, path, name, value);
    if (entry.type === "true or false") return this.flag(entry, path, name, value);
    if (entry.type === "number" || entry.type === WHOLE) return this.number(entry, path, name);
    if (entry.type === "text") return this.text(entry, path, name);
    return this.numbers(entry, path, name);
  }

  inner(entry, path, name, value) {
    const box = element("div", "inner");
    box.append(element("h3", "", name));
    const on = input("checkbox", path + "!", `Use: ${name}`);
    if (!entry.needed) {
      on.checked = value != null;
      on.onchange = () => this.change(path, on.checked ? this.fresh(entry.group) : undefined, true);
      box.append(field("Use", on));
    }
    if (value != null) box.append(...this.table(entry.group, value, path));
    return box;
  }

  // None, the reference's own derivatives over b0, or a table of a model.
  feedforward(entry, path, name, value) {
    const box = element("div", "inner");
    const kinds = ["none", "reference", ...Object.keys(this.groups.feedforward)];
    const kind = value === true ? "reference" : value ? (value.kind ?? value) : "none";
    const choice = select(kinds, kind, path + "!", name);
    choice.onchange = () => {
      const fresh = choice.value === "none" ? undefined : choice.value === "reference" ? true
        : this.fresh("feedforward", choice.value);
      this.change(path, fresh, true);
    };
    box.append(field(name, choice, entry.about));
    if (value && value !== true) {
      box.append(...this.table("feedforward", value, path).slice(1).filter((part) => part.className !== "about"));
    }
    return box;
  }

  signal(entry, path, name, value) {
    const box = element("div", "inner");
    const kinds = ["number", ...Object.keys(this.groups.signal)];
    const none = entry.key === "then" ? ["none"] : [];
    const kind = value === undefined || value === null ? (none[0] ?? "number")
      : typeof value === "number" ? "number" : Array.isArray(value) ? "a sum" : (value.kind ?? value);
    const shown = kind === "a sum" ? [...none, ...kinds, "a sum"] : [...none, ...kinds];
    const choice = select(shown, kind, path + "!", name);
    choice.onchange = () => {
      const fresh = choice.value === "number" ? 0 : choice.value === "none" ? undefined
        : this.fresh("signal", choice.value);
      this.change(path, fresh, true);
    };
    box.append(field(name, choice, entry.about));
    if (kind === "a sum") box.append(this.numbers(entry, path, "as JSON"));
    else if (kind === "number") box.append(this.number({ ...entry, type: "number", default: 0 }, path, "value"));
    else if (kind !== "none") {
      box.append(...this.table("signal", value, path).slice(1).filter((part) => part.className !== "about"));
    }
    return box;
  }

  list(entry, path, name, value) {
    const box = element("div", "inner");
    box.append(element("h3", "", entry.key === "disturbances" ? "Disturbances of the plant" : name));
    (value ?? []).forEach((part, i) => {
      const where = `${path}[${i}]`;
      if (entry.list_of === "signal") box.append(this.signal(entry, where, `${name} ${i + 1}`, part));
      else box.append(...this.table(entry.list_of, part, where));
      const remove = element("button", "", `Remove ${i + 1}`);
      remove.onclick = () => this.change(where, undefined, true);
      box.append(remove);
    });
    const add = element("button", "", "Add");
    add.setAttribute("aria-label", `Add to ${name}`);
    const fresh = () => (entry.list_of === "signal" ? this.fresh("signal", "step") : this.fresh(entry.list_of));
    add.onclick = () => this.change(path, [...(value ?? []), fresh()], true);
    box.append(add);
    return box;
  }

  flag(entry, path, name, value) {
    const on = input("checkbox", path, name);
    on.showValue = (now) => (on.checked = now ?? entry.default ?? false);
    on.showValue(value);
    on.onchange = () => this.change(path, on.checked, false, on);
    return field(name, on, entry.about);
  }

  text(entry, path, name) {
    const box = input("text", path, name);
    box.showValue = (now) => (box.value = now ?? entry.default ?? "");
    box.showValue(at(this.setup, path));
    box.onchange = () => this.change(path, box.value || undefined, false, box);
    return field(name, box, entry.about);
  }

  numbers(entry, path, name) {
    const box = input("text", path, name);
    box.placeholder = "[1, 2, 3]";
    box.showValue = (now) => (box.value = now === undefined ? "" : JSON.stringify(now));
    box.showValue(at(this.setup, path));
    const row = field(name, box, entry.about);
    takes(box, typedList, (value) => this.change(path, value, false, box));
    if (!POLYNOMIALS.includes(entry.key)) return row;
    const shape = () => JSON.stringify([at(this.setup, path)].flat().map(Boolean));
    const before = shape();
    // Other coefficients have other sliders: the form is made again, when the focus has moved on.
    box.onchange = () => setTimeout(() => shape() !== before && this.change(path, at(this.setup, path), true));
    const all = element("div");
    all.append(row, ...this.coefficients(entry, path));
    return all;
  }

  // Return sliders for the coefficients of a polynomial that are not zero.
  coefficients(entry, path) {
    const values = at(this.setup, path);
    if (!Array.isArray(values) || !values.every(Number.isFinite)) return [];
    return values.flatMap((value, i) => {
      const power = values.length - 1 - i;
      const name = `${entry.key}, ${power > 1 ? `s${[...String(power)].map((digit) => "⁰¹²³⁴⁵⁶⁷⁸⁹"[digit]).join("")}` : power ? "s" : "constant"}`;
      return value === 0 ? [] : [this.number({ type: "number", about: `Coefficient ${i + 1} of ${entry.key}.` }, `${path}[${i}]`, name)];
    });
  }

  // Return a number with, where it can slide, a slider: logarithmic for a positive one.
  number(entry, path, name, slides = entry.type === "number") {
    const box = input("text", path, name);
    box.inputMode = "decimal";
    const [low, high] = RANGES[entry.key] ?? [];
    const read = (text) => typedNumber(text, { whole: entry.type === WHOLE, low, high });
    box.showValue = (now) => {
      box.value = now ?? (Number.isFinite(entry.default) ? entry.default : "");
      if (now == null && entry.default === undefined) box.placeholder = "auto";
    };
    const value = at(this.setup, path) ?? (Number.isFinite(entry.default) ? entry.default : null);
    box.showValue(at(this.setup, path));
    const isEntry = path.endsWith("]"); // of a list, which keeps its length
    const set = (number, source) => (number !== undefined || !isEntry) && this.change(path, number, false, source);
    if (!slides || value === null || typeof value !== "number") {
      takes(box, read, (number) => set(number, box));
      return field(name, box, entry.about);
    }
    const slider = input("range", path, `${name}, slider`);
    const scale = this.scale(path, value);
    [slider.min, slider.max, slider.step] = scale.logarithmic ? [-1, 1, 0.005] : [-1, 1, 0.01];
    slider.showValue = (now) => {
      const shown = now ?? entry.default ?? value;
      slider.value = scale.place(shown);
      slider.setAttribute("aria-valuetext", String(shown));
    };
    slider.showValue(value);
    slider.oninput = () => {
      const number = scale.value(Number(slider.value));
      box.value = number;
      box.recheck();
      slider.setAttribute("aria-valuetext", String(number));
      set(number, slider);
    };
    takes(box, read, (number) => {
      set(number, box);
      if (number !== undefined) slider.showValue(number);
    });
    const row = field(name, slider, entry.about);
    row.classList.add("slides");
    row.append(box);
    return row;
  }

  // A slider goes a decade up and down from the value that it had first.
  scale(path, value) {
    let anchor = this.anchors.get(path);
    const usable = anchor !== undefined && Math.sign(anchor) === Math.sign(value)
      && Math.abs(Math.log10(Math.abs(value / anchor))) <= 1;
    if (!usable) this.anchors.set(path, (anchor = value));
    if (anchor !== 0) {
      return {
        logarithmic: true,
        place: (v) => (v / anchor > 0 ? Math.log10(v / anchor) : -1),
        value: (p) => Number((anchor * 10 ** p).toPrecision(4)),
      };
    }
    return { logarithmic: false, place: (v) => v / 10, value: (p) => Number((10 * p).toPrecision(4)) };
  }

  // Return a table of a kind with values for what it needs.
  fresh(group, kind) {
    const kinds = this.groups[group];
    const names = Object.keys(kinds);
    const chosen = kind ?? { learner: "kalman", observer: "model-free", feature: "state" }[group] ?? names[0];
    const before = at(this.setup, group) ?? {};
    const table = names.length > 1 ? { kind: chosen } : {};
    for (const entry of kinds[chosen].keys) {
      if (before[entry.key] !== undefined && entry.needed) table[entry.key] = before[entry.key];
      else if (entry.needed) table[entry.key] = this.guess(entry);
    }
    if (chosen === "linear") Object.assign(table, { num: [1], den: [1, 1, 0] });
    if (group === "controller") {
      for (const key of ["u_min", "u_max"]) if (before[key] !== undefined) table[key] = before[key];
    }
    for (const entry of kinds[chosen].keys) {
      const plain = group === "plant" || group === "signal";
      if (plain && entry.type === "number" && Number.isFinite(entry.default)) table[entry.key] ??= entry.default;
    }
    return table;
  }

  guess(entry) {
    if (entry.group) return this.fresh(entry.group, entry.group === "plant" ? "linear" : undefined);
    const usual = {
      order: 2, b0: 1, omega_o: 20, omega_c: 4, delay: 0.01, counts: 4096, noise_variance: 1e-6,
      drift: 1, delta: 0.1, kp: 1, theta: 0.05, gain: 1, tau1: 1, period: 1, horizon: 0.1,
    };
    if (entry.type.includes("number") && !entry.type.includes("numbers")) return usual[entry.key] ?? 1;
    return entry.type === "list" || entry.type === "numbers" ? [0, 1] : "";
  }
}
