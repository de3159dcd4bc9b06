// The tabs of the page: one is chosen, by a click or by the arrow keys.

import { home } from "../dom.js";

export function tabs(names, onChosen) {
  const choose = (name) => {
    for (const each of names) {
      home(`tab-${each}`).setAttribute("aria-selected", each === name);
      home(`tab-${each}`).tabIndex = each === name ? 0 : -1;
    }
    document.body.dataset.tab = name;
    onChosen(name);
  };
  names.forEach((name, i) => {
    home(`tab-${name}`).onclick = () => choose(name);
    home(`tab-${name}`).onkeydown = (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      const next = names[(i + step + names.length) % names.length];
      choose(next);
      home(`tab-${next}`).focus();
    };
  });
}
