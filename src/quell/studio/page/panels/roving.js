// Moving between the sliders of a group, and between buttons of a toolbar, with the arrow keys: Tab
// goes to one of them, and to what is behind all of them (ARIA Authoring Practices, "roving tabindex").

const isShown = (target) => target.getClientRects().length > 0;

// In each group of `home` one slider and its number are reached by Tab; Up and Down go to the next.
export function rovingSliders(home) {
  const rows = (group) => [...group.querySelectorAll(".field.slides")].filter((row) => row.closest(".group, .plain") === group);
  const choose = (chosen) => {
    for (const row of rows(chosen.closest(".group, .plain"))) {
      for (const control of row.querySelectorAll("input")) control.tabIndex = row === chosen ? 0 : -1;
    }
  };
  home.addEventListener("focusin", (event) => {
    const row = event.target.closest(".field.slides");
    if (row) choose(row);
  });
  home.addEventListener("keydown", (event) => {
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    const row = step && event.target.closest(".field.slides");
    if (!row || event.altKey || event.ctrlKey || event.metaKey) return;
    const shown = rows(row.closest(".group, .plain")).filter(isShown);
    const next = shown[shown.indexOf(row) + step];
    event.preventDefault(); // also at the ends: Left and Right change the value
    next?.querySelector(`input[type=${event.target.type}]`)?.focus();
  });
  return () => {
    for (const group of home.querySelectorAll(".group, .plain")) {
      const first = rows(group)[0];
      if (first) choose(first);
    }
    const focused = document.activeElement?.closest?.(".field.slides");
    if (focused && home.contains(focused)) choose(focused);
  };
}

// Left and Right go from button to button of a toolbar.
export function rovingButtons(toolbar) {
  const buttons = () => [...toolbar.querySelectorAll("button")].filter(isShown);
  const choose = (chosen) => {
    for (const button of toolbar.querySelectorAll("button")) button.tabIndex = button === chosen ? 0 : -1;
  };
  toolbar.addEventListener("focusin", (event) => event.target.matches("button") && choose(event.target));
  toolbar.addEventListener("keydown", (event) => {
    const list = buttons().filter((button) => !button.disabled);
    const at = list.indexOf(event.target);
    const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: list.length - 1 }[event.key];
    if (at < 0 || to === undefined) return;
    event.preventDefault();
    list[(to + list.length) % list.length].focus();
  });
  choose(toolbar.querySelector("#open"));
}

// Up and Down go from the title of one group to the next.
export function rovingTitles(home) {
  home.addEventListener("keydown", (event) => {
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (!step || !event.target.matches(".group > summary")) return;
    const titles = [...home.querySelectorAll(".group > summary")].filter(isShown);
    event.preventDefault();
    titles[titles.indexOf(event.target) + step]?.focus();
  });
}
