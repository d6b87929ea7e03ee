// Small things for building and filling the page. No markup comes from the service: text stays text.

export const byId = (id) => document.getElementById(id);

/** An element; properties starting with "on" are listeners, "data" and "aria" ones become attributes. */
export const element = (tag, properties = {}, ...children) => {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name.includes("-") || name === "role" || name === "for") made.setAttribute(name, value);
    else made[name] = value;
  }
  made.append(...children);
  return made;
};

/** Set text only where it differs: a selection and a screen reader stay undisturbed. */
export const setText = (node, text) => {
  if (node.textContent !== text) node.textContent = text;
};

/** Disable a control, and say why where the pointer rests, where a finger taps and to who hears the page; "": it works. */
export const setRefused = (control, reason) => {
  control.hint ??= control.title; // what it does
  control.disabled = reason !== "";
  control.title = reason || control.hint;
};

/** A finger does not rest on anything: what a disabled control or the head of a column says is shown when it is tapped. */
export const showTitlesOnTap = () => document.addEventListener("pointerup", ({ pointerType, target, clientX, clientY }) => {
  if (pointerType !== "touch") return;
  for (const one of document.querySelectorAll(":disabled[title], th[title]")) {
    const { left, right, top, bottom } = one.getBoundingClientRect(); // a disabled control may hear nothing itself
    const isHit = left <= clientX && clientX <= right && top <= clientY && clientY <= bottom;
    if (one.title && isHit && one.parentElement.contains(target)) notice(`${one.title}.`);
  }
});

export const NO_TOKEN = "Only with the token: enter it under Control";

/** A name of a file, which may go on in the next line after each _ only. */
export const fileName = (name) => name.split(/(?<=_)/).flatMap((part, i) => (i ? [element("wbr"), part] : [part]));

/** Words behind a patch of the colour that they explain. */
export const swatched = (words, colour, className = "") => {
  const swatch = element("span", { className: "swatch" });
  swatch.style.background = colour;
  return element("span", { className }, swatch, words);
};

export const card = (title, ...children) => {
  const aside = element("span", { className: "aside" });
  const made = element("section", { className: "card" }, element("h2", {}, title, aside), ...children);
  return { node: made, aside };
};

/** A list of facts, filled by set({name: text}); a name whose text is null goes. */
export class Facts {
  /** className: "wrapped" for long texts, which may take several lines. */
  constructor(className = "") {
    this.node = element("dl", { className: `facts ${className}` });
    this.rows = new Map();
  }

  /** The names stay, so that nothing moves; their texts are not known any more. */
  clear() {
    for (const [, text] of this.rows.values()) setText(text, "\u2013");
  }

  set(facts) {
    for (const [name, text] of Object.entries(facts)) {
      let row = this.rows.get(name);
      if (text === null) {
        row?.forEach((node) => node.remove());
        this.rows.delete(name);
        continue;
      }
      if (!row) {
        row = [element("dt", {}, name), element("dd")];
        this.node.append(...row);
        this.rows.set(name, row);
      }
      if (row[1].textContent !== text) row[1].replaceChildren(...fileName(text));
    }
  }
}

const NOTICE_MS = 8000;

/** Say something at the edge of the page. level: "ok", "error" or "none"; offer: {text, act} of a button. */
export const notice = (text, level = "none", offer = null) => {
  const close = element("button", { type: "button", className: "quiet", "aria-label": "Close notice" }, "\u00d7");
  const node = element("div", { className: "notice", "data-level": level }, element("span", {}, text), close);
  if (offer) {
    const button = element("button", { type: "button" }, offer.text);
    button.addEventListener("click", () => { node.remove(); offer.act(); });
    close.before(button);
  }
  close.addEventListener("click", () => node.remove());
  for (const shown of byId("notices").children) if (!offer && shown.firstChild.textContent === text) shown.remove(); // once is enough
  byId("notices").append(node);
  if (level !== "error") setTimeout(() => node.remove(), offer ? 4 * NOTICE_MS : NOTICE_MS);
  while (byId("notices").children.length > 4) byId("notices").firstChild.remove();
};

let answered = Promise.resolve();

/** Ask before something happens; resolves to true or false, or, where a name is to be changed, to the new one;
 * where there is another way to do it, `other`, to "other" for that.
 * A question waits for the answer to the one before: `close` comes some time after the dialog has closed. */
export const confirmed = (...question) => (answered = answered.then(() => ask(...question)));

const ask = (title, text, yes, given = null, other = "") => new Promise((settle) => {
  const dialog = byId("confirm");
  setText(byId("confirm-title"), title);
  setText(byId("confirm-text"), text);
  setText(byId("confirm-yes"), yes);
  setText(byId("confirm-other"), other);
  byId("confirm-other").hidden = !other;
  const input = byId("confirm-input");
  input.hidden = given === null;
  input.value = given ?? "";
  input.required = given !== null;
  dialog.returnValue = "no";
  dialog.addEventListener("close", () => {
    const isYes = dialog.returnValue === "yes";
    if (dialog.returnValue === "other") settle("other");
    else settle(given === null ? isYes : isYes && input.value);
  }, { once: true });
  dialog.showModal();
  if (given !== null) input.select();
});
