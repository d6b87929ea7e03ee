// Light or dark: as the device says, until somebody chooses.

import { byId, setText } from "./dom.js";

const KEY = "corridor.theme";
const NEXT = { auto: "light", light: "dark", dark: "auto" };
const SIGNS = { auto: "\u25d0", light: "\u2600", dark: "\u263e" };
const WORDS = { auto: "as the device says", light: "light", dark: "dark" };

export const setUpTheme = (changed) => {
  const device = matchMedia("(prefers-color-scheme: dark)");
  const chosen = () => localStorage.getItem(KEY) ?? "auto";
  const apply = () => {
    const theme = chosen() === "auto" ? (device.matches ? "dark" : "light") : chosen();
    document.documentElement.dataset.theme = theme;
    setText(byId("theme"), SIGNS[chosen()]);
    byId("theme").setAttribute("aria-label", `Colours: ${WORDS[chosen()]}`);
    byId("theme").title = `Colours: ${WORDS[chosen()]}`;
    changed();
  };
  byId("theme").addEventListener("click", () => {
    localStorage.setItem(KEY, NEXT[chosen()]);
    apply();
  });
  device.addEventListener("change", apply);
  apply();
};
