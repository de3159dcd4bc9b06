// Tune for me, before and after side by side, comparison with PID and LQG, and the trade-off curve.

import uPlot from "../vendor/uPlot.js";
import { home } from "../dom.js";
import { palette } from "../plots/palette.js";
import { labels, short } from "../plots/plots.js";
import { beyond, numbersOf, sideBySide } from "./numbers.js";
import { takesNumber } from "./typed.js";

const BOUNDS = [["tune-ms", "m_s"], ["tune-mt", "m_t"], ["tune-mks", "m_ks"], ["tune-noise", "noise_std"], ["tune-resolution", "resolution"]];
const BEFORE = "before tuning";
const TUNED = "tuned";

// What a result is for: another plant, sample time or record makes it that of another machine.
const subject = (setup, record) => JSON.stringify([setup.plant, setup.dt, record]);

export class Designs {
  // `ask(message)` sends with the present setup; `state()` returns the state of the page, `record()`
  // whether it has a record; `use(setup)` takes a tuned setup; `pin(label, arrays)` keeps curves.
  constructor(ask, cancel, state, record, use, pin) {
    Object.assign(this, { ask, cancel, state, record, use, pin, id: null, points: [] });
    this.checks = BOUNDS.map(([id]) => [home(id), takesNumber(home(id))]);
    home("tune").onclick = () => this.begin("tune", { structure: home("tune-structure").value });
    home("compare").onclick = () => this.begin("compare", {});
    home("stop").onclick = () => {
      cancel();
      this.end("stopped");
    };
    home("tune-use").onclick = () => {
      this.use(this.found.setup);
      this.tell("Applied; Undo takes it back.");
    };
    this.clear();
  }

  begin(task, more) {
    const wrong = this.checks.find(([, check]) => check().reason);
    if (wrong) {
      wrong[0].focus();
      return;
    }
    this.clear();
    const bounds = BOUNDS.filter(([id]) => home(id).value.trim() !== "").map(([id, name]) => [name, Number(home(id).value)]);
    this.subject = subject(this.state().setup, this.record());
    this.id = this.ask({ do: task, ...Object.fromEntries(bounds), ...more });
    this.busy(true);
  }

  clear() {
    Object.assign(this, { points: [], found: null, subject: null });
    for (const id of ["tradeoff", "tune-compare", "tune-use"]) home(id).hidden = true;
    for (const id of ["tune-result", "tune-verdict"]) home(id).textContent = "";
  }

  // The setup has changed: the results of another plant go.
  changed(setup) {
    if (this.subject === null || this.subject === subject(setup, this.record())) return;
    const running = this.id !== null;
    if (running) {
      this.cancel();
      this.end("");
    }
    this.clear();
    if (running) home("tune-result").textContent = "stopped: the plant has changed";
  }

  end(text) {
    this.id = null;
    this.busy(false);
    if (text) home("tune-result").textContent += ` ${text}`;
  }

  busy(on) {
    for (const id of ["tune", "compare"]) home(id).disabled = on;
    home("stop").disabled = !on;
    home("progress").hidden = !on;
    home("progress").removeAttribute("value");
  }

  // Take a frame; return whether it was for this part of the page.
  take(header, arrays) {
    if (header.id == null || header.id !== this.id) return false;
    if (header.kind === "progress") home("progress").value = header.share;
    else if (header.kind === "tuned") this.tuned(header);
    else if (header.kind === "tradeoff") this.point(header);
    else if (header.kind === "verdict") this.judge(header.worse);
    else if (header.kind === "run" || header.kind === "loop") this.curves(header, arrays);
    else if (header.kind === "note") home("tune-result").textContent += ` ${header.text}`;
    else if (header.kind === "done") this.end("");
    else if (header.kind === "stopped") this.end("stopped");
    else if (header.kind === "error") {
      this.end("");
      return false;
    }
    return true;
  }

  // Take the run, and then the loop, of the design before, of the tuned one, or of a controller to
  // compare with.
  curves(header, arrays) {
    const { pin } = header;
    if (this.found && (pin === BEFORE || pin === TUNED)) {
      const part = (this.found[pin] ??= { arrays: {} });
      part[header.kind] = header.kind === "run" ? header : header.loop;
      Object.assign(part.arrays, arrays);
    } else this.pin(pin, header.kind === "run", arrays);
  }

  tuned(header) {
    const values = Object.entries(header.values).map(([name, value]) => `${name} = ${short(value)}`);
    const active = header.active.length ? `Active: ${header.active.join(", ")}.` : "No constraint is active.";
    const noise = header.active.some((text) => text.startsWith("M_ks") || text.startsWith("u_std"));
    const hint = (header.noise_bound ? `${header.noise_bound}. ` : "") + (noise ? "More noise in u would allow better load rejection. " : "") + `${header.step} `;
    home("tune-result").textContent = `${header.name} for ${header.plants > 1 ? `the ${header.plants} plants of the record` : "the plant in the form"}: ${values.join(", ")}; integral gain ${short(header.k_i)}. ${active} ${hint}Computing the trade-off …`;
    const { plant, dt } = this.state().setup; // as the form has them: the result is for them
    this.found = { setup: { ...header.setup, plant, dt } };
  }

  // Show both designs side by side, and use the tuned one where nothing is worse by the server's
  // verdict, {key, text} of each, or beyond its bounds.
  judge(worse) {
    const { bounds } = this.state();
    const [before, now] = [BEFORE, TUNED].map((pin) => numbersOf(this.found[pin]?.run, this.found[pin]?.loop, bounds, this.found.setup.dt));
    const keys = new Set(worse.map((each) => each.key));
    sideBySide(home("tune-rows"), before, now, keys);
    home("tune-compare").hidden = false;
    const further = now.filter(([name, , , , key]) => !keys.has(key) && beyond(before, now).includes(name)).map(([name]) => name);
    const names = [...worse.map((each) => each.text), ...further];
    if (names.length) {
      home("tune-use").hidden = false;
      this.tell(`NOT applied: worse in ${names.join("; ")}. Its curves are pinned as “${TUNED}”.`);
      this.pin(TUNED, true, this.found[TUNED].arrays);
      return;
    }
    this.use(this.found.setup);
    this.tell("Applied: no number is worse by more than 10 %. Undo takes it back.");
  }

  tell(text) {
    home("tune-verdict").textContent = text;
  }

  point(header) {
    this.points.push(header);
    this.points.sort((a, b) => a.m_s - b.m_s);
    if (this.points.length < 2) return;
    home("tradeoff").hidden = false;
    this.redraw();
    home("tune-result").textContent = home("tune-result").textContent.replace("Computing the trade-off …", "Below: what a larger M_s would bring.");
  }

  // Draw the trade-off in the colours of the theme.
  redraw() {
    if (this.points.length < 2) return;
    const box = home("tradeoff");
    this.plot?.destroy();
    const colors = palette();
    const grid = { stroke: colors.grid, width: 1 };
    const axis = { stroke: colors.ink, grid, ticks: grid, font: "12px system-ui", labelFont: "12px system-ui", labelSize: 16 };
    const value = (_, raw) => short(raw);
    const points = { size: 7, stroke: colors.main, fill: colors.main };
    this.plot = new uPlot(
      {
        width: box.clientWidth || 300, height: 190, scales: { x: { time: false } },
        series: [{ label: "M_s", value }, { label: "integral gain", stroke: colors.main, width: 2, points, value }],
        axes: [{ ...axis, size: 34, values: labels, label: "M_s" }, { ...axis, size: 56, values: labels }],
      },
      [this.points.map((p) => p.m_s), this.points.map((p) => p.k_i)],
      box,
    );
  }
}
