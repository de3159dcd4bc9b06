// Tune for me, comparison with PID and LQG, and the trade-off curve.

import uPlot from "../vendor/uPlot.js";
import { home } from "../dom.js";
import { palette } from "../plots/palette.js";
import { labels, short } from "../plots/plots.js";

const BOUNDS = [["tune-ms", "m_s"], ["tune-mt", "m_t"], ["tune-mks", "m_ks"], ["tune-noise", "noise_std"], ["tune-resolution", "resolution"]];

export class Designs {
  // `ask(message)` sends with the present setup; `use(setup)` takes a tuned one; `pin(pin)` adds one.
  constructor(ask, cancel, use, pin) {
    Object.assign(this, { ask, use, pin, id: null });
    home("tune").onclick = () => this.begin("tune", { structure: home("tune-structure").value });
    home("compare").onclick = () => this.begin("compare", {});
    home("stop").onclick = () => {
      cancel();
      this.end("stopped");
    };
  }

  begin(task, more) {
    this.points = [];
    home("tradeoff").hidden = true;
    home("tune-result").textContent = "";
    this.task = task;
    this.id = this.ask({ do: task, ...BOUNDS.reduce((all, [id, name]) => (home(id).value === "" ? all : { ...all, [name]: Number(home(id).value) }), {}), ...more });
    this.busy(true);
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
    else if (header.kind === "run" || header.kind === "loop") this.pin(header, arrays);
    else if (header.kind === "note") home("tune-result").textContent += ` ${header.text}`;
    else if (header.kind === "done") this.end("");
    else if (header.kind === "stopped") this.end("stopped");
    else if (header.kind === "error") {
      this.end("");
      return false;
    }
    return true;
  }

  tuned(header) {
    const values = Object.entries(header.values).map(([name, value]) => `${name} = ${short(value)}`);
    const active = header.active.length ? `Active: ${header.active.join(", ")}.` : "No constraint is active.";
    const noise = header.active.some((text) => text.startsWith("M_ks") || text.startsWith("u_std"));
    const hint = (header.noise_bound ? `${header.noise_bound}. ` : "") + (noise ? "More noise in u would allow better load rejection. " : "") + `${header.step} `;
    home("tune-result").textContent = `${header.name} for ${header.plants > 1 ? `the ${header.plants} plants of the record` : "the plant in the form"}: ${values.join(", ")}; integral gain ${short(header.k_i)}. ${active} ${hint}Computing the trade-off …`;
    this.use(header.setup);
  }

  point(header) {
    this.points.push(header);
    this.points.sort((a, b) => a.m_s - b.m_s);
    if (this.points.length < 2) return;
    const box = home("tradeoff");
    box.hidden = false;
    this.plot?.destroy();
    const colors = palette();
    const axis = { stroke: colors.ink, grid: { stroke: colors.grid }, font: "12px system-ui" };
    const value = (_, raw) => short(raw);
    this.plot = new uPlot(
      {
        width: box.clientWidth || 300, height: 170, scales: { x: { time: false } },
        series: [{ label: "M_s", value }, { label: "integral gain", stroke: colors.main, width: 2, points: { size: 7 }, value }],
        axes: [{ ...axis, size: 34, values: labels }, { ...axis, size: 56, values: labels }],
      },
      [this.points.map((p) => p.m_s), this.points.map((p) => p.k_i)],
      box,
    );
    home("tune-result").textContent = home("tune-result").textContent.replace("Computing the trade-off …", "Below: what a larger M_s would bring.");
  }
}
