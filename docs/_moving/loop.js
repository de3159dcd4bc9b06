/* Pictures of a control loop that moves: sliders, a load to push, the true f beside its estimate.
 *
 * The loop is quell's own code as WebAssembly (loop.c, moving_loop.py). This file writes the design
 * of the sliders' positions into its memory, gives it references and loads, and draws. */
"use strict";

(() => {
  // A page with several pictures has this script behind each of them.
  if (window.movingLoops) {
    window.movingLoops.showAll();
    return;
  }
  const middle = (list) => (list.length - 1) / 2;
  const decoded = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

  // ---- The loop in WebAssembly ----

  class Loop {
    constructor(machine, instance) {
      this.machine = machine;
      this.code = instance.exports;
      this.memory = new DataView(this.code.memory.buffer);
      this.values = new Float64Array(decoded(machine.values).buffer);
      const array = (name, size) =>
        new Float64Array(this.code.memory.buffer, this.code[`log_${name}`].value, size);
      const { loads, states } = machine;
      this.room = machine.room;
      this.r = array("r", this.room);
      this.w = array("w", this.room * loads);
      this.y = array("y", this.room);
      this.u = array("u", this.room);
      this.x = array("x", (this.room + 1) * states);
      this.fHat = array("f_hat", this.room);
      this.fLearned = array("f_learned", this.room);
      this.authority = array("authority", this.room);
      this.code.begin();
    }

    /* Write the parameters of a design, for start() or retune(). */
    write(positions) {
      const count = this.machine.positions[0].length;
      let first = 0;
      for (const { sliders, places } of this.machine.tables) {
        let at = 0;
        for (const slider of sliders) at = at * count + positions[slider];
        const value = this.values[first + at];
        first += count ** sliders.length;
        places.forEach((entries, structure) => {
          const address = this.code.next_design(structure);
          for (const [offset, type] of entries) {
            if (type === "d") this.memory.setFloat64(address + offset, value, true);
            else if (type === "i") this.memory.setInt32(address + offset, value, true);
            else this.memory.setUint8(address + offset, value);
          }
        });
      }
    }

    /* Return numbers of the last design that has been written, of the loop without learner. */
    design() {
      const { order, offsets } = this.machine;
      const address = this.code.next_design(0);
      const read = (name, count) =>
        Array.from({ length: count }, (_, i) =>
          this.memory.getFloat64(address + offsets[name] + 8 * i, true));
      const size = order + 1;
      const b0 = read("b0", 1)[0];
      const law = read("law", order), cancel = read("cancel", order);
      const flat = read("transition", size * size);
      return {
        b0,
        transition: Array.from({ length: size }, (_, i) => flat.slice(i * size, (i + 1) * size)),
        input: read("input", size),
        gain: read("gain", size),
        feedback: [...law.map((k, i) => (k - cancel[i]) / b0), read("cancel_f", 1)[0] / b0],
      };
    }
  }

  // ---- Margins of the linear loop ----

  const product = (A, B) =>
    A.map((row) => B[0].map((_, j) => row.reduce((sum, a, k) => sum + a * B[k][j], 0)));

  /* Return c (s I - A)^-1 b for a complex s, by elimination with pivots. */
  function response(A, b, c, [real, imaginary]) {
    const n = b.length;
    const R = A.map((row, i) => row.map((a, j) => (i === j ? real : 0) - a));
    const I = A.map((row, i) => row.map((_, j) => (i === j ? imaginary : 0)));
    const p = [...b], q = new Array(n).fill(0);
    for (let k = 0; k < n; k++) {
      let best = k;
      for (let i = k + 1; i < n; i++)
        if (Math.hypot(R[i][k], I[i][k]) > Math.hypot(R[best][k], I[best][k])) best = i;
      [R[k], R[best], I[k], I[best]] = [R[best], R[k], I[best], I[k]];
      [p[k], p[best], q[k], q[best]] = [p[best], p[k], q[best], q[k]];
      const size = R[k][k] ** 2 + I[k][k] ** 2;
      for (let i = 0; i < n; i++) {
        if (i === k) continue;
        const x = (R[i][k] * R[k][k] + I[i][k] * I[k][k]) / size;
        const y = (I[i][k] * R[k][k] - R[i][k] * I[k][k]) / size;
        for (let j = k; j < n; j++) {
          const [u, v] = [R[k][j], I[k][j]];
          R[i][j] -= x * u - y * v;
          I[i][j] -= x * v + y * u;
        }
        const [u, v] = [p[k], q[k]];
        p[i] -= x * u - y * v;
        q[i] -= x * v + y * u;
      }
    }
    let re = 0, im = 0;
    for (let k = 0; k < n; k++) {
      const size = R[k][k] ** 2 + I[k][k] ** 2;
      re += (c[k] * (p[k] * R[k][k] + q[k] * I[k][k])) / size;
      im += (c[k] * (q[k] * R[k][k] - p[k] * I[k][k])) / size;
    }
    return [re, im];
  }

  /* Return M of x^+ = M x^ + L y, with the estimate x^ and u = -K x^: (I - L C)(Phi - Gamma K). */
  function estimateMatrix({ transition, input, gain, feedback }) {
    const closed = transition.map((row, i) => row.map((a, j) => a - input[i] * feedback[j]));
    return closed.map((row, i) => row.map((a, j) => a - gain[i] * closed[0][j]));
  }

  /* Return M_s, the largest |S|, of the loop without learner; Infinity if it is not stable. */
  function largestSensitivity(machine, design) {
    if (!isStable(machine, design)) return Infinity;
    const { N, B, C } = machine.sampled;
    const { gain, feedback } = design;
    const less = estimateMatrix(design).map((row, i) => row.map((a, j) => a - (i === j ? 1 : 0)));
    const S = (omega) => {
      const half = 0.5 * omega * machine.dt;
      const s = [-2 * Math.sin(half) ** 2, Math.sin(2 * half)]; // exp(i omega dt) - 1
      const [a, b] = response(N, B, C, s);
      const [c, d] = response(less, gain, feedback, s);
      const [e, f] = [c + c * s[0] - d * s[1], d + c * s[1] + d * s[0]]; // times z
      return 1 / Math.hypot(1 + a * e - b * f, a * f + b * e);
    };
    const points = 240, nyquist = Math.PI / machine.dt;
    const least = machine.positions[1][0] / 50;
    const at = (i) => least * (nyquist / least) ** (i / points);
    let best = 0, largest = 0;
    for (let i = 0; i <= points; i++) {
      const size = S(at(i));
      if (size > largest) [best, largest] = [i, size];
    }
    let [low, high] = [best - 1, Math.min(best + 1, points)];
    for (let i = 0; i < 30; i++) { // the middle third has the peak
      const [a, b] = [low + (high - low) / 3, high - (high - low) / 3];
      if (S(at(a)) > S(at(b))) high = b; else low = a;
    }
    return Math.max(largest, S(at((low + high) / 2)));
  }

  /* Return whether the spectral radius of the closed loop is below 1, by squaring its matrix. */
  function isStable(machine, design) {
    const { N, B, C } = machine.sampled;
    const { gain, feedback } = design, M = estimateMatrix(design);
    const KM = M[0].map((_, j) => feedback.reduce((sum, k, i) => sum + k * M[i][j], 0));
    const KL = feedback.reduce((sum, k, i) => sum + k * gain[i], 0);
    let A = [
      ...N.map((row, i) => [
        ...row.map((a, j) => a + (i === j ? 1 : 0) - B[i] * KL * C[j]),
        ...KM.map((k) => -B[i] * k)]),
      ...M.map((row, i) => [...C.map((c) => gain[i] * c), ...row]),
    ];
    let log = 0;
    for (let k = 0; k < 20; k++) {
      const size = Math.hypot(...A.flat());
      log += Math.log(size) / 2 ** k;
      A = A.map((row) => row.map((a) => a / size));
      A = product(A, A);
    }
    return log < 0;
  }

  // ---- The picture on a page ----

  const digits = (x, count = 3) => Number(x.toPrecision(count)).toString();

  const TEXTS = {
    "two-mass": {
      title: "Two masses and a spring: u drives the first mass, y is the position of the second",
      push: "Drag a mass to push it.",
    },
    servo: {
      title: "A servo with cogging and dry friction: u is the voltage, y the angle",
      push: "Drag the arm to turn it.",
    },
  };

  const MARKUP = (name, id) => `
    <div class="ml-views">
      <canvas class="ml-machine" role="img" aria-label="${TEXTS[name].title}"></canvas>
      <p class="ml-hint">${TEXTS[name].push}</p>
      <div class="ml-legend"><span><i data-c="y"></i>y</span><span><i data-c="r"></i>reference r</span></div>
      <canvas class="ml-chart" data-chart="y" role="img" aria-label="y and r over time"></canvas>
      <div class="ml-legend"><span><i data-c="f"></i>true f</span><span><i data-c="estimate"></i>estimate f̂</span>
        <span class="ml-learned"><i data-c="learned"></i>learned share</span></div>
      <canvas class="ml-chart" data-chart="f" role="img" aria-label="f and its estimate over time"></canvas>
    </div>
    <div class="ml-panel">
      ${[["b0", "<i>b</i><sub>0</sub>"], ["omega_c", "<i>ω</i><sub>c</sub>"], ["omega_o", "<i>ω</i><sub>o</sub>"], ["load", "load"]]
        .map(([key, label]) => `<label class="ml-slider" for="${id}-${key}"><span>${label}</span><output></output>
          <input type="range" id="${id}-${key}" data-key="${key}" min="0" max="24" step="1"></label>`).join("")}
      <div class="ml-switches">
        <label><input type="checkbox" data-key="learner"> learner</label>
        <label><input type="checkbox" data-key="guard"> guard</label>
      </div>
      <div class="ml-buttons">
        <button type="button" data-do="left" aria-label="Push to the left">◀ push</button>
        <button type="button" data-do="right" aria-label="Push to the right">push ▶</button>
        <button type="button" data-do="step">step</button>
        <button type="button" data-do="pause">pause</button>
        <button type="button" data-do="restart">restart</button>
        <button type="button" data-do="reset">reset</button>
      </div>
      <dl class="ml-numbers">
        <div><dt><i>M</i><sub>s</sub></dt><dd data-n="margin"></dd></div>
        <div><dt>f̂ misses f by</dt><dd data-n="miss"></dd></div>
        <div><dt>r − y, its RMS</dt><dd data-n="error"></dd></div>
        <div><dt>learner</dt><dd data-n="learner"></dd></div>
      </dl>
      <p class="ml-note">RMS values of the last quarter of the picture; <i>M</i><sub>s</sub> without learner.</p>
    </div>`;

  class Picture {
    constructor(element, loop, name) {
      this.shown = Infinity;
      this.element = element;
      this.loop = loop;
      this.name = name;
      this.machine = loop.machine;
      this.capacity = Math.round(this.machine.window / this.machine.dt);
      this.history = {};
      for (const key of ["r", "y", "f", "estimate", "learned"])
        this.history[key] = new Float64Array(this.capacity);
      element.innerHTML = MARKUP(name, `ml${window.movingLoops.length}`);
      this.canvases = [...element.querySelectorAll("canvas")];
      this.readSettings();
      this.listen();
      this.readColours();
      this.loop.write(this.settings.positions);
      this.start();
      if (this.paused) this.element.querySelector("[data-do=pause]").textContent = "run";
      // The first picture already has a history.
      this.advance(Math.round(0.62 * this.capacity));
      this.draw();
      performance.mark("moving-loop"); // the first picture is there
      setTimeout(() => this.showMargins()); // they take longer than the picture
      this.before = null;
      requestAnimationFrame((time) => this.frame(time));
    }

    // ---- settings ----

    readSettings() {
      const given = this.element.dataset;
      const nearest = (slider, factor) => {
        const list = this.machine.positions[slider];
        const wanted = list[middle(list)] * Number(factor ?? 1);
        const far = list.map((value) => Math.abs(Math.log(value / wanted)));
        return far.indexOf(Math.min(...far));
      };
      this.settings = {
        positions: [nearest(0, given.b0), nearest(1, given.omegaC), nearest(2, given.omegaO)],
        load: Math.round(24 * Number(given.load ?? 0)),
        learner: given.learner === "on",
        guard: given.guard !== "off",
      };
      this.first = structuredClone(this.settings);
      this.paused = matchMedia("(prefers-reduced-motion: reduce)").matches;
      this.visible = true;
      this.hand = { target: 0, input: 0, drag: null };
    }

    get structure() {
      return this.settings.learner ? (this.settings.guard ? 2 : 1) : 0;
    }

    /* Set a slider to a position or a switch to a truth value, as the page does. */
    set(key, value) {
      const slider = ["b0", "omega_c", "omega_o"].indexOf(key);
      if (slider >= 0) {
        this.settings.positions[slider] = value;
        this.loop.write(this.settings.positions);
        this.showMargins();
        this.loop.code.retune();
      } else {
        this.settings[key] = value;
        if (key !== "load") this.loop.code.change_structure(this.structure);
      }
      this.showSettings();
    }

    showSettings() {
      const { positions, load, learner, guard } = this.settings;
      const units = ["", " rad/s", " rad/s"];
      ["b0", "omega_c", "omega_o"].forEach((key, i) => {
        const input = this.element.querySelector(`input[data-key=${key}]`);
        const list = this.machine.positions[i];
        input.value = positions[i];
        const value = list[positions[i]];
        const factor = value / list[middle(list)];
        const own = i > 0 ? "" : factor === 1 ? " (the plant's own)"
          : ` (${digits(factor, 2)} of the plant's)`;
        input.previousElementSibling.textContent = `${value}${units[i]}${own}`;
        input.setAttribute("aria-valuetext", input.previousElementSibling.textContent);
      });
      const input = this.element.querySelector("input[data-key=load]");
      input.value = load;
      const unit = this.name === "servo" ? "N m" : "N";
      const size = (load / 24) * this.machine.load.largest;
      const text = load ? `sinusoid of ${digits(size, 2)} ${unit}` : "none";
      input.previousElementSibling.textContent = text;
      this.element.querySelector("input[data-key=learner]").checked = learner;
      const box = this.element.querySelector("input[data-key=guard]");
      box.checked = guard;
      box.disabled = !learner;
      this.element.querySelector(".ml-learned").style.visibility = learner ? "" : "hidden";
    }

    /* Show M_s of the last design that has been written. */
    showMargins() {
      this.margin = largestSensitivity(this.machine, this.loop.design());
      const found = this.margin;
      const words = !Number.isFinite(found) ? `NOT stable: ${this.remedy()}`
        : found < 1.7 ? "a robust loop"
        : found < 2.2 ? "usual reserve"
        : found < 3.5 ? "little reserve" : "close to instability";
      const place = this.element.querySelector("[data-n=margin]");
      place.textContent = Number.isFinite(found) ? `${found.toFixed(2)}: ${words}` : words;
      place.classList.toggle("ml-alarm", !(found < 3.5));
    }

    /* Return the first change of one slider that makes the loop stable. */
    remedy() {
      const positions = this.settings.positions;
      const last = this.machine.positions[0].length - 1;
      const ways = [[0, 1, "raise b0"], [2, 1, "raise omega_o"], [1, -1, "lower omega_c"],
        [0, -1, "lower b0"], [2, -1, "lower omega_o"]];
      const found = ways.find(([slider, direction]) => {
        for (let at = positions[slider] + direction; at >= 0 && at <= last; at += direction) {
          this.loop.write(positions.map((position, i) => (i === slider ? at : position)));
          if (isStable(this.machine, this.loop.design())) return true;
        }
        return false;
      });
      this.loop.write(positions);
      return found ? found[2] : "reset";
    }

    // ---- time ----

    /* Start plant and loop from rest, with the settings of the page. */
    restart() {
      this.loop.write(this.settings.positions);
      this.showMargins();
      this.start();
    }

    start() {
      this.loop.code.start(this.structure);
      this.count = 0;
      this.reference = 0;
      this.turn = Math.round(0.05 * this.machine.step.every / this.machine.dt);
      this.ranAway = false;
      const rest = () => ({ goal: 0, value: 0, rate: 0 });
      this.forces = Array.from({ length: this.machine.loads }, rest);
      this.swell = rest();
      this.load = new Array(this.machine.loads).fill(0);
      this.record = {};
      for (const key of ["r", "w", "y", "u", "x", "fHat", "f", "fLearned", "authority"])
        this.record[key] = [];
      this.range = 0;
      this.showSettings();
    }

    /* Run samples, and keep what the charts show. */
    advance(samples) {
      const { dt, load, step, hand, states, loads } = this.machine;
      const loop = this.loop;
      const b = this.machine.positions[0][this.settings.positions[0]];
      const amplitude = (this.settings.load / 24) * load.largest;
      while (samples > 0) {
        const n = Math.min(samples, loop.room);
        const derivatives = new Array(n);
        for (let k = 0; k < n; k++) {
          const index = this.count + k;
          if (index === this.turn) {
            this.reference = step.height - this.reference;
            this.turn += Math.round(step.every / dt);
          }
          loop.r[k] = this.reference;
          // f has the second derivative of a load, so hand and sinusoid begin and end smoothly.
          const phase = load.omega * index * dt;
          const sine = Math.sin(phase), cosine = load.omega * Math.cos(phase);
          const s = follow(this.swell, amplitude, hand / 4, dt);
          const sinusoid = [
            s[0] * sine,
            s[1] * sine + s[0] * cosine,
            (s[2] - load.omega ** 2 * s[0]) * sine + 2 * s[1] * cosine,
          ];
          const rows = [[], [], []]; // w, w', w'' of each input
          for (let j = 0; j < loads; j++) {
            const target = j === this.hand.input ? this.hand.target : 0;
            const force = follow(this.forces[j], target, hand, dt);
            for (let i = 0; i < 3; i++)
              rows[i].push(force[i] + (j === load.input ? sinusoid[i] : 0));
            loop.w[k * loads + j] = rows[0][j];
          }
          derivatives[k] = rows;
          this.load = rows[0];
        }
        loop.code.run(n);
        for (let k = 0; k < n; k++) {
          const at = (this.count + k) % this.capacity;
          const f = this.trueF(k, derivatives[k], b);
          const { r, y, fHat: estimate, fLearned: learned } = loop;
          const lists = { r, y, estimate, learned };
          for (const key in lists) this.history[key][at] = lists[key][k];
          this.history.f[at] = f;
          if (this.recording) this.keep(k, f);
        }
        this.count += n;
        this.now = { u: loop.u[n - 1], y: loop.y[n - 1], authority: loop.authority[n - 1],
          x: Array.from(loop.x.slice(n * states, (n + 1) * states)) };
        samples -= n;
      }
      if (!(Math.abs(this.now.y) < 50)) this.ranAway = true;
    }

    /* f = y^(n) - b0 u at a sample: what the observer has to estimate. */
    trueF(k, [w, rate, bend], b0) {
      const { f, states, dt } = this.machine;
      const { x, u } = this.loop;
      if (!f.x) return (x[(k + 1) * states + 1] - x[k * states + 1]) / dt - b0 * u[k];
      let sum = (f.u - b0) * u[k];
      f.x.forEach((a, i) => { sum += a * x[k * states + i]; });
      [w, rate, bend].forEach((row, j) => row.forEach((value, i) => { sum += f.w[j][i] * value; }));
      return sum;
    }

    /* Keep a sample since the start, for tests. */
    keep(k, f) {
      const { loop, record } = this;
      const { loads, states } = this.machine;
      record.r.push(loop.r[k]);
      record.w.push(Array.from(loop.w.slice(k * loads, (k + 1) * loads)));
      record.x.push(Array.from(loop.x.slice(k * states, (k + 1) * states)));
      for (const key of ["y", "u", "fHat", "fLearned", "authority"]) record[key].push(loop[key][k]);
      record.f.push(f);
    }

    frame(time) {
      requestAnimationFrame((next) => this.frame(next));
      const passed = this.before === null ? 0 : Math.min((time - this.before) / 1000, 0.1);
      this.before = time;
      if (this.paused || !this.visible) return;
      this.pullHand();
      this.due = (this.due ?? 0) + (passed * this.machine.pace) / this.machine.dt;
      const samples = Math.floor(this.due);
      this.due -= samples;
      if (samples > 0 && !this.ranAway) this.advance(samples);
      this.draw();
    }

    // ---- the hand ----

    listen() {
      const canvas = this.canvases[0];
      const point = (event) => {
        const box = canvas.getBoundingClientRect();
        return [event.clientX - box.left, event.clientY - box.top];
      };
      canvas.addEventListener("pointerdown", (event) => {
        const grip = this.gripAt(point(event), event.pointerType === "mouse" ? 8 : 24);
        if (grip === null) return;
        canvas.setPointerCapture(event.pointerId);
        this.hand.drag = { ...grip, at: point(event) };
        this.hand.input = grip.input;
        event.preventDefault();
      });
      canvas.addEventListener("pointermove", (event) => {
        if (this.hand.drag) this.hand.drag.at = point(event);
        else canvas.style.cursor = this.gripAt(point(event), 8) ? "grab" : "";
      });
      for (const end of ["pointerup", "pointercancel", "lostpointercapture"])
        canvas.addEventListener(end, () => {
          this.hand.drag = null;
          this.hand.target = 0;
        });
      for (const input of this.element.querySelectorAll("input"))
        input.addEventListener("input", () =>
          this.set(input.dataset.key, input.type === "range" ? Number(input.value) : input.checked));
      for (const button of this.element.querySelectorAll("button"))
        this.listenTo(button, button.dataset.do);
      new MutationObserver(() => {
        this.readColours();
        this.draw();
      }).observe(document.documentElement, { attributeFilter: ["data-theme"] });
      new IntersectionObserver(([entry]) => { this.visible = entry.isIntersecting; })
        .observe(this.element);
      new ResizeObserver(() => { if (this.now) this.draw(); }).observe(this.element);
    }

    listenTo(button, what) {
      if (what === "left" || what === "right") {
        const press = (event) => {
          if (event.type === "keydown" && event.key !== " " && event.key !== "Enter") return;
          this.hand.input = this.machine.load.input;
          this.hand.target = (what === "left" ? -0.6 : 0.6) * this.machine.most;
        };
        const release = () => { this.hand.target = 0; };
        for (const each of ["pointerdown", "keydown"]) button.addEventListener(each, press);
        for (const each of ["pointerup", "pointerleave", "pointercancel", "keyup", "blur"])
          button.addEventListener(each, release);
        return;
      }
      button.addEventListener("click", () => {
        if (what === "step") this.turn = this.count;
        if (what === "restart") this.restart();
        if (what === "pause") {
          this.paused = !this.paused;
          button.textContent = this.paused ? "run" : "pause";
        }
        if (what === "reset") {
          this.settings = structuredClone(this.first);
          this.restart();
        }
      });
    }

    /* Set the force of a hand that pulls by a spring. */
    pullHand() {
      const { drag } = this.hand;
      if (!drag) return;
      const { pull, most } = this.machine;
      const force = pull * this.places().stretch(drag);
      this.hand.target = clamp(force, -most, most);
    }

    // ---- drawing ----

    readColours() {
      const style = getComputedStyle(this.element);
      this.colours = {};
      const keys = "ink soft grid y r f estimate learned hand body ground".split(" ");
      for (const key of keys)
        this.colours[key] = style.getPropertyValue(`--ml-${key}`).trim();
    }

    /* Return the context of a canvas that is as sharp as the screen, and its size. */
    surface(canvas) {
      const { clientWidth: width, clientHeight: height } = canvas;
      const ratio = window.devicePixelRatio || 1;
      if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
        canvas.width = Math.round(width * ratio);
        canvas.height = Math.round(height * ratio);
      }
      const context = canvas.getContext("2d");
      context.setTransform(ratio, 0, 0, ratio, 0, 0);
      context.clearRect(0, 0, width, height);
      context.lineJoin = context.lineCap = "round";
      return [context, width, height];
    }

    draw() {
      if (this.name === "servo") this.drawServo();
      else this.drawMasses();
      this.drawChart(this.canvases[1], ["r", "y"], this.machine.y, this.machine.unit);
      const shown = this.settings.learner ? ["f", "learned", "estimate"] : ["f", "estimate"];
      const largest = Math.max(this.largest("f"), this.largest("estimate"));
      if (largest > this.range || largest < 0.3 * this.range) this.range = rounded(1.15 * largest);
      this.drawChart(this.canvases[2], shown, [-this.range, this.range], "");
      this.showNumbers();
    }

    largest(key) {
      const list = this.history[key], n = Math.min(this.count, this.capacity);
      let found = 1e-9;
      for (let i = 0; i < n; i++) found = Math.max(found, Math.abs(list[i]));
      return Number.isFinite(found) ? found : 1;
    }

    drawChart(canvas, keys, [low, high], unit) {
      const [context, width, height] = this.surface(canvas);
      const { colours, capacity, count } = this;
      const [left, right, top, bottom] = [46, width - 6, 6, height - 18];
      const X = (index) => left + ((index - (count - capacity)) / capacity) * (right - left);
      const Y = (value) => bottom - clamp((value - low) / (high - low), -9, 9) * (bottom - top);
      context.font = "11px system-ui, sans-serif";
      context.lineWidth = 1;
      context.textAlign = "right";
      context.textBaseline = "middle";
      for (const tick of ticks(low, high, 4)) {
        context.strokeStyle = tick === 0 ? colours.soft : colours.grid;
        stroke(context, [[left, Y(tick)], [right, Y(tick)]]);
        context.fillStyle = colours.ink;
        context.fillText(`${digits(tick, 6)}${unit ? ` ${unit}` : ""}`, left - 5, Y(tick));
      }
      context.textAlign = "center";
      context.textBaseline = "top";
      const { window: span, dt } = this.machine;
      for (const tick of ticks(count * dt - span, count * dt, 5)) {
        if (tick < 0) continue;
        const x = X(tick / dt);
        context.strokeStyle = colours.grid;
        stroke(context, [[x, top], [x, bottom]]);
        context.fillStyle = colours.ink;
        if (x > left + 8 && x < right - 12) context.fillText(`${digits(tick, 6)} s`, x, bottom + 4);
      }
      context.save();
      context.beginPath();
      context.rect(left, top - 3, right - left, bottom - top + 6);
      context.clip();
      const stride = Math.max(1, Math.floor(capacity / (right - left) / 1.5));
      for (const key of keys) {
        const list = this.history[key];
        context.beginPath();
        const first = Math.max(0, count - capacity + 1);
        for (let i = Math.ceil(first / stride) * stride; i < count; i += stride)
          context.lineTo(X(i), Y(list[i % capacity]));
        context.strokeStyle = colours[key];
        context.lineWidth = key === "f" ? 3.4 : key === "learned" ? 1.2 : 1.8;
        context.setLineDash(key === "r" ? [5, 4] : []);
        context.stroke();
      }
      context.restore();
    }

    /* Return where the machine is on its canvas, and how far a drag stretches its spring. */
    places() {
      const canvas = this.canvases[0];
      const { clientWidth: width, clientHeight: height } = canvas;
      const x = this.now.x;
      if (this.name === "servo") {
        const [cx, cy, radius] = [width / 2, height / 2, height / 2 - 14];
        const tip = [cx + radius * Math.cos(x[0]), cy - radius * Math.sin(x[0])];
        return {
          cx, cy, radius, tip,
          stretch: ({ at, reach }) => { // the moment of a spring at the point that is held
            const [px, py] = [reach * Math.cos(x[0]), reach * Math.sin(x[0])];
            const [dx, dy] = [at[0] - cx - px, cy - at[1] - py];
            return (px * dy - py * dx) / radius ** 2;
          },
        };
      }
      const size = clamp(width / 11, 34, 62), gap = clamp(0.26 * width, 80, 230);
      const [low, high] = [-1, 1.5];
      const scale = (width - gap - 2 * size - 16) / (high - low);
      const first = 8 + size / 2 - low * scale;
      const centres = [first + scale * x[0], first + gap + size + scale * x[1]];
      const floor = height - 26;
      return {
        size, scale, centres, floor, origin: first + gap + size,
        stretch: ({ at, input, grip }) => (at[0] - grip - centres[input]) / scale,
      };
    }

    /* Return what a pointer takes hold of: the input of its force, and where. */
    gripAt([px, py], slack) {
      const found = this.places();
      if (this.name === "servo") {
        const reach = Math.hypot(px - found.cx, py - found.cy);
        return reach > 12 && reach < found.radius + slack ? { input: 0, reach } : null;
      }
      const { size, centres, floor } = found;
      if (py > floor + slack || py < floor - size - slack) return null;
      const near = centres.map((centre) => Math.abs(px - centre));
      const input = near[0] < near[1] ? 0 : 1;
      return near[input] < size / 2 + slack ? { input, grip: px - centres[input] } : null;
    }

    drawMasses() {
      const [context, width] = this.surface(this.canvases[0]);
      const { size, scale, centres, floor, origin } = this.places();
      const { colours, machine } = this;
      context.fillStyle = colours.ground;
      context.fillRect(0, floor, width, 3);
      context.font = "11px system-ui, sans-serif";
      context.textAlign = "center";
      context.textBaseline = "top";
      context.fillStyle = colours.ink;
      for (const tick of [-0.5, 0, 0.5, 1, 1.5]) {
        const x = origin + scale * tick;
        context.fillRect(x - 0.5, floor + 3, 1, 5);
        context.fillText(tick === 0 ? "0" : `${tick} m`, x, floor + 10);
      }
      // The reference is a flag above the place where the second mass shall be.
      const goal = origin + scale * this.reference;
      context.strokeStyle = colours.r;
      context.lineWidth = 1.5;
      context.setLineDash([5, 4]);
      stroke(context, [[goal, 14], [goal, floor]]);
      context.setLineDash([]);
      context.fillStyle = colours.r;
      context.beginPath();
      context.moveTo(goal, 6);
      context.lineTo(goal + 14, 12);
      context.lineTo(goal, 18);
      context.fill();
      // Spring.
      const [from, to] = [centres[0] + size / 2, centres[1] - size / 2];
      const middle = floor - size / 2, turns = 6;
      const points = [[from, middle], [from + 8, middle]];
      for (let i = 0; i < 2 * turns; i++)
        points.push([from + 8 + ((to - from - 16) * (i + 0.5)) / (2 * turns), middle + (i % 2 ? 9 : -9)]);
      points.push([to - 8, middle], [to, middle]);
      context.strokeStyle = colours.ink;
      context.lineWidth = 2;
      stroke(context, points);
      centres.forEach((centre, i) => {
        context.fillStyle = colours.body;
        context.strokeStyle = i === 1 ? colours.y : colours.ink;
        context.lineWidth = 2;
        context.beginPath();
        context.roundRect(centre - size / 2, floor - size - 1, size, size, 6);
        context.fill();
        context.stroke();
        context.fillStyle = colours.ink;
        context.textBaseline = "middle";
        context.font = "13px system-ui, sans-serif";
        context.fillText(i === 1 ? "m₂" : "m₁", centre, floor - size / 2);
      });
      const top = floor - size - 12;
      const length = (force, share) => clamp(force, -2, 2) * share * scale;
      this.arrow(context, centres[0], top, length(this.now.u, 0.3), colours.estimate, "u");
      this.load.forEach((w, i) => {
        if (Math.abs(w) < 0.005 * machine.most) return;
        const y = i === 0 ? top - 16 : top; // above u
        this.arrow(context, centres[i], y, length(w, 0.45), colours.hand, "load");
      });
      const { drag } = this.hand;
      if (drag) this.rope(context, [centres[drag.input] + drag.grip, middle], drag.at);
    }

    drawServo() {
      const [context, width, height] = this.surface(this.canvases[0]);
      const { cx, cy, radius } = this.places();
      const { colours, machine } = this;
      const on = (reach, angle) => [cx + reach * Math.cos(angle), cy - reach * Math.sin(angle)];
      context.lineWidth = 1;
      for (let i = 0; i < 24; i++) {
        const angle = (i * Math.PI) / 12;
        context.strokeStyle = i % 6 === 0 ? colours.soft : colours.grid;
        stroke(context, [on(radius + (i % 6 === 0 ? -8 : -3), angle), on(radius + 3, angle)]);
      }
      context.strokeStyle = colours.r;
      context.lineWidth = 2;
      context.setLineDash([5, 4]);
      stroke(context, [[cx, cy], on(radius, this.reference)]);
      context.setLineDash([]);
      context.strokeStyle = colours.y;
      context.lineWidth = 9;
      stroke(context, [[cx, cy], on(radius - 10, this.now.x[0])]);
      context.fillStyle = colours.body;
      context.strokeStyle = colours.y;
      context.lineWidth = 2;
      disc(context, on(radius - 10, this.now.x[0]), 10);
      context.strokeStyle = colours.ink;
      disc(context, [cx, cy], 17);
      context.fillStyle = colours.ink;
      context.font = "13px system-ui, sans-serif";
      context.textAlign = "center";
      context.textBaseline = "middle";
      context.fillText("M", cx, cy);
      const side = Math.min(radius + 30, width / 2 - 70);
      this.bar(context, cx - side - 40, cy, this.now.u / 4, colours.estimate, "u", height);
      this.bar(context, cx + side + 40, cy, this.load[0] / machine.most, colours.hand, "load", height);
      const { drag } = this.hand;
      if (drag) this.rope(context, on(drag.reach, this.now.x[0]), drag.at);
    }

    /* Draw a number from -1 to 1 as a bar from the middle. */
    bar(context, x, y, value, colour, label, height) {
      const half = height / 2 - 26;
      context.fillStyle = this.colours.grid;
      context.fillRect(x - 7, y - half, 14, 2 * half);
      context.fillStyle = colour;
      const length = clamp(value, -1, 1) * half;
      context.fillRect(x - 7, Math.min(y, y - length), 14, Math.abs(length));
      context.fillStyle = this.colours.ink;
      context.fillRect(x - 11, y - 0.5, 22, 1);
      context.font = "12px system-ui, sans-serif";
      context.textAlign = "center";
      context.textBaseline = "top";
      context.fillText(label, x, y + half + 6);
    }

    arrow(context, x, y, length, colour, label) {
      context.fillStyle = context.strokeStyle = colour;
      context.lineWidth = 2.5;
      const sign = Math.sign(length), head = Math.min(7, Math.abs(length));
      stroke(context, [[x, y], [x + length - sign * head, y]]);
      context.beginPath();
      context.moveTo(x + length, y);
      context.lineTo(x + length - sign * head, y - 5);
      context.lineTo(x + length - sign * head, y + 5);
      context.fill();
      context.font = "12px system-ui, sans-serif";
      context.textBaseline = "middle";
      context.textAlign = length < 0 ? "left" : "right";
      context.fillText(label, x - sign * 6, y);
      context.textAlign = "center";
    }

    rope(context, from, to) {
      context.strokeStyle = this.colours.hand;
      context.fillStyle = this.colours.hand;
      context.lineWidth = 1.5;
      context.setLineDash([2, 4]);
      stroke(context, [from, to]);
      context.setLineDash([]);
      context.beginPath();
      context.arc(...to, 5, 0, 2 * Math.PI);
      context.fill();
    }

    // ---- numbers in words ----

    showNumbers() {
      const pause = (0.15 * this.machine.pace) / this.machine.dt; // numbers that flicker are not read
      if (this.count >= this.shown && this.count < this.shown + pause) return;
      this.shown = this.count;
      const write = (key, text, alarm = false) => {
        const place = this.element.querySelector(`[data-n=${key}]`);
        place.textContent = text;
        place.classList.toggle("ml-alarm", alarm);
      };
      const n = Math.min(this.count, this.capacity / 4);
      const { f, estimate, r, y } = this.history;
      let missed = 0, whole = 1e-30, error = 0;
      for (let k = 1; k <= n; k++) {
        const i = (this.count - k) % this.capacity;
        missed += (f[i] - estimate[i]) ** 2;
        whole += f[i] ** 2;
        error += (r[i] - y[i]) ** 2;
      }
      if (this.ranAway) {
        write("miss", "–");
        write("error", "the loop ran away: restart", true);
      } else {
        write("miss", `${(100 * Math.sqrt(missed / whole)).toFixed(0)} % of it`);
        write("error", `${digits(Math.sqrt(error / n), 2)} ${this.machine.unit}`);
      }
      const share = Math.round(100 * this.now.authority);
      write("learner", !this.settings.learner ? "off"
        : !this.settings.guard ? "on, nobody watches it" : `the guard grants ${share} % of it`);
    }
  }

  /* Return a force, its rate and its bend now, and take it a sample towards its target. */
  const follow = (force, target, omega, dt) => {
    const bend = omega * omega * (force.goal - force.value) - 2 * omega * force.rate;
    const now = [force.value, force.rate, bend];
    force.goal += dt * omega * (target - force.goal);
    force.rate += dt * bend;
    force.value += dt * force.rate;
    return now;
  };

  const stroke = (context, points) => {
    context.beginPath();
    for (const point of points) context.lineTo(...point);
    context.stroke();
  };

  const disc = (context, centre, radius) => {
    context.beginPath();
    context.arc(...centre, radius, 0, 2 * Math.PI);
    context.fill();
    context.stroke();
  };

  /* Return the next of 1, 2, 5, 10, …. */
  const rounded = (x) => {
    const ten = 10 ** Math.floor(Math.log10(x));
    return ten * [1, 2, 5, 10].find((each) => each * ten >= x);
  };

  const ticks = (low, high, count) => {
    const step = rounded((high - low) / count), found = [];
    for (let i = Math.ceil(low / step); i * step <= high + 1e-9 * step; i++) found.push(i * step);
    return found;
  };

  async function show(element) {
    const name = element.dataset.machine;
    const machine = window.movingMachines[name];
    const { instance } = await WebAssembly.instantiate(decoded(machine.wasm));
    window.movingLoops.push(new Picture(element, new Loop(machine, instance), name));
  }

  /* Show the blocks whose machines are here. */
  function showAll() {
    for (const element of document.querySelectorAll(".moving-loop:not([data-shown])")) {
      if (!window.movingMachines?.[element.dataset.machine]) continue;
      element.dataset.shown = "yes";
      show(element);
    }
  }

  window.movingLoops = Object.assign([], { largestSensitivity, showAll });
  showAll();
})();
