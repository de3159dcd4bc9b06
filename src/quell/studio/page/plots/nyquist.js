// The Nyquist diagram: the open loop near −1, the unit circle, and the circle of M_s.

import { write } from "../dom.js";
import { DASHES, palette } from "./palette.js";

const HEIGHT = 224;
const REACH = 2.2; // the part of the plane that is shown, around −0.5

export class Nyquist {
  constructor(home) {
    this.home = home;
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    Object.assign(this.canvas.style, { display: "block", width: "100%", height: `${HEIGHT}px` });
    home.append(this.canvas);
    this.width = 0;
    new ResizeObserver(([entry]) => {
      this.width = Math.round(entry.contentRect.width);
      this.redraw();
    }).observe(home);
  }

  show(data, pins, m_s) {
    this.last = [data, pins, m_s];
    this.redraw();
  }

  redraw() {
    const width = this.width;
    if (!this.last || width <= 0) return;
    const [data, pins, m_s] = this.last;
    const ratio = window.devicePixelRatio || 1;
    write(this.canvas, { width: Math.round(width * ratio), height: Math.round(HEIGHT * ratio) });
    const ctx = this.canvas.getContext("2d");
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, width, HEIGHT);
    const scale = HEIGHT / (2 * REACH) * 1.15;
    const place = (re, im) => [width / 2 + (re + 0.5) * scale, HEIGHT / 2 - im * scale];
    const colors = palette();
    this.axes(ctx, width, place, colors);
    circle(ctx, place, 0, 1, scale, colors.quiet, [3, 3]);
    if (m_s) circle(ctx, place, -1, 1 / m_s, scale, colors.other, []);
    for (const pin of pins) this.curve(ctx, place, pin.arrays, colors.pins[pin.place], DASHES[pin.place], 1.25);
    if (data) this.curve(ctx, place, data, colors.main, [], 2);
    const [x, y] = place(-1, 0);
    ctx.setLineDash([]);
    ctx.strokeStyle = colors.bad;
    ctx.lineWidth = 2;
    ctx.beginPath();
    ctx.moveTo(x - 5, y); ctx.lineTo(x + 5, y); ctx.moveTo(x, y - 5); ctx.lineTo(x, y + 5);
    ctx.stroke();
    const nearest = m_s ? `; its least distance from −1 is ${(1 / m_s).toFixed(2)}` : "";
    write(this.canvas, { ariaLabel: `Nyquist diagram of the open loop${nearest}` });
  }

  axes(ctx, width, place, colors) {
    ctx.font = "12px system-ui";
    ctx.fillStyle = colors.ink;
    ctx.strokeStyle = colors.grid;
    ctx.lineWidth = 1;
    for (let k = -6; k <= 6; k++) {
      const [x] = place(k, 0);
      const [, y] = place(0, k);
      ctx.beginPath();
      ctx.moveTo(x, 0); ctx.lineTo(x, HEIGHT); ctx.moveTo(0, y); ctx.lineTo(width, y);
      ctx.stroke();
      if (x > 24 && x < width - 12) ctx.fillText(String(k).replace("-", "−"), x + 3, HEIGHT - 4);
      if (y > 12 && y < HEIGHT - 16 && k !== 0) ctx.fillText((k === 1 ? "j" : `${k}j`).replace("-1j", "−j").replace("-", "−"), 3, y - 3);
    }
    ctx.strokeStyle = colors.quiet;
    const [x0, y0] = place(0, 0);
    ctx.beginPath();
    ctx.moveTo(x0, 0); ctx.lineTo(x0, HEIGHT); ctx.moveTo(0, y0); ctx.lineTo(width, y0);
    ctx.stroke();
  }

  curve(ctx, place, arrays, color, dash, size) {
    if (!arrays?.re) return;
    ctx.strokeStyle = color;
    ctx.lineWidth = size;
    ctx.setLineDash(dash);
    ctx.beginPath();
    let far = true;
    for (let i = 0; i < arrays.re.length; i++) {
      const [re, im] = [arrays.re[i], arrays.im[i]];
      const out = !(Math.abs(re) < 50 && Math.abs(im) < 50);
      const [x, y] = place(Math.max(-50, Math.min(50, re)), Math.max(-50, Math.min(50, im)));
      if (far || out) ctx.moveTo(x, y);
      else ctx.lineTo(x, y);
      far = out;
    }
    ctx.stroke();
    ctx.setLineDash([]);
  }
}

function circle(ctx, place, re, radius, scale, color, dash) {
  const [x, y] = place(re, 0);
  ctx.strokeStyle = color;
  ctx.lineWidth = 1.25;
  ctx.setLineDash(dash);
  ctx.beginPath();
  ctx.arc(x, y, radius * scale, 0, 2 * Math.PI);
  ctx.stroke();
  ctx.setLineDash([]);
}
