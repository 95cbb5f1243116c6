// Elements without a framework: h("p", { class: "soft" }, "text", child).

import { ago, when } from "./format.js";

/** An element. `on...` are listeners, true and false are attributes with no value; a null is left out. */
export function h(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key === "value") element.value = value;
    else element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** A relative time; the exact one is its title. */
export const time = (text) => h("time", { datetime: text, title: when(text) }, ago(text));

/** Put these in the place of all that is in the element. */
export function fill(element, ...children) {
  element.replaceChildren(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** A button; `onclick` may take its time, and the button can't be pressed again meanwhile. */
export function button(label, onclick, kind = "") {
  const element = h("button", { type: "button", class: kind }, label);
  element.addEventListener("click", async () => {
    // Not `disabled`: that would take the keyboard's place away.
    if (element.getAttribute("aria-disabled") === "true") return;
    element.setAttribute("aria-disabled", "true");
    try {
      await onclick();
    } catch (error) {
      noteError(error);
    } finally {
      element.removeAttribute("aria-disabled");
    }
  });
  return element;
}

let hints = 0;

/** The views below *Advanced*, above each of them. */
export function advancedTabs(current) {
  const link = (view, title) => h("a", { href: `#/${view}`, class: "button", "aria-current": view === current ? "page" : null }, title);
  return h("nav", { class: "row subtabs", "aria-label": "Advanced" }, link("model", "Model"), link("reconstruction", "Reconstruction"), link("tracks", "Tracks"));
}

/** A field with its label; the hint is no part of its name. */
export function field(label, input, hint = null) {
  const small = hint && h("small", { id: `hint-${++hints}` }, hint);
  if (small) input.setAttribute("aria-describedby", small.id);
  return h("div", { class: "field" }, h("label", {}, h("span", {}, label), input), small);
}

/** A bar with its meaning in words. `done` of `total`; an unknown total moves. */
export function bar(label, done, total) {
  const known = total > 0;
  return h("progress", { "aria-label": label, max: known ? total : null, value: known ? done : null });
}

/** A short message at the lower edge, in the place of an equal one; read out by screen readers. `undo` is what its button does. */
export function note(text, kind = "", undo = null) {
  const notes = document.getElementById("notes");
  for (const earlier of [...notes.children]) if (earlier.firstChild.data === text) earlier.remove();
  const line = h("p", { class: `note ${kind}` }, text,
    undo && button("Undo", async () => {
      await undo();
      line.remove();
    }, "link"),
    h("button", { type: "button", class: "bare", "aria-label": "Close this message", onclick: () => line.remove() }, "×"));
  notes.append(line);
  setTimeout(() => line.remove(), undo ? 30_000 : kind === "bad" ? 12_000 : 5000);
}

/** Announce to screen readers what has changed on the screen. */
export function announce(text) {
  document.getElementById("announcement").textContent = text;
}

/** What went wrong, unless the view was only left. */
export function noteError(error) {
  if (error.name !== "AbortError") note(error.message, "bad");
}

/** A dialog with the keyboard's focus in it; resolves with what closed it. */
export function openDialog(title, ...content) {
  const heading = h("h2", { id: "dialog-title", tabindex: "-1" }, title);
  const close = h("button", { type: "button", class: "bare close", "aria-label": "Close" }, "×");
  const dialog = h("dialog", { "aria-labelledby": "dialog-title" }, h("header", {}, heading, close), ...content);
  close.addEventListener("click", () => dialog.close());
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
  document.body.append(dialog);
  dialog.showModal();
  const closed = new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue);
    });
  });
  return { dialog, heading, closed };
}

/** Ask before `action`, a button of the style `kind`; true when it is chosen. */
export async function confirmed(title, text, action, { kind = "danger", otherwise = "Keep" } = {}) {
  const { dialog, closed } = openDialog(
    title,
    h("p", {}, text),
    h("div", { class: "row end" },
      h("button", { type: "button", onclick: () => dialog.close("") }, otherwise),
      h("button", { type: "button", class: kind, onclick: () => dialog.close("yes") }, action)),
  );
  return (await closed) === "yes";
}
