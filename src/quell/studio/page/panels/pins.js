// Pinned designs: their curves stay in the plots to compare with.

import { element, home } from "../dom.js";
import { DASHES, palette } from "../plots/palette.js";

const MOST = 5; // pins: a colour and dashes for each

export class Pins {
  // `go(setup)` goes back to the design of a pin; `removed()` is called when one was taken away.
  constructor(go, removed) {
    Object.assign(this, { go, removed, list: [] });
  }

  // Add a pin {label, setup, arrays}; one without setup is not part of the page's state.
  add(pin) {
    this.list = this.list.slice(1 - MOST);
    const used = new Set(this.list.map((each) => each.place));
    // A pin that comes back keeps its colour.
    if (pin.place === undefined || used.has(pin.place)) pin.place = [...Array(MOST).keys()].find((place) => !used.has(place));
    this.list.push(pin);
    this.show();
  }

  // Take the curves of a controller that was tuned to compare with: its run, and then its loop.
  compare(label, isRun, arrays) {
    const old = this.list.find((pin) => pin.label === label && !pin.setup);
    if (isRun) {
      this.list = this.list.filter((pin) => pin !== old);
      this.add({ label, arrays });
    } else if (old) Object.assign(old.arrays, arrays);
  }

  clear() {
    this.list = [];
    this.show();
  }

  // Return what the page's state keeps of the pins.
  kept() {
    return this.list.filter((pin) => pin.setup).map(({ label, setup }) => ({ label, setup }));
  }

  // Make the pins those of a state, after undo or a visit by an address.
  sync(kept) {
    const key = (pin) => JSON.stringify([pin.label, pin.setup]);
    const have = new Map(this.list.map((pin) => [key(pin), pin]));
    const others = this.list.filter((pin) => !pin.setup);
    this.list = [];
    for (const pin of [...kept, ...others]) this.add(have.get(key(pin)) ?? { ...pin });
    this.show();
  }

  // Another axis is shown: the curves of the pins are asked for again.
  forget() {
    this.list = this.list.filter((pin) => pin.setup);
    for (const pin of this.list) pin.arrays = undefined;
    this.show();
  }

  // Return the next pin whose curves are not here yet.
  get missing() {
    return this.list.find((pin) => !pin.arrays && !pin.failed && pin.setup);
  }

  show() {
    home("pins").replaceChildren(...this.list.map((pin) => this.button(pin)));
  }

  button(pin) {
    const box = element("span", "pin");
    const swatch = element("span", "swatch");
    swatch.style.borderColor = palette().pins[pin.place];
    swatch.style.borderTopStyle = DASHES[pin.place][0] > 3 ? "dashed" : "dotted";
    const remove = element("button", "", "✕");
    remove.setAttribute("aria-label", `Remove ${pin.label}`);
    remove.onclick = () => {
      this.list = this.list.filter((each) => each !== pin);
      this.show();
      this.removed();
    };
    const back = element("button", "", pin.label);
    back.title = pin.setup ? "Go back to this design" : pin.label;
    back.disabled = !pin.setup;
    back.onclick = () => this.go(pin.setup);
    box.append(swatch, back, remove);
    return box;
  }
}
