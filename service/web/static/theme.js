// Light or dark: as the device says, until a theme is chosen.

import { byId, setText } from "./dom.js";

const KEY = "corridor.theme";
const CHOICES = { auto: ["\u25d0", "as the device says", "light"], light: ["\u2600", "light", "dark"], dark: ["\u263e", "dark", "auto"] }; // sign, words, the next

export const setUpTheme = (changed) => {
  const device = matchMedia("(prefers-color-scheme: dark)"), button = byId("theme");
  const chosen = () => localStorage.getItem(KEY) ?? "auto";
  const apply = () => {
    const [sign, words] = CHOICES[chosen()];
    document.documentElement.dataset.theme = chosen() !== "auto" ? chosen() : device.matches ? "dark" : "light";
    setText(button, sign);
    for (const name of ["aria-label", "title"]) button.setAttribute(name, `Colours: ${words}`);
    changed();
  };
  button.addEventListener("click", () => {
    localStorage.setItem(KEY, CHOICES[chosen()][2]);
    apply();
  });
  device.addEventListener("change", apply);
  apply();
};
