// The telemetry of a running loop: rows from the live port of `quell run-rig` (Foxglove's protocol).

const PROTOCOLS = ["foxglove.sdk.v1", "foxglove.websocket.v1"];
const KEPT = 3000; // rows that are shown
// Last values that are shown: column, label, factor of its unit.
const SHOWN = [
  ["k", "sample", 1], ["mode", "mode", 1], ["lateness", "lateness [µs]", 1e6],
  ["step_time", "time of a step [µs]", 1e6], ["y", "y", 1], ["u", "u", 1],
];
const MARK = 4; // bytes before the values: the mark of CDR

export class Watch {
  constructor(onRows, onState) {
    this.onRows = onRows;
    this.onState = onState;
    this.socket = null;
  }

  start(port) {
    this.stop();
    const socket = new WebSocket(`ws://127.0.0.1:${port}`, PROTOCOLS);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    this.rows = [];
    this.columns = null;
    this.first = null;
    this.onState(`connecting to port ${port} …`);
    socket.onmessage = (event) => {
      if (this.socket !== socket) return;
      if (typeof event.data === "string") this.greet(JSON.parse(event.data));
      else this.row(event.data);
    };
    socket.onclose = () => {
      if (this.socket !== socket) return;
      const seen = this.rows.length > 0;
      this.onState(seen ? "The loop has ended; its last rows stay." : `Nothing answers at port ${port}. Is quell run-rig running, with live = ${port}?`);
      this.socket = null;
    };
  }

  stop() {
    const socket = this.socket;
    this.socket = null;
    socket?.close();
  }

  greet(message) {
    if (message.op === "serverInfo") this.onState(`connected to ${message.name}`);
    const channel = message.op === "advertise" ? message.channels.find((each) => each.topic === "/loop") : null;
    if (!channel) return;
    this.columns = {};
    this.units = {};
    let place = 0;
    for (const line of channel.schema.split("\n")) {
      const found = /^float64(?:\[(\d+)\])? (\w+)(?:.*(\[.*\]))?/.exec(line);
      if (!found) continue;
      this.columns[found[2]] = place;
      // "y-unit" stands for a unit that is not known.
      this.units[found[2]] = found[3]?.includes("-unit") ? "" : (found[3] ?? "");
      place += Number(found[1] ?? 1);
    }
    this.socket.send(JSON.stringify({ op: "subscribe", subscriptions: [{ id: 1, channelId: channel.id }] }));
  }

  row(data) {
    const view = new DataView(data);
    if (!this.columns || view.getUint8(0) !== 1) return;
    const time = view.getBigUint64(5, true);
    this.first ??= time;
    const values = new Float64Array(data.slice(13 + MARK));
    this.rows.push([Number(time - this.first) * 1e-9, values]);
    if (this.rows.length > 1.2 * KEPT) this.rows.splice(0, this.rows.length - KEPT);
    if (!this.drawing) this.drawing = requestAnimationFrame(() => this.draw());
  }

  draw() {
    this.drawing = null;
    if (!this.columns) return;
    const column = (name) => (name in this.columns ? Float32Array.from(this.rows, (row) => row[1][this.columns[name]]) : null);
    const arrays = { t: Float32Array.from(this.rows, (row) => row[0]) };
    for (const name of ["r", "y", "u", "authority", "f_learned", "f_residual"]) {
      const values = column(name);
      if (values) arrays[name] = values;
    }
    if (arrays.f_residual) {
      arrays.f_hat = arrays.f_learned ? arrays.f_residual.map((f, i) => f + arrays.f_learned[i]) : arrays.f_residual;
    }
    const last = this.rows.at(-1)?.[1];
    const now = {};
    for (const [name, label, factor] of SHOWN) {
      const unit = ["y", "u"].includes(name) && this.units[name];
      if (last && name in this.columns) now[unit ? `${label} ${unit}` : label] = factor * last[this.columns[name]];
    }
    const { y, u, f_residual: f } = this.units;
    this.onRows(arrays, now, { y, u, f });
  }
}
