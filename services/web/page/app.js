// The frame: which view is shown, of which map.

import { chooseMap, currentMap, get, post } from "./api.js";
import { field, fill, h, noteError, openDialog } from "./dom.js";
import { showAsk } from "./views/ask.js";

// The first view comes with the page; the others are loaded on demand.
const VIEWS = {
  ask: { title: "Ask", show: showAsk },
  photos: { title: "Photos", show: async (...view) => (await import("./views/photos.js")).showPhotos(...view) },
  photo: { title: "Photo", show: async (...view) => (await import("./views/photo.js")).showPhoto(...view) },
  tracks: { title: "Tracks", show: async (...view) => (await import("./views/tracks.js")).showTracks(...view) },
  add: { title: "Add", show: async (...view) => (await import("./views/add.js")).showAdd(...view) },
  locate: { title: "Locate a folder", show: async (...view) => (await import("./views/locate.js")).showLocate(...view) },
  model: { title: "Model", show: async (...view) => (await import("./views/model.js")).showModel(...view) },
  status: { title: "Status", show: async (...view) => (await import("./views/status.js")).showStatus(...view) },
};
const TAB_OF = { locate: "add", photo: "photos", tracks: "model" };
// Where to go from an address that names nothing.
const LIST_OF = { photo: ["#/photos", "All photos"], tracks: ["#/tracks", "All tracks"], ask: ["#/ask", "Ask with a photo"] };
const NEW_MAP = "\n"; // no map's name

const main = document.getElementById("main");
const choice = document.getElementById("map-choice");
let leave = new AbortController();
let first = true;

/** Show what the address names: #/VIEW or #/VIEW/ID. Aborted when it is left. */
async function route() {
  leave.abort();
  leave = new AbortController();
  const { signal } = leave;
  const [, name = "ask", id = null] = location.hash.split("/");
  const view = VIEWS[name] ?? VIEWS.ask;
  document.title = `${view.title} · ${currentMap()} · Placewise`;
  for (const link of document.querySelectorAll(".tabs a")) {
    const here = link.hash === `#/${TAB_OF[name] ?? name}`;
    link.toggleAttribute("aria-current", here);
    if (here) link.setAttribute("aria-current", "page");
  }
  const element = h("div", { class: "view" });
  fill(main, element);
  window.scrollTo(0, 0);
  if (!first) main.focus({ preventScroll: true });
  first = false;
  try {
    await view.show(element, { signal, id: id && decodeURIComponent(id) });
  } catch (error) {
    if (signal.aborted) return;
    const [href, list] = (id && error.status === 404 && LIST_OF[name]) || [];
    fill(element, h("section", { class: "card empty" }, h("h1", {}, "This can’t be shown"), h("p", {}, error.message),
      href ? h("a", { class: "button", href }, list) : h("button", { type: "button", onclick: route }, "Try again")));
  }
}

async function listMaps() {
  const maps = await get("/maps");
  if (!maps.some((map) => map.name === currentMap())) chooseMap("default");
  fill(choice,
    maps.map((map) => h("option", { value: map.name }, map.name)),
    h("option", { value: NEW_MAP }, "New map…"));
  choice.value = currentMap();
}

async function makeMap() {
  const name = h("input", { required: true, maxlength: 100, pattern: "[A-Za-z0-9][A-Za-z0-9._\\-]*", autocomplete: "off", spellcheck: "false" });
  const { dialog, closed } = openDialog("A new map", h("form", { method: "dialog" },
    h("p", {}, "Photos of one city, building or trail belong in one map, which gets a vocabulary of its own."),
    field("Name", name, "Letters, digits, “.”, “_” and “-”"),
    h("div", { class: "row end" }, h("button", { type: "button", onclick: () => dialog.close() }, "Cancel"), h("button", { class: "primary", value: "yes" }, "Create"))));
  if ((await closed) !== "yes") return;
  await post("/maps", { json: { name: name.value } });
  chooseMap(name.value);
}

choice.addEventListener("change", async () => {
  try {
    if (choice.value === NEW_MAP) await makeMap();
    else chooseMap(choice.value);
    await listMaps();
  } catch (error) {
    choice.value = currentMap();
    noteError(error);
  }
  const [, name, id] = location.hash.split("/");
  if (id) location.hash = name === "photo" ? "#/photos" : `#/${name}`; // what it names is in the other map
  else route();
});
// Its address is no view's.
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault();
  main.focus();
});
// What is dropped beside the field would be opened in the page's place.
for (const name of ["dragover", "drop"]) document.addEventListener(name, (event) => event.preventDefault());
window.addEventListener("hashchange", route);
listMaps().then(route, (error) => {
  noteError(error);
  route();
});
