// What the server last sent, drawn with the pins: a run, its loop, a band of runs, and their numbers.

import { home, write } from "./dom.js";
import { inWords, numbersOf, showNumbers, unit } from "./panels/numbers.js";
import { short } from "./plots/plots.js";
import { Views } from "./plots/views.js";

const MOST_TIMES = 10_000;
const REST = 150; // the page is at rest when nothing has moved for this time [ms]
const PAUSE = 700; // the numbers are said when they have not changed for this time [ms]

export class Picture {
  // `state()` returns the state of the page, and `pins` has the designs to compare with.
  constructor(state, pins) {
    Object.assign(this, { state, pins, views: new Views(), watching: false });
    Object.assign(this, { arrays: {}, loopArrays: {}, run: null, loop: null, band: null, axis: 0 });
    // For measurements from outside: times from an input to its pictures [ms], pictures, compilation [s].
    Object.assign(this, { firstTimes: [], times: [], frames: 0, compiled: 0 });
  }

  // Columns that a run has in the plots.
  get columns() {
    return Math.max(200, Math.min(2000, this.views.width || 600));
  }

  // Mark the curves as those of values that are not the present ones, or as those that are.
  age(old = true) {
    write(home("plots"), { className: old ? "old" : "" });
  }

  message(text) {
    write(home("message"), { hidden: !text, textContent: text });
  }

  takeRun(header, arrays, asked) {
    const pin = asked.local?.pin;
    if (pin) {
      pin.arrays = arrays;
      return;
    }
    if (!this.watching) this.age(false);
    this.arrays = arrays;
    this.run = header;
    this.nameAxes(header.axes);
    this.compiled += header.compiled;
    this.message([header.message, ...header.warnings].filter(Boolean).join("\n"));
    if (!this.watching) this.drawRun();
    timed(this.firstTimes, asked);
  }

  // Offer the axes of the setup, of which one is shown; there is no choice of one.
  nameAxes(names) {
    const choice = home("axis");
    if (names.join("\n") !== [...choice.options].map((each) => each.text).join("\n")) {
      this.axis = Math.max(0, Math.min(this.axis, names.length - 1));
      choice.replaceChildren(...names.map((name, i) => new Option(name, i, false, i === this.axis)));
    }
    write(home("axes"), { hidden: names.length < 2 });
  }

  takeLoop(header, arrays, asked) {
    const pin = asked.local?.pin;
    if (pin) {
      Object.assign(pin.arrays, arrays);
      if (!this.watching) this.age(false); // a pin is asked for when the present curves are there
      this.draw();
      return;
    }
    if (!this.watching) this.age(false);
    this.loop = header.loop;
    this.loopArrays = arrays;
    write(home("loop-reason"), { textContent: header.loop.reason ?? header.loop.remark ?? "" });
    this.drawLoop();
    this.lastLoop = header.seconds;
    clearTimeout(this.restTimer);
    this.restTimer = setTimeout(() => this.rest(), REST);
    this.frames += 1;
    timed(this.times, asked);
  }

  takeBand(header, arrays) {
    this.band = { ...arrays, about: header };
    this.drawRun();
  }

  // What is not for the eye that follows a slider waits until the page is at rest.
  rest() {
    const took = 1e3 * (this.run.seconds + this.lastLoop);
    const compiled = this.run.compiled > 1 ? `, compiled for ${short(this.run.compiled)} s` : "";
    write(home("state"), { textContent: `${took.toFixed(0)} ms${compiled}` });
  }

  draw() {
    this.drawRun();
    this.drawLoop();
  }

  drawRun() {
    const { band, setup } = this.state();
    this.views.showRun(this.arrays, this.pins.list, band ? this.band : null, setup);
    const f = unit(this.run, "f_hat");
    this.caption({ ...this.run?.signals, f: f && `[${f}]` });
    this.number();
  }

  // Write names and units of y, u and f above their plots.
  caption(signals) {
    for (const name of ["y", "u", "f"]) write(home(`signal-${name}`), { textContent: signals[name] ?? "" });
  }

  drawLoop() {
    this.views.showLoop(this.loopArrays, this.pins.list, this.loop ?? {});
    this.number();
  }

  // The numbers of run and loop change together, with the next picture.
  number() {
    this.numbering ??= requestAnimationFrame(() => {
      this.numbering = null;
      const { bounds, setup } = this.state();
      const entries = numbersOf(this.run, this.loop, bounds, setup.dt);
      showNumbers(home("numbers"), entries);
      clearTimeout(this.sayTimer);
      this.sayTimer = setTimeout(() => write(home("said"), { textContent: inWords(entries) }), PAUSE);
    });
  }
}

// Note the time from the input until its picture; a page that stays open keeps the last ones.
function timed(times, asked) {
  if (!asked.local?.input) return;
  requestAnimationFrame(() => {
    times.push(performance.now() - asked.local.input);
    if (times.length > MOST_TIMES) times.shift();
  });
}
