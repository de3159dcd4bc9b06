// Light or dark: as the system prefers, until the button chooses.

import { home } from "./dom.js";
import { isDark } from "./plots/palette.js";

// `changed()` is called whenever the colours have changed.
export function theme(changed) {
  const choose = (dark) => {
    document.documentElement.dataset.theme = dark ? "dark" : "light";
    home("theme").textContent = dark ? "Light" : "Dark";
    changed();
  };
  const prefersDark = matchMedia("(prefers-color-scheme: dark)");
  prefersDark.addEventListener("change", (event) => choose(event.matches));
  home("theme").onclick = () => choose(!isDark());
  choose(prefersDark.matches);
}
