// A record of a machine: sent to the server, and what is found in it: model, fit, error, plants.

import { element, field, home, write } from "../dom.js";
import { Plot, short } from "../plots/plots.js";
import { setupOf } from "./files.js";
import { takesNumber } from "./typed.js";

const MOST = 8 * 2 ** 20; // largest file [bytes], as in records.py
const PART = 150_000; // bytes of a file in one message

const UNITS = ["", "s", "ms", "us", "ns", "min", "h", "d"];
const ANSWERS = { "": null, yes: true, no: false };
// Fields: key of the message, name, kind, placeholder or choices, what it is.
const FIELDS = [
  ["read_columns", "Columns", "text", "t,u,y", "Names or numbers (from 1 on) of the columns of time, input and output; u,y with a sample time"],
  ["dt", "Sample time [s]", "number", "from the times", "Of a record without times, or in place of them"],
  ["time_unit", "Time unit", UNITS, "", "Unit of the times; s by default"],
  ["order", "Poles", "number", "4", "Number of poles at first; fewer or more are taken where the record shows them"],
  ["max_delay", "Longest delay [s]", "number", "searched", "Longest delay of u that is searched"],
  ["held_out", "Held out (share)", "number", "0.3", "Share of the record, at its end, on which the model is judged; none where u does not move there"],
  ["rest", "At rest before", Object.keys(ANSWERS), "", "Whether the machine was at rest before the record; by default this is assumed where it is needed and likely"],
  ["zeros", "Zeros", "number", "0", "Number of zeros"],
  ["integrators", "Integrators", "number", "as shown", "Number of poles at s = 0; by default as many as the record shows"],
  ["friction", "Friction", Object.keys(ANSWERS), "", "Whether there is Coulomb friction; by default where it fits better"],
];

export class MachineRecord {
  // `send(message)` returns the id of a message, null without a connection; `use(setup)` takes the
  // setup of an identified plant; `open(text, models)` takes the texts of a setup file and of
  // identified models.
  constructor(send, use, open) {
    Object.assign(this, { send, use, open, file: null, first: 0, id: null, shown: false });
    home("record-fields").append(...FIELDS.map((each) => field(each[1], control(...each), each[4])));
    this.checks = new Map(FIELDS.filter((each) => each[2] === "number").map(([key]) => [key, takesNumber(home(`record-${key}`))]));
    const time = { name: "t", label: "t [s]", sync: "record" };
    this.plots = [
      new Plot(home("plot-record-y"), time, [
        { name: "y", label: "y", color: "main" },
        { name: "simulated", label: "y simulated", color: "other", dash: [8, 3] },
      ]),
      new Plot(home("plot-record-u"), time, [{ name: "u", label: "u", color: "main" }]),
      new Plot(home("plot-record-e"), time, [{ name: "residual", label: "y − y simulated", color: "main" }]),
    ];
    home("open-record").onclick = () => home("record-file").click();
    home("record-file").onchange = () => {
      const [file] = home("record-file").files;
      if (file) this.take(file);
      home("record-file").value = "";
    };
    home("record-go").onclick = () => this.begin();
    home("record-close").onclick = () => this.close();
    home("record-stop").onclick = () => this.send({ do: "cancel" });
    this.takeDrops();
    this.busy(false);
  }

  takeDrops() {
    const has = (event) => [...(event.dataTransfer?.types ?? [])].includes("Files");
    const mark = (on) => document.body.classList.toggle("dropping", on);
    document.addEventListener("dragover", (event) => {
      if (!has(event)) return;
      event.preventDefault();
      mark(true);
    });
    document.addEventListener("dragleave", (event) => event.relatedTarget === null && mark(false));
    document.addEventListener("drop", async (event) => {
      if (!has(event)) return;
      event.preventDefault();
      mark(false);
      const files = [...event.dataTransfer.files];
      const found = files.some((file) => /\.toml$/i.test(file.name)) ? await setupOf(files) : null;
      if (found) this.open(...found);
      else if (files.length === 1) this.take(files[0]);
      else this.tell("Drop one file: a record, or a setup (.toml), with the file of its identified model (.json) if it has one.", true);
    });
  }

  async take(file) {
    home("tab-design").click();
    home("record-box").open = true;
    if (file.size > MOST) {
      this.tell(`${file.name} has ${short(file.size / 2 ** 20)} MiB: the studio takes at most ${MOST / 2 ** 20} MiB. Leave out columns or rows, or use quell tune ${file.name}.`, true);
      return;
    }
    try {
      this.file = { name: file.name, bytes: new Uint8Array(await file.arrayBuffer()) };
    } catch {
      this.tell(`${file.name} can't be read: choose a file.`, true);
      return;
    }
    this.begin();
  }

  // Send the file with the fields; a record that is shown goes.
  begin() {
    const message = { name: this.file.name, size: this.file.bytes.length };
    for (const [key, name, kind] of FIELDS) {
      const box = home(`record-${key}`);
      const reason = this.checks.get(key)?.().reason;
      if (reason) {
        this.tell(`The field ${name}: ${reason}`, true);
        box.focus();
        return;
      }
      const text = box.value.trim();
      if (text !== "") message[key] = kind === "number" ? Number(text) : Array.isArray(kind) && kind !== UNITS ? ANSWERS[text] : text;
    }
    this.hide();
    this.first = this.send({ do: "part", at: 0, data: base64(this.file.bytes.subarray(0, PART)) });
    for (let at = PART; at < this.file.bytes.length; at += PART) {
      this.send({ do: "part", at, data: base64(this.file.bytes.subarray(at, at + PART)) });
    }
    this.id = this.send({ do: "record", ...message });
    if (this.id === null) {
      this.tell("There is no connection to the server.", true);
      return;
    }
    this.tell(`${this.file.name}: reading …`);
    this.busy(true);
  }

  busy(on) {
    home("record-go").disabled = on || !this.file;
    home("record-close").disabled = on || !this.file;
    home("record-stop").disabled = !on;
    write(home("record-progress"), { hidden: !on });
    home("record-progress").removeAttribute("value");
  }

  end() {
    this.id = null;
    this.busy(false);
  }

  // The connection is lost: the server knows nothing of the file any more.
  lost() {
    if (this.id === null) return;
    this.end();
    this.tell("The connection was lost: identify again.", true);
  }

  hide() {
    this.shown = false;
    home("record").hidden = true;
  }

  close() {
    this.file = null;
    this.hide();
    this.busy(false);
    this.tell("");
  }

  tell(text, bad = false) {
    home("record-box").open ||= bad;
    write(home("record-state"), { textContent: text, className: bad ? "bad" : "about" });
  }

  // Take a frame; return whether it was for this part of the page.
  takeFrame(header, arrays) {
    if (this.id === null || header.id == null || header.id < this.first || header.id > this.id) return false;
    if (header.kind === "progress") {
      home("record-progress").value = header.share;
      this.tell(`${this.file.name}: ${header.part} …`);
    } else if (header.kind === "record") this.show(header, arrays);
    else if (header.kind === "done") this.end();
    else if (header.kind === "stopped") {
      this.end();
      this.tell(`${this.file.name}: stopped.`);
    } else if (header.kind === "error") {
      this.end();
      this.tell(header.text.join("\n"), true);
    } else return false;
    return true;
  }

  show(header, arrays) {
    this.shown = true;
    home("record").hidden = false;
    const held = header.fits["held out"];
    const fit = held === undefined ? `fit ${percent(header.fits.estimation)}` : `fit ${percent(header.fits.estimation)}, held out ${percent(held)}`;
    home("record-name").textContent = `${header.name}: ${header.samples} samples, dt = ${short(header.dt)} s, ${fit}`;
    home("record-nots").replaceChildren(...header.nots.map((text) => element("li", "", text)));
    home("record-warnings").replaceChildren(...header.warnings.map((text) => element("li", "", text)));
    home("record-report").textContent = header.lines.join("\n");
    home("record-set").hidden = !header.plants.length;
    home("record-count").textContent = `Set of plants: ${header.plants.length}`;
    home("record-plants").replaceChildren(
      ...header.plants.map(({ poles, gain, delay }, i) => {
        const row = element("tr");
        row.append(...[i ? String(i + 1) : "1 (model)", poles, gain, delay].map((text) => element("td", "", text)));
        return row;
      }),
    );
    home("record-held").textContent = held === undefined ? "" : `held out from ${short(header.held_from)} s on`;
    write(home("signal-record-y"), { textContent: header.signals.y });
    write(home("signal-record-u"), { textContent: header.signals.u });
    this.plots.forEach((plot) => plot.show(arrays));
    if (header.setup) {
      this.tell(`The form has the model and a first controller (${header.structure.toUpperCase()}), in deviations from rest. Tune for me tunes for the ${header.plants.length} plants that the record does not exclude.`);
      this.use(header.setup);
    } else this.tell(`NOT: no plant to tune for: ${header.refusal}`, true);
    home("record").scrollIntoView({ block: "nearest" });
  }

  redraw() {
    this.plots.forEach((plot) => plot.redraw());
  }
}

function percent(value) {
  return value == null ? "–" : `${Number(value).toFixed(1)} %`;
}

function control(key, name, kind, hint) {
  const box = element(Array.isArray(kind) ? "select" : "input");
  if (Array.isArray(kind)) for (const each of kind) box.append(new Option(each || "automatic", each));
  else Object.assign(box, { placeholder: hint });
  box.id = `record-${key}`;
  box.setAttribute("aria-label", name);
  return box;
}

function base64(bytes) {
  let text = "";
  for (let at = 0; at < bytes.length; at += 0x8000) text += String.fromCharCode(...bytes.subarray(at, at + 0x8000));
  return btoa(text);
}
