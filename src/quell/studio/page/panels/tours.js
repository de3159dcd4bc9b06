// Guided tours: short texts, each of which sets some values of the setup.

import { home } from "../dom.js";
import { changed } from "../store.js";

export class Tours {
  // `show(setup, pin)` is called with the setup of a step, and a name to pin it with.
  constructor(tours, presets, show) {
    Object.assign(this, { tours, presets, show });
    home("tours").replaceChildren(
      ...tours.map((tour, i) => {
        const item = document.createElement("li");
        const button = document.createElement("button");
        button.textContent = tour.title;
        button.onclick = () => this.begin(i);
        item.append(button);
        return item;
      }),
    );
    home("tour-next").onclick = () => this.go(this.step + 1);
    home("tour-back").onclick = () => this.go(this.step - 1);
  }

  begin(number) {
    this.tour = this.tours[number];
    this.go(0);
    home("tour-next").focus();
  }

  go(step) {
    if (step < 0) return;
    if (step >= this.tour.steps.length) {
      home("tour").hidden = true;
      return;
    }
    this.step = step;
    let setup = this.presets[this.tour.preset].setup;
    for (const each of this.tour.steps.slice(0, step + 1)) {
      for (const [path, value] of Object.entries(each.changes)) setup = changed(setup, path, value);
    }
    home("tour").hidden = false;
    home("tour-title").textContent = this.tour.title;
    home("tour-text").textContent = this.tour.steps[step].text;
    home("tour-step").textContent = `${step + 1} of ${this.tour.steps.length}`;
    home("tour-back").disabled = step === 0;
    home("tour-next").textContent = step + 1 < this.tour.steps.length ? "Next" : "End";
    const first = this.tour.steps[0];
    this.show(setup, step === 0 ? (first.pin ?? null) : undefined);
  }
}
