// Keys that work everywhere but in texts: undo, redo, pin.

export function keys({ undo, redo, pin }) {
  document.addEventListener("keydown", (event) => {
    const typing = event.target.matches("input:not([type=range]):not([type=checkbox]), textarea");
    if (typing) return;
    const key = event.key.toLowerCase();
    const back = key === "z" && !event.shiftKey;
    if (event.ctrlKey || event.metaKey) {
      if (key !== "z" && key !== "y") return;
      event.preventDefault();
      if (back) undo();
      else redo();
    } else if (event.key === "p" && !event.target.matches("select")) pin();
  });
}
