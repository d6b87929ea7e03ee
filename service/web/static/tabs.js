// Areas as tabs: arrow keys move between them. On a phone the map is one of them.

import { byId } from "./dom.js";

const phone = matchMedia("(max-width: 820px)");
const tabs = () => [...document.querySelectorAll('[role="tab"]')];

export const chooseTab = (name, { onlyOnPhone = false } = {}) => {
  if (onlyOnPhone && !phone.matches) return;
  for (const tab of tabs()) {
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
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key], shown = tabs().filter((tab) => tab.offsetParent !== null);
    if (!step) return;
    const next = shown.at((shown.indexOf(document.activeElement) + step) % shown.length);
    next.focus();
    next.click();
    event.preventDefault();
  });
  if (phone.matches) chooseTab("map");
  phone.addEventListener("change", () => {
    if (!phone.matches && byId("tab-map").getAttribute("aria-selected") === "true") chooseTab("information");
  });
};
