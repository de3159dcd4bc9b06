// Margins and metrics as numbers that turn red outside of their bounds, as words, and side by side.

import { element, field, write } from "../dom.js";
import { short } from "../plots/plots.js";
import { takesNumber } from "./typed.js";

// Usual bounds: M_s = 2 and a phase margin of 30° are the least that Åström & Hägglund (Advanced PID
// Control, 2006, section 4.6) advise; the others are chosen by hand.
export const BOUNDS = {
  m_s: { name: "largest M_s", value: 2 },
  gain: { name: "least gain margin (factor)", value: 2 },
  phase: { name: "least phase margin [°]", value: 30 },
  samples: { name: "least delay margin [samples]", value: 2 },
  overshoot: { name: "largest overshoot [%]", value: 20 },
};
export function usual() {
  return Object.fromEntries(Object.entries(BOUNDS).map(([key, bound]) => [key, bound.value]));
}

export function boundFields(home, bounds, change) {
  home.replaceChildren(
    ...Object.entries(BOUNDS).map(([key, bound]) => {
      const box = element("input");
      box.id = `bound-${key}`;
      box.value = bounds[key];
      box.setAttribute("aria-label", bound.name);
      const row = field(bound.name, box);
      takesNumber(box, (value) => value !== undefined && change({ ...bounds, [key]: value }));
      return row;
    }),
  );
}

// Return all numbers as [name, text, whether it is outside of its bound, about, key]: the key is the
// name that the server gives the number in a verdict; it begins with loop or run, its figure.
export function numbersOf(run, loop, bounds, dt) {
  return [...margins(loop, bounds, dt), ...metrics(run, bounds)];
}

// Show all numbers in the boxes of the last ones: while a slider moves only texts change.
export function showNumbers(home, entries) {
  while (home.children.length > entries.length) home.lastChild.remove();
  while (home.children.length < entries.length) {
    const box = element("div");
    box.append(element("dt"), element("dd"));
    home.append(box);
  }
  entries.forEach(([name, value, bad, about, key], i) => {
    const box = home.children[i];
    box.dataset.part = key.split(".")[0];
    write(box, { className: bad ? "bad" : "", title: [name, about].filter(Boolean).join(": ") });
    write(box.firstChild, { textContent: name });
    write(box.lastChild, { textContent: value, ariaLabel: bad ? `${value}, outside of its bound` : null });
  });
}

// Return what a screen reader says of the numbers: those outside of their bounds first.
export function inWords(entries) {
  const said = ([name, value]) => `${name} ${value}`;
  const bad = entries.filter((entry) => entry[2]).map(said);
  const good = entries.filter((entry) => !entry[2]).map(said);
  const first = bad.length ? `Outside of bounds: ${bad.join("; ")}. ` : "All within bounds. ";
  return first + good.join("; ");
}

// Return the names of the numbers that are outside of their bounds now and were not before.
export function beyond(before, now) {
  const was = new Map(before.map((entry) => [entry[0], entry]));
  return now.filter(([name, , bad]) => bad && !was.get(name)?.[2]).map(([name]) => name);
}

// Write the numbers of two designs side by side into a table; those with the given keys are marked,
// as are those that have gone beyond their bounds.
export function sideBySide(home, before, now, keys) {
  const marked = new Set([...beyond(before, now), ...now.filter((entry) => keys.has(entry[4])).map(([name]) => name)]);
  const names = [...new Set([...now, ...before].map(([name]) => name))];
  const text = (entries, name) => entries.find((entry) => entry[0] === name)?.[1] ?? "–";
  home.replaceChildren(
    ...names.map((name) => {
      const row = element("tr", marked.has(name) ? "worse" : "");
      const head = element("th", "", name);
      head.scope = "row";
      row.append(head, element("td", "", text(before, name)), element("td", "", text(now, name)), element("td", "", marked.has(name) ? "worse" : ""));
      return row;
    }),
  );
}

function margins(loop, bounds, dt) {
  if (!loop) return [];
  if (loop.reason) return [];
  if (!loop.stable) return [["loop", "unstable", true, `largest pole at |z| = ${short(loop.largest_pole)}`, "loop.stable"]];
  const [low, high] = loop.gain_margin.map((each) => each ?? Infinity);
  const b = loop.b_range?.map((each) => each ?? Infinity);
  const delay = loop.delay_margin ?? Infinity;
  const phase = loop.phase_margin ?? Infinity;
  return [
    ["M_s", short(loop.m_s), loop.m_s > bounds.m_s, "largest sensitivity: the least distance from −1 is 1/M_s", "loop.m_s"],
    ["gain margin", low > 0 ? range(low, high) : short(high), high < bounds.gain || low > 1 / bounds.gain, "factor of the gain up to which the loop is stable", "loop.gain_margin"],
    ["phase margin", `${short(phase)}°`, phase < bounds.phase, "", "loop.phase_margin"],
    ["delay margin", delay >= 1 ? `${short(delay)} s` : `${short(1e3 * delay)} ms`, delay < bounds.samples * dt, "additional dead time up to which the loop is stable", "loop.delay_margin"],
    ...(b ? [["stable for b/b0", range(...b), false, "range of the plant's gain over b0", "loop.b_range"]] : []),
    ...(loop.noise_to_control === undefined ? [] : [["noise → u", short(loop.noise_to_control), false, "RMS of u for white noise of RMS 1 in y", "loop.noise_to_control"]]),
    ...(loop.gains_at_once ? [["all inputs at once", range(...loop.gains_at_once.map((each) => each ?? Infinity)), false, "gains of all actuators, each for itself, with which the loop is stable (disk margin)", "loop.gains_at_once"]] : []),
  ];
}

// A number with three digits, and two of them: short enough for one line of a box.
function brief(value) {
  return short(value == null ? value : Number(value.toPrecision(3)));
}

function range(low, high) {
  return [low, high].map(brief).join("…");
}

function metrics(run, bounds) {
  if (!run) return [];
  const found = [];
  if (run.diverged) found.push(["run", run.ran_away ? "ran away" : "diverged", true, run.message, "run.stable"]);
  const [y, u] = ["y", "u"].map((name) => unit(run, name));
  run.metrics.forEach((window, i) => {
    const where = `t ≥ ${short(window.start ?? 0)} s`;
    const add = (name, value, bad, about, key) => found.push([`${name}, ${where}`, value, bad, about, `run.${i}.${key}`]);
    if (window.reason) {
      found.push([where, "–", false, window.reason, `run.${i}`]);
      return;
    }
    const { missing } = window;
    if (window.overshoot != null) add("overshoot", `${short(100 * window.overshoot)} %`, 100 * window.overshoot > bounds.overshoot, where, "overshoot");
    else if (window.overshoot === null) add("overshoot", "–", true, missing.overshoot ?? where, "overshoot");
    if (window.settling_time !== undefined) {
      add("settling", window.settling_time == null ? "never" : `${short(window.settling_time)} s`, window.settling_time == null, missing.settling_time ?? where, "settling_time");
    }
    add("peak e", `${short(window.peak_error)} ${y}`, false, `largest |r − y|, ${where}`, "peak_error");
    add("IAE", `${brief(window.iae)} ${y && `${y} s`}`, false, `integral of |r − y| ${where}`, "iae");
    add("TV of u", `${short(window.control_variation)} ${u}`, false, `sum of |Δu| ${where}`, "control_variation");
  });
  return found;
}

// The unit of a signal of a run; empty where the plant has none: "y-unit" says nothing more than y.
export function unit(run, name) {
  const known = run?.units?.[name] ?? "";
  return known.includes("-unit") ? "" : known;
}
