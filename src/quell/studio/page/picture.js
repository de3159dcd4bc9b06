// What the server last sent, drawn with the pins: a run, its loop, a band of runs, and their numbers.

import { home, write } from "./dom.js";
import { inWords, numbersOf, showNumbers, unit } from "./panels/numbers.js";
import { short } from "./plots/plots.js";
import { Views } from "./plots/views.js";

const MOST_TIMES = 10_000;
const REST = 150; // the page is at rest when nothing has moved for this time [ms]
const PAUSE = 700; // the numbers are said when they have not changed for this time [ms]

const LATE = 300; // figures of an earlier setup that stay longer are dimmed, with a reason [ms]

// What a figure belongs to. A frame has the id of the message that it answers, and a message has the
// setup: so each figure on the page has the setup and the axis that it was made for, and is stale
// when they are not the present ones.
const madeFor = ({ setup, axis }) => JSON.stringify([setup, axis ?? 0]);
const WATCHED = "watched"; // what the curves of a running machine belong to

export class Picture {
  // `state()` returns the state of the page, and `pins` has the designs to compare with.
  constructor(state, pins) {
    Object.assign(this, { state, pins, views: new Views(), watching: false });
    Object.assign(this, { arrays: {}, loopArrays: {}, run: null, loop: null, band: null, axis: 0 });
    // What run, loop and band belong to; what the page has asked for; why that is not here.
    Object.assign(this, { of: {}, wanted: null, why: "" });
    // For measurements from outside: times from an input to its pictures [ms], pictures, compilation [s].
    Object.assign(this, { firstTimes: [], times: [], frames: 0, compiled: 0 });
  }

  // Columns that a run has in the plots.
  get columns() {
    return Math.max(200, Math.min(2000, this.views.width || 600));
  }

  // The page now waits for figures of a setup, or of a running machine without one.
  want(message) {
    this.wanted = message ? madeFor(message) : WATCHED;
    this.why = message ? "" : "no rows have come yet";
    this.mark();
  }

  // What the page waits for is late, or does not come, for a reason.
  late(why) {
    this.why = why;
    this.mark();
  }

  isStale(part) {
    return this.of[part] !== undefined && this.of[part] !== this.wanted;
  }

  // Dim all that belongs to another setup than the present one, and say why, after a moment (LATE, and
  // that of the style), so that nothing flickers while a slider moves.
  mark() {
    const [run, loop] = ["run", "loop"].map((part) => this.isStale(part));
    document.querySelector(".time.grid").classList.toggle("stale", run);
    document.querySelector(".loop.grid").classList.toggle("stale", loop);
    home("loop-reason").classList.toggle("stale", loop);
    for (const box of home("numbers").children) box.classList.toggle("stale", box.dataset.part === "run" ? run : loop);
    if (run || (loop && !this.watching)) this.saying ??= setTimeout(() => this.sayStale(), LATE);
    else {
      clearTimeout(this.saying);
      this.saying = null;
      write(home("stale"), { textContent: "" });
    }
  }

  sayStale() {
    this.saying = null;
    write(home("stale"), { textContent: `What is dim is of an earlier setup: ${this.why || "the new one is on its way"}.` });
    this.say();
  }

  // Say the numbers to a screen reader when they have been at rest.
  say() {
    clearTimeout(this.sayTimer);
    this.sayTimer = setTimeout(() => {
      const old = this.isStale("run") || this.isStale("loop") ? "Of an earlier setup, in part or all. " : "";
      write(home("said"), { textContent: old + inWords(this.entries ?? []) });
    }, PAUSE);
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
    this.of.run = madeFor(asked);
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
      this.draw();
      return;
    }
    this.of.loop = madeFor(asked);
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
    this.of.band = this.wanted; // a band of another setup is not asked for any more
    this.band = { ...arrays, about: header };
    this.drawRun();
  }

  // What is not for the eye that follows a slider waits until the page is at rest.
  rest() {
    const took = 1e3 * (this.run.seconds + this.lastLoop);
    const compiled = this.run.compiled > 1 ? `, compiled for ${short(this.run.compiled)} s` : "";
    write(home("state"), { textContent: `${took.toFixed(0)} ms${compiled}` });
  }

  // Draw the design again, after a running machine was shown in its place.
  drawAgain() {
    if (this.of.run === WATCHED) this.of.run = this.ofDesign;
    this.draw();
  }

  draw() {
    this.drawRun();
    this.drawLoop();
  }

  // Draw rows of a running machine.
  drawWatched(arrays, signals) {
    if (this.of.run !== WATCHED) this.ofDesign = this.of.run;
    this.of.run = WATCHED;
    this.mark();
    this.views.showRun({ ...arrays, watched: true }, [], null, null);
    this.caption(signals);
  }

  drawRun() {
    this.mark();
    const { band, setup } = this.state();
    this.views.showRun(this.arrays, this.pins.list, band && this.of.band === this.of.run ? this.band : null, setup);
    const f = unit(this.run, "f_hat");
    this.caption({ ...this.run?.signals, f: f && `[${f}]` });
    this.number();
  }

  // Write names and units of y, u and f above their plots.
  caption(signals) {
    for (const name of ["y", "u", "f"]) write(home(`signal-${name}`), { textContent: signals[name] ?? "" });
  }

  drawLoop() {
    this.mark();
    this.views.showLoop(this.loopArrays, this.pins.list, this.loop ?? {});
    this.number();
  }

  // The numbers of run and loop change together, with the next picture.
  number() {
    this.numbering ??= requestAnimationFrame(() => {
      this.numbering = null;
      const { bounds, setup } = this.state();
      const entries = numbersOf(this.run, this.loop, bounds, setup.dt);
      this.entries = entries;
      showNumbers(home("numbers"), entries);
      this.mark();
      this.say();
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
