// Elements of the page: made, found and written to.

export const home = (id) => document.getElementById(id);

// Write a text, an attribute or a property only where it differs: the browser lays out again what is
// written to, also with what it has already.
export function write(target, values) {
  for (const [name, value] of Object.entries(values)) if (target[name] !== value) target[name] = value;
}

export function element(tag, className = "", text = "") {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text) made.textContent = text;
  return made;
}

export function input(type, path, label) {
  const made = element("input");
  made.type = type;
  made.dataset.path = path;
  made.setAttribute("aria-label", label);
  return made;
}

export function select(names, chosen, path, label) {
  const made = element("select");
  made.dataset.path = path;
  made.setAttribute("aria-label", label);
  for (const name of names) made.append(new Option(name, name, false, name === chosen));
  return made;
}

export function field(name, control, about = "") {
  const row = element("div", "field");
  const label = element("label", "", name);
  label.title = about ? `${name}: ${about.replaceAll("`", "")}` : name;
  row.append(label, control);
  label.onclick = () => control.focus();
  return row;
}
