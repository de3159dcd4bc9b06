// The connection to the server: JSON messages out, binary frames in (frames.py).

// Pauses before the connection is tried again [ms]; the last one repeats.
const PAUSES = [200, 500, 1000, 2000];

export class Connection {
  constructor(onFrame, onState) {
    this.onFrame = onFrame;
    this.onState = onState;
    this.count = 0;
    this.failures = 0;
    this.flying = null; // id of the run that the server works on
    this.waiting = null; // the newest run that waits for it
    this.open();
  }

  open() {
    const url = new URL("socket", location.href.split("#")[0]);
    url.protocol = "ws:";
    this.socket = new WebSocket(url);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      this.failures = 0;
      this.flying = null;
      this.onState("connected");
    };
    this.socket.onmessage = (event) => this.receive(event.data);
    this.socket.onclose = () => {
      this.onState("lost");
      const pause = PAUSES[Math.min(this.failures++, PAUSES.length - 1)];
      setTimeout(() => this.open(), pause);
    };
  }

  get connected() {
    return this.socket.readyState === WebSocket.OPEN;
  }

  // Send a message; return its id.
  send(message) {
    const id = ++this.count;
    if (this.connected) this.socket.send(JSON.stringify({ ...message, id }));
    return id;
  }

  // Ask for a run. While one is on its way only the newest further one is kept.
  run(message) {
    if (this.flying !== null || !this.connected) {
      this.waiting = message;
      return;
    }
    const { local, ...sent } = message; // what only the page has to know
    this.flying = this.send(sent);
    this.flyingAbout = message;
  }

  receive(data) {
    const { header, arrays, bytes } = parse(data);
    const ends = ["loop", "error", "stopped"].includes(header.kind);
    const mine = header.id === this.flying;
    const asked = mine ? this.flyingAbout : null;
    if (mine && ends) {
      this.flying = null;
      if (this.waiting) {
        const next = this.waiting;
        this.waiting = null;
        this.run(next);
      }
    }
    this.onFrame(header, arrays, bytes, asked);
  }
}

export function parse(data) {
  const length = new DataView(data).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  let at = 4 + length;
  const arrays = {};
  for (const [name, size] of header.arrays) {
    arrays[name] = new Float32Array(data, at, size);
    at += 4 * size;
  }
  return { header, arrays, bytes: new Uint8Array(data, at) };
}
