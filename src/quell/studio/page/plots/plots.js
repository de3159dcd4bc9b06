// Plots over time and over frequency, drawn by uPlot.

import uPlot from "../vendor/uPlot.js";
import { DASHES, palette } from "./palette.js";

const HEIGHT = 190;

export function short(value) {
  if (value == null || Number.isNaN(value)) return "–";
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "−∞";
  const size = Math.abs(value);
  const text = size !== 0 && (size > 1e5 || size < 1e-3) ? value.toExponential(2) : String(Number(value.toPrecision(4)));
  return text.replace(/\.?0+e/, "e").replace("e+", "e").replaceAll("-", "−");
}

// A plot of curves of the present design, its pins and, where there is one, a band.
export class Plot {
  // `curves`: list of {name, label, color (a key of the palette), dash, pinned}
  constructor(home, x, curves, options = {}) {
    Object.assign(this, { home, x, curves, options, pins: [], layout: "", limits: [] });
    this.width = home.clientWidth; // asked for once: asking makes the browser lay out the page
    new ResizeObserver(([entry]) => {
      this.width = Math.round(entry.contentRect.width);
      if (this.plot && this.width > 0 && this.width !== this.plot.width) this.plot.setSize({ width: this.width, height: HEIGHT });
    }).observe(home);
  }

  // Show data: arrays by name; `pins` is a list of {label, arrays}; `band` has low and high.
  show(data, pins = [], band = null, limits = []) {
    this.last = [data, pins, band, limits];
    this.limits = limits;
    const curves = this.curves.filter((curve) => data[curve.name]);
    const pinned = curves.filter((curve) => curve.pinned);
    const layout = JSON.stringify([curves.map((c) => c.name), pins.map((p) => [p.label, p.place]), Boolean(band), this.x.log]);
    const x = this.x.value ? this.x.value(data[this.x.name]) : data[this.x.name];
    if (!x) return;
    const columns = [x, ...curves.map((curve) => data[curve.name])];
    for (const pin of pins) {
      for (const curve of pinned) columns.push(onto(data[this.x.name], pin.arrays[this.x.name], pin.arrays[curve.name]));
    }
    if (band) columns.push(onto(data.t, band.t, band.high), onto(data.t, band.t, band.low));
    if (layout === this.layout && this.plot) {
      this.plot.setData(columns);
      return;
    }
    this.layout = layout;
    this.plot?.destroy();
    this.plot = new uPlot(this.settings(curves, pins, pinned, band), columns, this.home);
  }

  redraw() {
    this.layout = "";
    if (this.last) this.show(...this.last);
  }

  settings(curves, pins, pinned, band) {
    const colors = palette();
    const value = (_, raw) => short(raw);
    const series = [{ label: this.x.label, value }];
    for (const curve of curves) {
      series.push({
        label: curve.label, stroke: colors[curve.color], width: curve.color === "quiet" ? 1.25 : 1.75,
        dash: curve.dash, value, points: { show: false }, spanGaps: true,
      });
    }
    pins.forEach((pin) => {
      for (const curve of pinned) {
        series.push({
          label: pinned.length > 1 ? `${pin.label}: ${curve.label}` : pin.label, value, points: { show: false },
          stroke: colors.pins[pin.place], width: 1.25, dash: DASHES[pin.place], spanGaps: true,
        });
      }
    });
    const bands = [];
    if (band) {
      const first = series.length;
      const edge = { stroke: colors.edge, width: 1, value, points: { show: false } };
      series.push({ ...edge, label: "band: high" }, { ...edge, label: "low" });
      bands.push({ series: [first, first + 1], fill: colors.band });
    }
    const axis = { stroke: colors.ink, grid: { stroke: colors.grid, width: 1 }, ticks: { stroke: colors.grid }, font: "12px system-ui" };
    const log = this.x.log ? { distr: 3 } : {};
    return {
      width: Math.max(this.width, 200), height: HEIGHT, series, bands,
      scales: { x: { time: false, ...log }, y: { range: this.options.range ?? padded } },
      axes: [
        { ...axis, size: 34, values: labels, ...(this.x.log ? { splits: decades } : {}) },
        { ...axis, size: 56, values: labels },
      ],
      legend: { live: true }, cursor: { sync: { key: this.x.sync }, points: { size: 6 } },
      hooks: { draw: [(plot) => this.drawLimits(plot)] },
    };
  }

  // Lines across the plot: limits of u, 0 dB and the like; only where they are in view.
  drawLimits(plot) {
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.strokeStyle = palette().quiet;
    ctx.setLineDash([3, 3]);
    for (const limit of this.limits) {
      const y = plot.valToPos(limit, "y", true);
      if (!(y >= bbox.top && y <= bbox.top + bbox.height)) continue;
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
    }
    ctx.restore();
  }
}

// uPlot leaves out ticks that stand too close: they are null.
export function labels(_, ticks) {
  return ticks.map((tick) => (tick == null ? "" : short(tick)));
}

function padded(_, low, high) {
  if (low == null || !Number.isFinite(low) || !Number.isFinite(high)) return [-1, 1];
  const room = 0.06 * (high - low) || 0.1 * Math.abs(high) || 1;
  return [low - room, high + room];
}

function decades(_, axis, low, high) {
  const found = [];
  for (let k = Math.ceil(Math.log10(low) - 1e-9); k <= Math.floor(Math.log10(high) + 1e-9); k++) found.push(10 ** k);
  return found;
}

// Return values at the places x, from others at the places `from` (both increase, ties allowed).
function onto(x, from, values) {
  if (!from || !values || from.length === 0) return new Array(x.length).fill(null);
  if (from === x || (from.length === x.length && from[0] === x[0] && from.at(-1) === x.at(-1) && from[from.length >> 1] === x[x.length >> 1])) return values;
  const found = new Array(x.length);
  let i = 0;
  for (let k = 0; k < x.length; k++) {
    while (i + 1 < from.length && from[i + 1] <= x[k]) i++;
    if (x[k] < from[0] || x[k] > from[from.length - 1] * (1 + 1e-9)) found[k] = null;
    else if (i + 1 >= from.length) found[k] = values[i];
    else {
      const share = (x[k] - from[i]) / (from[i + 1] - from[i] || 1);
      found[k] = values[i] + share * (values[i + 1] - values[i]);
    }
  }
  return found;
}
