// Colours that people with any colour vision can tell apart (Okabe & Ito 2008), for light and dark;
// curves also differ in their dashes.

const LIGHT = {
  main: "#0072b2", other: "#d55e00", quiet: "#6b737c", ink: "#1b1e22", grid: "#e4e7ea",
  bad: "#b3261e", band: "rgba(0,114,178,0.16)", edge: "rgba(0,114,178,0.5)",
  pins: ["#009e73", "#cc79a7", "#b07d00", "#7a52c7", "#8c5a2b"],
};
const DARK = {
  main: "#56b4e9", other: "#ff9040", quiet: "#9aa3ad", ink: "#e8eaed", grid: "#2a3037",
  bad: "#ff9d94", band: "rgba(86,180,233,0.2)", edge: "rgba(86,180,233,0.55)",
  pins: ["#2fd0a0", "#e79ac6", "#f0c419", "#b79bff", "#d6a273"],
};
export const DASHES = [[6, 4], [2, 3], [10, 4, 2, 4], [12, 3], [4, 2, 1, 2]];

export function isDark() {
  return document.documentElement.dataset.theme === "dark";
}

export function palette() {
  return isDark() ? DARK : LIGHT;
}
