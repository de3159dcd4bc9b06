// Numbers and lists that a user types: their value, or the reason why there is none.

import { element } from "../dom.js";

const NUMBER = /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i;
const WITH_COMMA = /^[+-]?\d*,\d+$/;

// Return {value} or {reason}; the value of an empty text is undefined.
export function typedNumber(text, { whole = false, low = -Infinity, high = Infinity } = {}) {
  const given = text.trim().replaceAll("−", "-");
  if (given === "") return { value: undefined };
  if (WITH_COMMA.test(given)) return { reason: `${given}: write a decimal point, ${given.replace(",", ".")}` };
  if (!NUMBER.test(given)) return { reason: `${given} is no number: write digits, as 50, 0.5 or 2e-4` };
  const value = Number(given);
  if (!Number.isFinite(value)) return { reason: `${given} is too large` };
  if (whole && !Number.isInteger(value)) return { reason: `${given}: must be a whole number` };
  if (value < low || value > high) return { reason: `${given}: must be ${range(low, high)}` };
  return { value };
}

function range(low, high) {
  if (high === Infinity) return `at least ${low}`;
  return low === -Infinity ? `at most ${high}` : `from ${low} to ${high}`;
}

// Return {value} or {reason} of a number, a list as [1, 2], a list of lists, or an object in JSON.
export function typedList(text) {
  const given = text.trim();
  if (given === "") return { value: undefined };
  try {
    return { value: JSON.parse(given) };
  } catch (error) {
    if (given.includes("{")) return { reason: `no JSON: ${error.message}` };
  }
  if (WITH_COMMA.test(given)) {
    return { reason: `${given}: a number has a point, ${given.replace(",", ".")}; a list has brackets, [${given.replace(",", ", ")}]` };
  }
  const count = (sign) => given.split(sign).length - 1;
  if (count("[") !== count("]")) return { reason: `${given}: a bracket ${count("[") > count("]") ? "]" : "["} is missing` };
  if (!given.startsWith("[") && given.includes(",")) return { reason: `${given}: a list has brackets, [${given}]` };
  for (const part of given.split(/[[\],]+/).map((each) => each.trim()).filter(Boolean)) {
    const { reason } = typedNumber(part);
    if (reason) return { reason };
  }
  return { reason: `${given}: write a number, or a list as [1, 2, 3]` };
}

// Let a text field take what `read(text)` returns a value for, and show the reason where there is none.
export function takes(box, read, change) {
  let shown = null;
  box.autocomplete = "off";
  const check = () => {
    const { value, reason } = read(box.value);
    box.setCustomValidity(reason ?? "");
    if (reason && !shown) {
      shown = element("p", "reason");
      shown.setAttribute("role", "alert");
      shown.id = `reason-${box.dataset.path ?? box.id}`;
      (box.closest(".field") ?? box).append(shown);
      box.setAttribute("aria-describedby", shown.id);
      box.setAttribute("aria-invalid", "true");
    }
    if (reason) shown.textContent = reason;
    else if (shown) {
      shown.remove();
      shown = null;
      box.removeAttribute("aria-describedby");
      box.removeAttribute("aria-invalid");
    }
    return { value, reason };
  };
  box.addEventListener("input", () => {
    const { value, reason } = check();
    if (reason === undefined) change?.(value);
  });
  box.recheck = check;
  return check;
}

// Let a field of index.html take a number; `data-low`, `data-high` and `data-whole` are its rules.
export function takesNumber(box, change) {
  const rules = { whole: "whole" in box.dataset };
  if (box.dataset.low) rules.low = Number(box.dataset.low);
  if (box.dataset.high) rules.high = Number(box.dataset.high);
  box.inputMode = "decimal";
  return takes(box, (text) => typedNumber(text, rules), change);
}
