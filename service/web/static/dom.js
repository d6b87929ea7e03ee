// Small things for building and filling the page. No markup comes from the service: text stays text.

export const byId = (id) => document.getElementById(id);

/** Properties starting with "on" are listeners; "role", "for" and those with a hyphen become attributes. */
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

export const button = (text, onclick, properties = {}) => element("button", { type: "button", onclick, ...properties }, text);
export const onClick = (id, act) => byId(id).addEventListener("click", act);
export const row = (...children) => element("div", { className: "row" }, ...children);
export const note = (text = "", properties = {}) => element("p", { className: "note", ...properties }, text);

export const select = (properties, options) =>
  element("select", properties, ...options.map(([value, words]) => element("option", { value: String(value) }, words)));

/** Set text only where it differs: a selection and a screen reader stay undisturbed. */
export const setText = (node, text) => {
  if (node.textContent !== text) node.textContent = text;
};

export const setPressed = (control, isPressed) => control.setAttribute("aria-pressed", String(isPressed));

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

export const swatched = (words, colour, className = "") => {
  const swatch = element("span", { className: "swatch" });
  swatch.style.background = colour;
  return element("span", { className }, swatch, words);
};

/** A card of an area; its `aside` stands beside the title. */
export const card = (title, ...children) => {
  const aside = element("span", { className: "aside" });
  return Object.assign(element("section", { className: "card" }, element("h2", {}, title, aside), ...children), { aside });
};

/** A list of facts, filled by set({name: text}); a name whose text is null goes. */
export class Facts {
  rows = new Map();

  constructor(node) {
    this.node = node;
  }

  /** The names stay, so that nothing moves; their texts are not known any more. */
  clear() {
    for (const [, text] of this.rows.values()) setText(text, "\u2013");
  }

  set(facts) {
    for (const [name, text] of Object.entries(facts)) {
      const known = this.rows.get(name), made = known ?? [element("dt", {}, name), element("dd")];
      if (text === null) {
        made.forEach((node) => node.remove());
        this.rows.delete(name);
        continue;
      }
      if (!known) this.node.append(...made);
      this.rows.set(name, made);
      if (made[1].textContent !== text) made[1].replaceChildren(...fileName(text));
    }
  }
}

const NOTICE_MS = 8000, MAX_NOTICES = 4;

/** Say something at the edge of the page. level: "ok", "error" or "none"; offer: {text, act} of a button. */
export const notice = (text, level = "none", offer = null) => {
  const shown = byId("notices"), node = element("div", { className: "notice", "data-level": level }, element("span", {}, text));
  if (offer) node.append(button(offer.text, () => { node.remove(); offer.act(); }));
  node.append(button("\u00d7", () => node.remove(), { className: "quiet", "aria-label": "Close notice" }));
  for (const one of shown.children) if (!offer && one.firstChild.textContent === text) one.remove(); // once is enough
  shown.append(node);
  if (level !== "error") setTimeout(() => node.remove(), offer ? 4 * NOTICE_MS : NOTICE_MS);
  while (shown.children.length > MAX_NOTICES) shown.firstChild.remove();
};

/** Say what came of a request, which goes by a name; whether it was done. */
export const noticeOf = (name, answer, done) => {
  notice(answer.ok ? `${done}.` : `${name}: ${answer.error}.`, answer.ok ? "ok" : "error");
  return answer.ok;
};

let answered = Promise.resolve();

/** Ask before something happens; resolves to true or false, or, where a name is to be changed, to the new one;
 * with an alternative, `other`, to "other" for that.
 * A question waits for the answer to the one before: `close` comes some time after the dialog has closed. */
export const confirmed = (...question) => (answered = answered.then(() => ask(...question)));

const ask = (title, text, yes, given = null, other = "") => new Promise((settle) => {
  const dialog = byId("confirm"), input = byId("confirm-input");
  for (const [part, words] of Object.entries({ title, text, yes, other })) setText(byId(`confirm-${part}`), words);
  byId("confirm-other").hidden = !other;
  input.hidden = given === null;
  input.required = given !== null;
  input.value = given ?? "";
  dialog.returnValue = "no";
  dialog.addEventListener("close", () => {
    const isYes = dialog.returnValue === "yes";
    if (dialog.returnValue === "other") settle("other");
    else settle(given === null ? isYes : isYes && input.value);
  }, { once: true });
  dialog.showModal();
  if (given !== null) input.select();
});
