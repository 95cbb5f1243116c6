// Files from a drop, a folder of a drop, the clipboard, or a chooser.

import { h } from "./dom.js";

/** Every file of a drop, folders opened; each with its path from there as `path`. */
export async function droppedFiles(transfer) {
  const entries = Array.from(transfer.items, (item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (!entries.length) return Array.from(transfer.files, (file) => ({ file, path: file.name }));
  const found = [];
  for (const entry of entries) await walk(entry, "", found);
  return found;
}

async function walk(entry, folder, found) {
  const path = folder + entry.name;
  if (entry.isFile) {
    const file = await new Promise((resolve, reject) => entry.file(resolve, reject));
    found.push({ file, path });
    return;
  }
  const reader = entry.createReader();
  while (true) {
    // A hundred at a time, until none is left.
    const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!some.length) return;
    for (const one of some) await walk(one, `${path}/`, found);
  }
}

/** Files of the system, such as macOS's `._a.jpg`, are no photos: `files` without them, as [{file, path}]. */
export const withoutHidden = (files) => files.filter(({ path }) => !path.split("/").some((part) => part.startsWith(".") || part === "__MACOSX"));

/** Let files be dropped on the element; `onfiles` gets them as [{file, path}]. */
export function takesDrops(element, onfiles) {
  element.addEventListener("dragover", (event) => {
    event.preventDefault();
    element.classList.add("over");
  });
  element.addEventListener("dragleave", (event) => {
    if (!element.contains(event.relatedTarget)) element.classList.remove("over");
  });
  element.addEventListener("drop", async (event) => {
    event.preventDefault();
    element.classList.remove("over");
    onfiles(await droppedFiles(event.dataTransfer));
  });
}

/** The clipboard's picture, wherever it is pasted, until the view is left. */
export function takesPastes(onfiles, signal) {
  document.addEventListener("paste", (event) => {
    const files = Array.from(event.clipboardData?.files ?? []);
    if (files.length) onfiles(files.map((file) => ({ file, path: file.name })));
  }, { signal });
}

/** A hidden input of files or of a folder, which a button opens. */
export function fileChooser(attributes, take) {
  const input = h("input", { type: "file", multiple: true, class: "hidden", tabindex: "-1", "aria-hidden": "true", ...attributes });
  input.addEventListener("change", () => {
    take(Array.from(input.files, (file) => ({ file, path: file.webkitRelativePath || file.name })));
    input.value = "";
  });
  return input;
}
