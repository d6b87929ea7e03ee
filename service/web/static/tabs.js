// Areas as tabs: arrow keys move between them. On a phone the map is one of them.

import { byId } from "./dom.js";

const isPhone = () => matchMedia("(max-width: 820px)").matches;
const tabs = () => [...document.querySelectorAll('[role="tab"]')].filter((tab) => tab.offsetParent !== null);

export const chooseTab = (name, { onlyOnPhone = false } = {}) => {
  if (onlyOnPhone && !isPhone()) return;
  for (const tab of document.querySelectorAll('[role="tab"]')) {
    const isChosen = tab.id === `tab-${name}`;
    tab.setAttribute("aria-selected", String(isChosen));
    tab.tabIndex = isChosen ? 0 : -1;
    if (tab.id !== "tab-map") byId(tab.getAttribute("aria-controls")).hidden = !isChosen;
  }
};

export const setUpTabs = () => {
  const list = document.querySelector('[role="tablist"]');
  list.addEventListener("click", (event) => {
    const tab = event.target.closest('[role="tab"]');
    if (tab) chooseTab(tab.id.slice("tab-".length));
  });
  list.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const shown = tabs(), next = shown[(shown.indexOf(document.activeElement) + step + shown.length) % shown.length];
    next.focus();
    next.click();
    event.preventDefault();
  });
  const fitToScreen = () => {
    const isMapChosen = byId("tab-map").getAttribute("aria-selected") === "true";
    if (!isPhone() && isMapChosen) chooseTab("information");
  };
  if (isPhone()) chooseTab("map");
  matchMedia("(max-width: 820px)").addEventListener("change", fitToScreen);
};
