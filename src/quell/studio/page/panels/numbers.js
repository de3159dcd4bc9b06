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
const MUCH = 0.01; // an error that is larger by less than this share is not worse

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

// Return all numbers as [name, text, whether it is outside of its bound, about, error]: an error is a
// number that the user looks at and that should be small, undefined for the others.
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
  entries.forEach(([name, value, bad, about], i) => {
    const box = home.children[i];
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

// Return the names of what is worse than before: numbers that are outside of their bounds now and were
// not, and errors that are larger.
export function worse(before, now) {
  const was = new Map(before.map((entry) => [entry[0], entry]));
  return now
    .filter(([name, , bad, , error]) => {
      const old = was.get(name);
      if (!old) return bad;
      return (bad && !old[2]) || (error !== undefined && old[4] !== undefined && error > old[4] * (1 + MUCH));
    })
    .map(([name]) => name);
}

// Write the numbers of two designs side by side into a table; those that are worse are marked.
export function sideBySide(home, before, now) {
  const marked = new Set(worse(before, now));
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
  if (!loop.stable) return [["loop", "unstable", true, `largest pole at |z| = ${short(loop.largest_pole)}`]];
  const [low, high] = loop.gain_margin.map((each) => each ?? Infinity);
  const b = loop.b_range?.map((each) => each ?? Infinity);
  const delay = loop.delay_margin ?? Infinity;
  const phase = loop.phase_margin ?? Infinity;
  return [
    ["M_s", short(loop.m_s), loop.m_s > bounds.m_s, "largest sensitivity: the least distance from −1 is 1/M_s"],
    ["gain margin", low > 0 ? range(low, high) : short(high), high < bounds.gain || low > 1 / bounds.gain, "factor of the gain up to which the loop is stable"],
    ["phase margin", `${short(phase)}°`, phase < bounds.phase, ""],
    ["delay margin", delay >= 1 ? `${short(delay)} s` : `${short(1e3 * delay)} ms`, delay < bounds.samples * dt, "additional dead time up to which the loop is stable"],
    ...(b ? [["stable for b/b0", range(...b), false, "range of the plant's gain over b0"]] : []),
    ...(loop.noise_to_control === undefined ? [] : [["noise → u", short(loop.noise_to_control), false, "RMS of u for white noise of RMS 1 in y"]]),
    ...(loop.gains_at_once ? [["all inputs at once", range(...loop.gains_at_once.map((each) => each ?? Infinity)), false, "gains of all actuators, each for itself, with which the loop is stable (disk margin)"]] : []),
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
  if (run.diverged) found.push(["run", "diverged", true, run.message]);
  const [y, u] = ["y", "u"].map((name) => unit(run, name));
  for (const window of run.metrics) {
    const where = `t ≥ ${short(window.start ?? 0)} s`;
    if (window.reason) {
      found.push([where, "–", false, window.reason]);
      continue;
    }
    if (window.overshoot != null) {
      found.push([`overshoot, ${where}`, `${short(100 * window.overshoot)} %`, 100 * window.overshoot > bounds.overshoot, where]);
    }
    if (window.settling_time !== undefined) {
      found.push([`settling, ${where}`, window.settling_time == null ? "never" : `${short(window.settling_time)} s`, window.settling_time == null, where]);
    }
    found.push([`peak e, ${where}`, `${short(window.peak_error)} ${y}`, false, `largest |r − y|, ${where}`, window.peak_error]);
    found.push([`IAE, ${where}`, `${brief(window.iae)} ${y && `${y} s`}`, false, `integral of |r − y| ${where}`, window.iae]);
    found.push([`TV of u, ${where}`, `${short(window.control_variation)} ${u}`, false, `sum of |Δu| ${where}`]);
  }
  return found;
}

// The unit of a signal of a run; empty where the plant has none: "y-unit" says nothing more than y.
export function unit(run, name) {
  const known = run?.units?.[name] ?? "";
  return known.includes("-unit") ? "" : known;
}
