// Browse the map's photos: filter them, see where they are, tag and delete several at once.

import { ask, get } from "../api.js";
import { button, field, fill, h, note, noteError, openDialog, time } from "../dom.js";
import { count, day, folderOf, nameOf, plural, whereabouts } from "../format.js";
import { openMap } from "../map.js";
import { thumbnail } from "../photo.js";
import { unplacedCard } from "./places.js";
import { remove } from "./trash.js";

const PAGE = 48;
const ON_THE_MAP = 1000; // the API's largest page
const TYPING_MS = 300;

export async function showPhotos(view, { signal }) {
  const chosen = new Map();
  const grid = h("ul", { class: "photos" });
  const total = h("p", { class: "total", role: "status" });
  const more = h("div", { class: "more" });
  const ground = h("div", { class: "ground browse", hidden: true });
  const cut = h("p", { class: "soft small", hidden: true });
  const tools = h("div", { class: "tools", hidden: true });
  const unplaced = h("div", {});
  let opening = null;
  let folder = null; // of the last photo of the grid

  const { form, query, setNear, setFolder } = filterForm(reload);
  const mapButton = button("Show the map", async () => {
    ground.hidden = cut.hidden = !ground.hidden;
    mapButton.textContent = ground.hidden ? "Show the map" : "Hide the map";
    mapButton.setAttribute("aria-expanded", String(!ground.hidden));
    if (!ground.hidden) await drawMap();
  });
  mapButton.setAttribute("aria-expanded", "false");
  fill(view,
    h("header", { class: "head" }, h("h1", {}, "Photos"), h("div", { class: "row" }, mapButton, h("a", { class: "button", href: "#/trash" }, "Trash"), h("a", { class: "button primary", href: "#/add" }, "Add photos"))),
    unplaced, form, ground, cut, total, tools, grid, more);
  unplacedCard(signal).then((card) => fill(unplaced, card), (error) => !signal.aborted && noteError(error));

  async function reload() {
    chosen.clear();
    drawTools();
    fill(grid);
    folder = null;
    await load(null);
    if (!ground.hidden) await drawMap();
  }

  let turn = 0;
  async function load(cursor) {
    const mine = ++turn; // what was typed meanwhile is newer
    let page;
    try {
      page = await get("/search", { query: { ...query(), limit: PAGE, cursor }, signal });
    } catch (error) {
      if (mine === turn) fill(total, h("span", { class: "bad" }, error.message));
      return;
    }
    if (mine !== turn) return;
    fill(total, page.total_found === 0 ? "" : `${page.total_is_exact ? "" : "more than "}${plural(page.total_found, "photo")}`);
    grid.append(...page.images.flatMap((photo) => [folderHeading(photo), h("li", {}, card(photo))]).filter(Boolean));
    fill(more, page.next_cursor && button("Show more", () => load(page.next_cursor)));
    if (page.total_found === 0) fill(more, nothing(Object.entries(query()).some(([name, value]) => name !== "sort" && value)));
  }

  /** The folder of a photo, where another one begins. */
  function folderHeading(photo) {
    const begins = folderOf(photo) !== (folder ?? "");
    folder = folderOf(photo);
    return begins && h("li", { class: "folder" }, folder ? [h("h2", {}, folder), button("Only this folder", () => setFolder(`${folderOf(photo)}/`), "link")] : h("h2", {}, "Without a folder"));
  }

  function card(photo) {
    const box = h("input", { type: "checkbox", "aria-label": `Select ${nameOf(photo)}` });
    box.addEventListener("change", () => {
      if (box.checked) chosen.set(photo.image_id, photo);
      else chosen.delete(photo.image_id);
      drawTools();
    });
    const corner = h("span", { class: "chip corner", hidden: photo.role !== "query" }, "test photo");
    const onundescribed = () => {
      corner.textContent = "not searchable";
      corner.classList.add("foreign");
      corner.hidden = false;
    };
    return h("article", { class: "photo-card" },
      h("a", { href: `#/photo/${photo.image_id}`, "aria-label": nameOf(photo) }, thumbnail(photo, "", onundescribed)),
      box, corner,
      h("p", { class: "photo-name", title: nameOf(photo) }, photo.place ?? nameOf(photo)),
      h("p", { class: "soft" }, photo.captured_at ? day(photo.captured_at) : ["added ", time(photo.upload_time)]),
      (photo.latitude !== null || !photo.place) && h("p", { class: "soft" }, whereabouts({ ...photo, place: null })),
      photo.tags.length > 0 && h("p", { class: "chips" }, photo.tags.map((tag) => h("span", { class: "chip" }, tag))));
  }

  function drawTools() {
    tools.hidden = chosen.size === 0;
    fill(tools, chosen.size > 0 && [
      h("strong", {}, plural(chosen.size, "photo") + " selected"),
      button("Tag…", tagChosen), button("Remove", removeChosen, "danger"),
      button("Clear selection", () => {
        for (const box of grid.querySelectorAll("input:checked")) box.checked = false;
        chosen.clear();
        drawTools();
      }),
    ]);
  }

  async function tagChosen() {
    const input = h("input", { required: true, autocomplete: "off" });
    const { dialog, closed } = openDialog("Tag photos", h("form", { method: "dialog" },
      field("Tags to add", input, "Separated by commas"),
      h("div", { class: "row end" }, h("button", { type: "button", onclick: () => dialog.close() }, "Cancel"), h("button", { class: "primary", value: "yes" }, "Add"))));
    if ((await closed) !== "yes") return;
    const added = readTags(input.value);
    await each((photo) => ask(`/uploads/${photo.image_id}`, { method: "PATCH", json: { tags: [...new Set([...photo.tags, ...added])] } }), "tagged");
  }

  const removeChosen = () => remove([...chosen.values()], reload);

  async function each(change, done) {
    const photos = [...chosen.values()];
    let changed = 0;
    try {
      for (const photo of photos) {
        await change(photo);
        changed += 1;
      }
    } finally {
      if (changed) note(`${changed < photos.length ? `${count(changed)} of ` : ""}${plural(photos.length, "photo")} ${done}.`);
      await reload();
    }
  }

  async function drawMap() {
    opening ??= openMap(ground, "Where the photos were taken; click to look around a point", { onpick: setNear, signal });
    const map = await opening;
    const page = await get("/search", { query: { ...query(), limit: ON_THE_MAP }, signal });
    map.clear();
    for (const photo of page.images) {
      if (photo.latitude === null) continue;
      map.point(photo.latitude, photo.longitude, { kind: photo.role, text: photo.place ?? nameOf(photo), onclick: (event) => {
        L.DomEvent.stopPropagation(event);
        location.hash = `#/photo/${photo.image_id}`;
      } });
    }
    const { near } = query();
    if (near) map.circle(...near.split(",").map(Number), "estimate");
    const all = `${page.total_is_exact ? "" : "more than "}${count(page.total_found)}`;
    fill(cut, page.next_cursor && `The map shows ${count(page.images.length)} of ${all} photos, the newest. Filter to see others.`);
    map.fit();
  }

  await reload();
}

export const readTags = (text) => text.split(",").map((tag) => tag.trim()).filter(Boolean);

function nothing(filtered) {
  return filtered
    ? h("section", { class: "card empty" }, h("h2", {}, "No photo matches the filter"), h("p", {}, "Clear a field: a photo must match all of them."))
    : h("section", { class: "card empty" }, h("img", { src: "/console/place.svg", alt: "", width: "176", height: "144" }), h("h2", {}, "This map has no photos yet"), h("p", {}, "Add photos whose place is known: from a phone, whose photos carry coordinates, or with a place of your own."), h("a", { class: "button primary", href: "#/add" }, "Add photos"));
}

/** The filter's fields; `query()` reads them as the API's parameters. */
function filterForm(onchange) {
  const name = h("input", { type: "search", autocomplete: "off" });
  const tags = h("input", { autocomplete: "off", placeholder: "winter, north" });
  const near = h("input", { autocomplete: "off", placeholder: "latitude, longitude", inputmode: "text" });
  const radius = h("input", { type: "number", min: 1, value: "100" });
  const after = h("input", { type: "date" });
  const before = h("input", { type: "date" });
  const role = h("select", {}, h("option", { value: "" }, "All"), h("option", { value: "database" }, "Can be found"), h("option", { value: "query" }, "Test photos"));
  const without = h("input", { type: "checkbox" });
  const sort = h("select", {}, h("option", { value: "added" }, "Newest added first"), h("option", { value: "taken" }, "Newest taken first, dated ones only"));
  let timer;
  const changed = () => {
    clearTimeout(timer);
    timer = setTimeout(() => onchange().catch(noteError), TYPING_MS);
  };
  const form = h("form", { class: "filters card", role: "search", "aria-label": "Filter the photos", oninput: changed, onsubmit: (event) => event.preventDefault() },
    field("Name or folder", name), field("Tags", tags), field("Order", sort),
    h("label", { class: "check" }, without, h("span", {}, "Without a place")),
    h("details", {}, h("summary", {}, "More filters"), h("div", { class: "filters-more" },
      field("Near", near, "Or click into the map"), field("Within metres", radius),
      field("Taken from", after), field("Taken until", before), field("Use", role))));
  return {
    form,
    query: () => ({
      filename: name.value.trim(),
      tags: readTags(tags.value).join(","),
      near: near.value.trim() && `${near.value.replaceAll(" ", "")},${radius.value}`,
      captured_after: after.value,
      captured_before: before.value && `${before.value}T23:59:59`,
      role: role.value,
      without_place: without.checked || "",
      sort: sort.value,
    }),
    setFolder: (path) => {
      name.value = path;
      changed();
    },
    setNear: (latitude, longitude) => {
      near.value = `${latitude.toFixed(6)}, ${longitude.toFixed(6)}`;
      form.querySelector("details").open = true;
      changed();
    },
  };
}
