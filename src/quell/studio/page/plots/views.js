// All plots of the page.

import { home, write } from "../dom.js";
import { Nyquist } from "./nyquist.js";
import { Plot } from "./plots.js";

// Control signals of several axes: colours and dashes repeat after six.
const COLORS = ["main", "other", "quiet"];
const ACTUATORS = Array.from({ length: 24 }, (_, k) => ({
  name: `u_${k + 1}`, label: `u ${k + 1}`, color: COLORS[k % 3], dash: k % 6 < 3 ? undefined : [6, 3], pinned: true,
}));

export class Views {
  constructor() {
    const time = { name: "t", label: "t [s]", sync: "time" };
    this.time = {
      y: new Plot(home("plot-y"), time, [
        { name: "y", label: "y", color: "main", pinned: true },
        { name: "r", label: "r", color: "quiet", dash: [6, 4] },
      ]),
      u: new Plot(home("plot-u"), time, [{ name: "u", label: "u", color: "main", pinned: true }, ...ACTUATORS]),
      f: new Plot(home("plot-f"), time, [
        { name: "f_hat", label: "f estimated", color: "main", pinned: true },
        { name: "f_learned", label: "learned share", color: "other", dash: [8, 3] },
      ]),
      a: new Plot(home("plot-a"), time, [{ name: "authority", label: "authority", color: "other", pinned: true }], {
        range: () => [-0.05, 1.05],
      }),
    };
    this.axis = { name: "omega", label: "ω [rad/s]", sync: "frequency", log: true };
    const curve = (name, label, color = "main", dash = undefined, pinned = true) => ({ name, label, color, dash, pinned });
    this.loop = {
      gain: new Plot(home("plot-gain"), this.axis, [curve("gain", "|L| [dB]")]),
      phase: new Plot(home("plot-phase"), this.axis, [curve("phase", "arg L [°]")]),
      s: new Plot(home("plot-s"), this.axis, [curve("S", "|S| [dB]"), curve("T", "|T| [dB]", "other", [8, 3], false)], {
        range: (_, low, high) => [Math.max(low ?? -60, -60), Math.max((high ?? 0) + 3, 9)],
      }),
    };
    this.nyquist = new Nyquist(home("plot-nyquist"));
  }

  showRun(arrays, pins, band, setup) {
    const kept = pins.filter((pin) => pin.arrays?.t);
    const data = { ...arrays };
    const learns = setup?.learner != null || setup?.axis?.some((axis) => axis.learner != null) || arrays.watched;
    if (!learns) delete data.f_learned;
    write(home("fig-authority"), { hidden: !data.authority });
    write(home("fig-f"), { hidden: !data.f_hat, className: data.authority ? "" : "wide" });
    const limits = ["u_min", "u_max"].flatMap((key) => setup?.controller?.[key] ?? setup?.axes?.[key] ?? []).filter(Number.isFinite);
    this.time.y.show(data, kept, band?.y_low ? { t: band.t, low: band.y_low, high: band.y_high } : null);
    this.time.u.show(data, kept, band?.u_low ? { t: band.t, low: band.u_low, high: band.u_high } : null, limits);
    if (data.f_hat) this.time.f.show(data, kept.filter((pin) => pin.arrays.f_hat));
    if (data.authority) this.time.a.show(data, kept.filter((pin) => pin.arrays.authority));
  }

  showLoop(arrays, pins, numbers) {
    if (!arrays.omega) return;
    const kept = pins.filter((pin) => pin.arrays?.omega);
    this.loop.gain.show(arrays, kept, null, [0]);
    this.loop.phase.show(arrays, kept, null, [-180]);
    this.loop.s.show(arrays, kept, null, numbers.m_s ? [20 * Math.log10(numbers.m_s), 0] : [0]);
    this.nyquist.show(arrays, kept, numbers.m_s);
  }

  // The width of the plots in pixels.
  get width() {
    return this.time.y.width;
  }

  setFrequency(unit) {
    if (unit === this.unit) return;
    this.unit = unit;
    const hertz = unit === "hz";
    this.axis.label = hertz ? "f [Hz]" : "ω [rad/s]";
    this.axis.value = hertz ? (omega) => omega.map((w) => w / (2 * Math.PI)) : undefined;
    for (const plot of Object.values(this.loop)) plot.redraw();
  }

  redraw() {
    for (const plot of [...Object.values(this.time), ...Object.values(this.loop)]) plot.redraw();
    this.nyquist.redraw();
  }
}
