// The page: state, server, picture and panels together.

import { Connection } from "./connection.js";
import { element, home } from "./dom.js";
import { keys } from "./keys.js";
import { Designs } from "./panels/design.js";
import { download, Files } from "./panels/files.js";
import { Forms } from "./panels/forms.js";
import { boundFields, usual } from "./panels/numbers.js";
import { MachineRecord } from "./panels/record.js";
import { Pins } from "./panels/pins.js";
import { rovingButtons, rovingTitles } from "./panels/roving.js";
import { tabs } from "./panels/tabs.js";
import { Tours } from "./panels/tours.js";
import { takesNumber } from "./panels/typed.js";
import { Watch } from "./panels/watch.js";
import { Picture } from "./picture.js";
import { short } from "./plots/plots.js";
import { changed, Store } from "./store.js";
import { theme } from "./theme.js";

const PAUSE = 150; // a band is asked for when nothing has moved for this time [ms]

let presets = [];
let store = null;
const asking = { input: null, changed: [], bandId: null, bandTimer: null };

const pins = new Pins((setup) => set({ setup }), () => keepPins());
const picture = new Picture(() => store.state, pins);
const forms = new Forms(home("forms"), (path, value, structure, source) => {
  asking.input = performance.now();
  asking.changed = [path, source];
  set({ setup: changed(store.state.setup, path, value) }, structure, "form");
});
const server = new Connection(onFrame, (text) => {
  home("state").textContent = text === "connected" ? "connected" : "connection lost; trying again …";
  home("state").dataset.connection = text;
  if (text !== "connected") record.lost();
});

// For measurements from outside.
window.studio = {
  picture,
  busy: () => server.flying !== null || server.waiting !== null,
  pins: () => pins.list,
  saved: () => store.committed === JSON.stringify(store.state),
};

// ---- state

function set(values, ...how) {
  store.set({ ...store.state, ...values }, ...how);
}

function onState(state, structure, source) {
  designs.changed(state.setup);
  if (source === "history") {
    home("undo").disabled = !store.past.length;
    home("redo").disabled = !store.future.length;
    return;
  }
  if (structure) {
    forms.build(state.setup);
    boundFields(home("bounds"), state.bounds, (bounds) => set({ bounds }, false, "bounds"));
    home("frequency").value = state.frequency;
    picture.views.setFrequency(state.frequency);
    home("band").checked = state.band;
    home("percent").value = state.percent;
    pins.sync(state.pins);
  }
  ask(); // before the form is written: the server works meanwhile
  if (source === "form" && !structure) forms.refresh(state.setup, ...asking.changed);
}

function fill(state) {
  return { bounds: usual(), frequency: "rad", band: false, percent: 20, pins: [], ...state };
}

// ---- questions to the server, and its frames

function send(task) {
  return server.send({ ...task, setup: store.state.setup, columns: picture.columns });
}

const axisOf = (setup) => Math.min(picture.axis, (setup.axis?.length ?? 1) - 1);

function askRun(setup, local) {
  server.run({ do: "run", setup, axis: axisOf(setup), columns: picture.columns, local });
}

function ask() {
  if (picture.watching || !store) return;
  const { setup, band } = store.state;
  askRun(setup, { input: asking.input });
  picture.want({ setup, axis: axisOf(setup) });
  asking.input = null;
  clearTimeout(asking.bandTimer);
  if (band) asking.bandTimer = setTimeout(askBand, PAUSE);
  else picture.band = null;
}

function askBand() {
  asking.bandId = send({ do: "band", percent: store.state.percent });
}

function askPins() {
  const next = pins.missing;
  if (next && !server.waiting) askRun(next.setup, { pin: next });
}

function onFrame(header, arrays, bytes, asked) {
  if (designs.take(header, arrays) || record.takeFrame(header, arrays)) return;
  if (header.kind === "hello") begin(header);
  else if (header.kind === "run" && asked) picture.takeRun(header, arrays, asked);
  else if (header.kind === "loop" && asked) {
    picture.takeLoop(header, arrays, asked);
    askPins();
  } else if (header.kind === "band" && header.id === asking.bandId) picture.takeBand(header, arrays);
  else if (header.kind === "wait") {
    home("state").textContent = header.compiles ? "compiling this kind of loop, once …" : "working …";
    if (!picture.watching) picture.late(header.compiles ? "this kind of loop is compiled, once" : "the new one is on its way");
  } else if (header.kind === "error") {
    if (asked && !asked.local?.pin) picture.late("the present one does not run, as said above");
    picture.message(header.text.join("\n"));
    if (asked?.local?.pin) asked.local.pin.failed = true;
  } else if (header.kind === "texts") files.take(header, store.state.setup.title ?? "setup");
  else if (header.kind === "file") {
    download(header.name, bytes);
    home("state").textContent = `${header.name} is downloaded`;
  } else if (header.kind === "opened") {
    home("preset").value = home("preset-about").textContent = "";
    set({ setup: header.setup });
  }
}

// ---- pins, designs, files

function pinNow(label) {
  if (!picture.arrays.t) return;
  const setup = store.state.setup;
  const name = label ?? `${setup.title ?? "design"} ${pins.list.length + 1}`;
  pins.add({ label: name, setup, arrays: { ...picture.arrays, ...picture.loopArrays } });
  keepPins();
}

function keepPins() {
  set({ pins: pins.kept() }, false, "pins");
  picture.draw();
}

const designs = new Designs(
  (task) => send({ ...task, record: record.shown }),
  () => server.send({ do: "cancel" }),
  () => store.state,
  () => record.shown,
  (setup) => {
    pinNow("before tuning");
    set({ setup });
  },
  (label, isRun, arrays) => {
    pins.compare(label, isRun, arrays);
    picture.draw();
  },
);

const openText = (text, models) => server.send({ do: "open", text, models });
const files = new Files(send, openText);
const record = new MachineRecord(
  (message) => (server.connected ? server.send({ ...message, columns: picture.columns }) : null),
  (setup) => {
    home("preset").value = home("preset-about").textContent = "";
    forms.anchors.clear();
    pins.clear();
    set({ setup, pins: [] });
  },
  openText,
);

// ---- tabs

const watch = new Watch(
  (arrays, values, units) => {
    picture.drawWatched(arrays, units);
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
  picture.watching = name === "watch";
  if (picture.watching) picture.want(null); // until rows come, the curves are those of the design
  else {
    watch.stop();
    if (store) picture.drawAgain();
    ask();
  }
}

// ---- beginning

async function begin(hello) {
  forms.kinds = hello.forms;
  if (store) {
    server.flying = null;
    ask(); // the connection was lost
    return;
  }
  const [presetList, tours] = await Promise.all(["presets.json", "tours.json"].map((name) => fetch(name).then((r) => r.json())));
  presets = presetList;
  home("preset").replaceChildren(new Option("your setup", ""), ...presets.map((preset, i) => new Option(preset.name, i)));
  new Tours(tours, presets, showTour);
  store = new Store(onState);
  const fromFile = hello.setup && location.hash.length < 2;
  const found = fromFile ? { setup: hello.setup } : Store.found();
  if (!found) choosePreset(0);
  else store.set(fill(found));
  store.commit();
}

// Show the setup of a tour's step; `pin` is a name to pin it with, null for no pins any more.
function showTour(setup, pin) {
  if (pin !== undefined) pins.clear();
  home("preset").value = home("preset-about").textContent = "";
  set({ setup, pins: pin ? [{ label: pin, setup }] : pin === null ? [] : store.state.pins });
}

function choosePreset(number) {
  home("preset").value = number;
  home("preset-about").textContent = presets[number].about;
  forms.anchors.clear();
  pins.clear();
  store.set(fill({ ...(store.state ?? {}), pins: [], setup: presets[number].setup }));
}

home("preset").onchange = () => home("preset").value !== "" && choosePreset(Number(home("preset").value));
home("undo").onclick = () => store.undo();
home("redo").onclick = () => store.redo();
home("pin").onclick = () => pinNow();
const portIsRight = takesNumber(home("watch-port"));
home("watch-go").onclick = () => portIsRight().value !== undefined && watch.start(portIsRight().value);
home("frequency").onchange = () => {
  picture.views.setFrequency(home("frequency").value);
  set({ frequency: home("frequency").value }, false, "choice");
};
home("axis").onchange = () => {
  picture.axis = Number(home("axis").value);
  pins.forget();
  ask();
};
home("band").onchange = () => set({ band: home("band").checked }, false, "choice");
takesNumber(home("percent"), (percent) => percent !== undefined && set({ percent }, false, "choice"));
tabs(["design", "learn", "watch"], chooseTab);
keys({ undo: () => store.undo(), redo: () => store.redo(), pin: () => pinNow() });
theme(() => {
  if (!store) return;
  picture.draw();
  picture.views.redraw();
  pins.show();
  record.redraw();
  designs.redraw();
});
rovingButtons(document.querySelector(".tools"));
rovingTitles(home("left"));
