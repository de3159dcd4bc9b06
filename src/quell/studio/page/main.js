// The page: state, server and views together.

import { Connection } from "./connection.js";
import { Designs } from "./design.js";
import { element, home, write } from "./dom.js";
import { download, Files } from "./files.js";
import { Forms } from "./forms.js";
import { boundFields, showNumbers, usual } from "./numbers.js";
import { isDark } from "./palette.js";
import { Pins } from "./pins.js";
import { short } from "./plots.js";
import { changed, Store } from "./store.js";
import { tabs } from "./tabs.js";
import { Tours } from "./tours.js";
import { Views } from "./views.js";
import { Watch } from "./watch.js";

const MOST_TIMES = 10_000;
const REST = 150; // the page is at rest when nothing has moved for this time [ms]

const now = { arrays: {}, loopArrays: {}, run: null, loop: null, band: null, bandId: null, input: null, watching: false, numbering: null };
const studio = { times: [], firstTimes: [], frames: 0, compiled: 0, now }; // for measurements from outside
studio.busy = () => server.flying !== null || server.waiting !== null;
studio.pins = () => pins.list;
studio.saved = () => store.committed === JSON.stringify(store.state);
window.studio = studio;
let presets = [];
let tours = null;
let store = null;

const views = new Views();
const pins = new Pins((setup) => store.set({ ...store.state, setup }), () => keepPins());
const forms = new Forms(home("forms"), (path, value, structure, source) => {
  now.input = performance.now();
  const state = { ...store.state, setup: changed(store.state.setup, path, value) };
  now.changed = [path, source];
  store.set(state, structure, "form");
});

// ---- state

function onState(state, structure, source) {
  if (source === "history") {
    home("undo").disabled = !store.past.length;
    home("redo").disabled = !store.future.length;
    return;
  }
  if (structure) {
    forms.build(state.setup);
    boundFields(home("bounds"), state.bounds, (bounds) => store.set({ ...store.state, bounds }, false, "bounds"));
    home("frequency").value = state.frequency;
    views.setFrequency(state.frequency);
    home("band").checked = state.band;
    home("percent").value = state.percent;
    pins.sync(state.pins);
  }
  ask(); // before the form is written: the server works meanwhile
  if (source === "form" && !structure) forms.refresh(state.setup, ...now.changed);
}

function fill(state) {
  return { bounds: usual(), frequency: "rad", band: false, percent: 20, pins: [], ...state };
}

function ask() {
  if (now.watching || !store) return;
  const message = { do: "run", setup: store.state.setup, columns: width(), local: { input: now.input } };
  now.input = null;
  server.run(message);
  clearTimeout(now.bandTimer);
  if (store.state.band) now.bandTimer = setTimeout(askBand, REST);
  else now.band = null;
}

function askBand() {
  const { setup, percent } = store.state;
  now.bandId = server.send({ do: "band", setup, percent, columns: width() });
}

function width() {
  return Math.max(200, Math.min(2000, views.width || 600));
}

// ---- frames of the server

const server = new Connection(onFrame, (text) => {
  home("state").textContent = text === "connected" ? "connected" : "connection lost; trying again …";
  home("state").dataset.connection = text;
});

async function onFrame(header, arrays, bytes, asked) {
  if (header.kind === "hello") return begin(header);
  if (designs.take(header, arrays)) return undefined;
  if (header.kind === "run" && asked) return takeRun(header, arrays, asked);
  if (header.kind === "loop" && asked) return takeLoop(header, arrays, asked);
  if (header.kind === "band" && header.id === now.bandId) {
    now.band = { ...arrays, about: header };
    drawRun();
  } else if (header.kind === "wait") {
    write(home("plots"), { className: "old" });
    home("state").textContent = header.compiles ? "compiling this kind of loop, once …" : "working …";
  } else if (header.kind === "error") {
    write(home("plots"), { className: "old" }); // they do not show the present values
    message(header.text.join("\n"));
    if (asked?.local?.pin) asked.local.pin.failed = true;
  } else if (header.kind === "texts") files.take(header, store.state.setup.title ?? "setup");
  else if (header.kind === "file") {
    download(header.name, bytes);
    home("state").textContent = `${header.name} is downloaded`;
  } else if (header.kind === "opened") {
    home("preset").value = home("preset-about").textContent = "";
    store.set({ ...store.state, setup: header.setup });
  }
  return undefined;
}

function takeRun(header, arrays, asked) {
  if (asked.local?.pin) {
    asked.local.pin.arrays = arrays;
    return;
  }
  write(home("plots"), { className: "" });
  now.arrays = arrays;
  now.run = header;
  studio.compiled += header.compiled;
  const notes = [header.message, ...header.warnings].filter(Boolean);
  message(notes.join("\n"));
  if (!now.watching) drawRun();
  timed(studio.firstTimes, asked);
}

// Note the time from the input until its picture; a page that stays open keeps the last ones.
function timed(times, asked) {
  if (!asked.local?.input) return;
  requestAnimationFrame(() => {
    times.push(performance.now() - asked.local.input);
    if (times.length > MOST_TIMES) times.shift();
  });
}

function takeLoop(header, arrays, asked) {
  if (asked.local?.pin) {
    Object.assign(asked.local.pin.arrays, arrays);
    redraw();
    askPins();
    return;
  }
  write(home("plots"), { className: "" });
  now.loop = header.loop;
  now.loopArrays = arrays;
  write(home("loop-reason"), { textContent: header.loop.reason ?? "" });
  drawLoop();
  now.took = now.run.seconds + header.seconds;
  clearTimeout(now.restTimer);
  now.restTimer = setTimeout(atRest, REST);
  studio.frames += 1;
  timed(studio.times, asked);
  now.lastLoop = header.seconds;
  askPins();
}

// What is not for the eye that follows a slider waits until the page is at rest.
function atRest() {
  const compiled = now.run.compiled > 1 ? `, compiled for ${short(now.run.compiled)} s` : "";
  write(home("state"), { textContent: `${(1e3 * now.took).toFixed(0)} ms${compiled}` });
}

function drawRun() {
  views.showRun(now.arrays, pins.list, store.state.band ? now.band : null, store.state.setup);
  // Without units of the plant the names of units only repeat those of the signals.
  const unit = (name) => {
    const known = now.run?.units?.[name] ?? "";
    return known && !known.includes("-unit") ? `[${known}]` : "";
  };
  for (const [name, key] of [["y", "y"], ["u", "u"], ["f", "f_hat"]]) {
    write(home(`unit-${name}`), { textContent: unit(key) });
  }
  numbers();
}

function drawLoop() {
  views.showLoop(now.loopArrays, pins.list, now.loop ?? {});
  numbers();
}

// The numbers of run and loop change together, with the next picture.
function numbers() {
  now.numbering ??= requestAnimationFrame(() => {
    now.numbering = null;
    showNumbers(home("numbers"), now.run, now.loop, store.state.bounds, store.state.setup.dt);
  });
}

function redraw() {
  drawRun();
  drawLoop();
}

function message(text) {
  write(home("message"), { hidden: !text, textContent: text });
}

// ---- pins

function pinNow(label) {
  if (!now.arrays.t) return;
  const setup = store.state.setup;
  const name = label ?? `${setup.title ?? "design"} ${pins.list.length + 1}`;
  pins.add({ label: name, setup, arrays: { ...now.arrays, ...now.loopArrays } });
  keepPins();
}

function keepPins() {
  store.set({ ...store.state, pins: pins.kept() }, false, "pins");
  redraw();
}

function askPins() {
  const next = pins.missing;
  if (next && !server.waiting) server.run({ do: "run", setup: next.setup, columns: width(), local: { pin: next } });
}

const designs = new Designs(
  (task) => server.send({ ...task, setup: store.state.setup, columns: width() }),
  () => server.send({ do: "cancel" }),
  (setup) => {
    pinNow("before tuning");
    store.set({ ...store.state, setup });
  },
  (header, arrays) => {
    pins.compare(header.pin, header.kind === "run", arrays);
    redraw();
  },
);

const files = new Files(
  (task) => server.send({ ...task, setup: store.state.setup }),
  (text) => server.send({ do: "open", text }),
);

// ---- watch

const watch = new Watch(
  (arrays, values) => {
    views.showRun({ ...arrays, watched: true }, [], null, null);
    home("watch-values").replaceChildren(
      ...Object.entries(values).map(([name, value]) => {
        const box = element("div");
        box.append(element("dt", "", name), element("dd", "", short(value)));
        return box;
      }),
    );
  },
  (text) => (home("watch-state").textContent = text),
);

function chooseTab(name) {
  // The tours change the design: its form stays below them.
  home("learn").hidden = name !== "learn";
  home("watch").hidden = name !== "watch";
  home("design").hidden = name === "watch";
  document.querySelector(".loop").hidden = name === "watch";
  document.querySelector(".choices").hidden = name === "watch";
  home("numbers").hidden = name === "watch";
  now.watching = name === "watch";
  if (!now.watching) {
    watch.stop();
    if (store) redraw();
  }
}

// ---- beginning

async function begin(hello) {
  forms.groups = hello.forms;
  if (store) {
    server.flying = null;
    ask(); // the connection was lost
    return;
  }
  const [presetList, tourList] = await Promise.all(["presets.json", "tours.json"].map((name) => fetch(name).then((r) => r.json())));
  presets = presetList;
  home("preset").replaceChildren(new Option("your setup", ""), ...presets.map((preset, i) => new Option(preset.name, i)));
  tours = new Tours(tourList, presets, (setup, pin) => {
    if (pin !== undefined) {
      pins.clear();
    }
    home("preset").value = home("preset-about").textContent = "";
    store.set({ ...store.state, setup, pins: pin ? [{ label: pin, setup }] : pin === null ? [] : store.state.pins });
  });
  store = new Store(onState);
  const fromFile = hello.setup && location.hash.length < 2;
  const found = fromFile ? { setup: hello.setup } : Store.found();
  if (!found) choosePreset(0);
  else store.set(fill(found));
  store.commit();
}

function choosePreset(number) {
  home("preset").value = number;
  home("preset-about").textContent = presets[number].about;
  forms.anchors.clear();
  pins.clear();
  store.set(fill({ ...(store.state ?? {}), pins: [], setup: presets[number].setup }));
}

function setTheme(dark) {
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  home("theme").textContent = dark ? "Light" : "Dark";
  if (store) {
    redraw();
    views.redraw();
    pins.show();
  }
}

const prefersDark = matchMedia("(prefers-color-scheme: dark)");
prefersDark.addEventListener("change", (event) => setTheme(event.matches));
setTheme(prefersDark.matches);

home("preset").onchange = () => home("preset").value !== "" && choosePreset(Number(home("preset").value));
home("undo").onclick = () => store.undo();
home("redo").onclick = () => store.redo();
home("pin").onclick = () => pinNow();
home("theme").onclick = () => setTheme(!isDark());
home("watch-go").onclick = () => watch.start(Number(home("watch-port").value));
home("frequency").onchange = () => {
  views.setFrequency(home("frequency").value);
  store.set({ ...store.state, frequency: home("frequency").value }, false, "choice");
};
home("band").onchange = () => store.set({ ...store.state, band: home("band").checked }, false, "choice");
home("percent").oninput = () => store.set({ ...store.state, percent: Number(home("percent").value) }, false, "choice");
tabs(["design", "learn", "watch"], chooseTab);
document.addEventListener("keydown", (event) => {
  const typing = event.target.matches("input:not([type=range]):not([type=checkbox]), textarea");
  const command = event.ctrlKey || event.metaKey;
  if (command && !typing && event.key.toLowerCase() === "z") {
    event.preventDefault();
    if (event.shiftKey) store.redo();
    else store.undo();
  } else if (command && !typing && event.key.toLowerCase() === "y") {
    event.preventDefault();
    store.redo();
  } else if (event.key === "p" && !command && !typing && !event.target.matches("select")) pinNow();
});
