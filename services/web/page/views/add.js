// Add photos: a few one by one, many and those of zips in batches.

import { bar, button, field, fill, h, note, noteError } from "../dom.js";
import { fileChooser, takesDrops, takesPastes } from "../drop.js";
import { bytes, count, plural } from "../format.js";
import { serverSettings } from "../settings.js";
import { localPicture } from "../photo.js";
import { UploadQueue, addedInWords } from "../uploads.js";
import { unplacedCard } from "./places.js";
import { readTags } from "./photos.js";

// The queue goes on while another view is looked at, as long as the page is open.
const queue = new UploadQueue();

export async function showAdd(view, { signal }) {
  const settings = await serverSettings();
  const details = detailsForm();
  const list = h("ul", { class: "queue" });
  const summary = h("div", { class: "summary" });
  const unplaced = h("div", {});
  const showUnplaced = () => unplacedCard(signal).then((card) => fill(unplaced, card), () => {}); // the next change asks again
  const take = async (files) => {
    const notes = await queue.add(files, details.read());
    if (notes.length) note(notes.join(" "));
  };
  const zone = addZone(settings, take);
  takesPastes(take, signal);
  fill(view, zone, details.element, summary, unplaced, list);

  const rows = new Map();
  let settled = null; // how many were done when the photos without a place were counted
  const draw = () => {
    if (signal.aborted) return;
    for (const entry of queue.entries) {
      let row = rows.get(entry);
      if (!row) {
        row = new QueueRow(entry);
        rows.set(entry, row);
      }
      row.draw();
    }
    // Failures first, then the newest.
    const order = [...queue.entries].reverse().sort((one, other) => (other.phase === "failed") - (one.phase === "failed"));
    order.forEach((entry, place) => {
      const { element } = rows.get(entry);
      if (list.children[place] !== element) list.insertBefore(element, list.children[place] ?? null);
    });
    drawSummary(summary);
    const { total, done, failed } = queue.figures();
    if (total === done + failed && total !== settled) showUnplaced();
    settled = total === done + failed ? total : null;
  };
  queue.onchange = draw;
  draw();
}

function addZone(settings, take) {
  const files = fileChooser({ "data-use": "add", accept: "image/*,.zip" }, take);
  const folder = fileChooser({ webkitdirectory: true }, take);
  const zone = h("section", { class: "drop", "aria-label": "Add photos" },
    h("div", { class: "drop-words" },
      h("h1", {}, "Add photos"),
      h("p", { class: "lead" }, "Drop photos, a folder, or a zip. Coordinates and times are read from each photo."),
      h("div", { class: "row" }, button("Choose photos", () => files.click(), "primary"), button("Choose a folder", () => folder.click(), "not-touch"), files, folder),
      h("p", { class: "soft small" }, `JPEG, PNG, WebP, BMP, TIFF or HEIC, up to ${bytes(settings.max_file_size)} each`),
      h("p", {}, "Photos without coordinates? ", h("a", { href: "#/locate" }, "Locate a folder"))));
  takesDrops(zone, take);
  return zone;
}

/** What is true of all photos that are added next. */
function detailsForm() {
  const latitude = h("input", { type: "number", min: -90, max: 90, step: "any" });
  const longitude = h("input", { type: "number", min: -180, max: 180, step: "any" });
  const place = h("input", { maxlength: 500, autocomplete: "off" });
  const tags = h("input", { autocomplete: "off" });
  const role = h("select", {}, h("option", { value: "" }, "Can be found"), h("option", { value: "query" }, "Test photos"));
  const element = h("details", { class: "card" }, h("summary", {}, "Details for these photos"),
    h("p", { class: "soft" }, "They hold for every photo that you add from here on. Empty fields are read from the photo."),
    h("div", { class: "filters-more" },
      field("Place", place, "A label, such as a room"), field("Tags", tags, "Separated by commas"),
      field("Latitude", latitude), field("Longitude", longitude),
      field("Use", role, "Test photos are never found: the map is measured with them")));
  return {
    element,
    read: () => {
      const fields = { place: place.value.trim(), tags: readTags(tags.value), role: role.value };
      for (const [name, input] of Object.entries({ latitude, longitude })) fields[name] = input.value === "" ? "" : Number(input.value);
      return Object.fromEntries(Object.entries(fields).filter(([, value]) => value !== "" && value.length !== 0));
    },
  };
}

function drawSummary(summary) {
  const { total, done, failed, already, sending } = queue.figures();
  if (!total) {
    fill(summary);
    return;
  }
  const open = total - done - failed;
  const words = open ? `${count(done)} of ${plural(total, "photo")} searchable` : failed ? `${addedInWords({ done, already })}, of ${count(total)}` : addedInWords({ done, already });
  fill(summary,
    h("div", { class: "summary-words" },
      h("h2", { role: "status" }, words),
      failed > 0 && h("p", { class: "bad" }, `${count(failed)} failed`),
      sending && open ? h("p", { class: "soft" }, "Keep this page open while photos are sent.") : null,
      h("div", { class: "row" },
        failed > 0 && queue.retryable().length > 0 && button("Try all failed again", () => queue.retryAll()),
        !open && h("a", { class: "button", href: "#/photos" }, "See the photos"),
        !open && button("Clear the list", () => {
          queue.clear();
          fill(document.querySelector(".queue"));
        }))),
    bar("Photos that are done", done + failed, total));
}

class QueueRow {
  constructor(entry) {
    this.entry = entry;
    this.state = h("p", { class: "state" });
    this.errors = h("ul", { class: "errors" });
    this.progress = h("div", { class: "row-progress" });
    this.retry = button("Try again", () => entry.retry().catch(noteError));
    this.element = h("li", { class: "queue-row" },
      entry.picture ? localPicture(entry.picture, { alt: "", width: "72", height: "54" }) : h("span", { class: "pile", "aria-hidden": "true" }, count(entry.total)),
      h("div", { class: "queue-words" }, h("p", { class: "queue-name" }, entry.name), this.state, this.progress, this.errors), this.retry);
  }

  draw() {
    const { entry } = this;
    this.element.className = `queue-row ${entry.phase}`;
    fill(this.state, entry.words());
    const busy = entry.phase === "sending" || entry.phase === "working";
    const [done, total] = entry.phase === "sending" ? [entry.sent, 1] : [entry.done + entry.failed, entry.total > 1 ? entry.total : 0];
    const known = this.progress.firstElementChild;
    if (!busy) fill(this.progress);
    else if (known && total) Object.assign(known, { max: total, value: done });
    else if (!known || known.hasAttribute("value")) fill(this.progress, bar(`${entry.name}: ${entry.words()}`, done, total));
    fill(this.errors, entry.errors.map(({ name, detail }) => h("li", {}, name && h("strong", {}, name), name && ": ", detail)), entry.unlisted > 0 && h("li", {}, `${count(entry.errors.length)} of ${count(entry.failed)} failures are listed.`));
    this.retry.hidden = !entry.canRetry;
  }
}
