// The frame: which view is shown, of which map.

import { UNREACHABLE, ask, chooseMap, currentMap, get, post } from "./api.js";
import { field, fill, h, noteError, openDialog } from "./dom.js";
import { percent } from "./format.js";
import { showAsk } from "./views/ask.js";

/** The page's own files can't be loaded. A browser does not import a module again that has failed: the page must be. */
class Unloaded extends Error {}

const onDemand = (load, name) => async (...view) => {
  const module = await load().catch((cause) => {
    throw new Unloaded(UNREACHABLE, { cause });
  });
  await module[name](...view);
};

// The first view comes with the page; the others are loaded on demand.
const VIEWS = {
  ask: { title: "Ask", show: showAsk },
  photos: { title: "Photos", show: onDemand(() => import("./views/photos.js"), "showPhotos") },
  photo: { title: "Photo", show: onDemand(() => import("./views/photo.js"), "showPhoto") },
  places: { title: "Places to give", show: onDemand(() => import("./views/places.js"), "showPlaces") },
  trash: { title: "Trash", show: onDemand(() => import("./views/trash.js"), "showTrash") },
  reconstruction: { title: "Reconstruction", show: onDemand(() => import("./views/reconstruction.js"), "showReconstruction") },
  tracks: { title: "Tracks", show: onDemand(() => import("./views/tracks.js"), "showTracks") },
  add: { title: "Add", show: onDemand(() => import("./views/add.js"), "showAdd") },
  locate: { title: "Locate a folder", show: onDemand(() => import("./views/locate.js"), "showLocate") },
  model: { title: "Model", show: onDemand(() => import("./views/model.js"), "showModel") },
  status: { title: "Status", show: onDemand(() => import("./views/status.js"), "showStatus") },
};
const TAB_OF = { locate: "add", photo: "photos", places: "photos", trash: "photos", reconstruction: "model", tracks: "model" };
// Where to go from an address that names nothing.
const LIST_OF = { photo: ["#/photos", "All photos"], tracks: ["#/tracks", "All tracks"], ask: ["#/ask", "Ask with a photo"] };
const NEW_MAP = "\n"; // no map's name

const IMPROVING_SECONDS = 5;

const main = document.getElementById("main");
const improving = document.getElementById("improving");
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
      href ? h("a", { class: "button", href }, list) : h("button", { type: "button", onclick: () => (error instanceof Unloaded ? location.reload() : route()) }, "Try again")));
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

/** The line below the header while the server fits a vocabulary, which people who add photos do not ask for. */
async function showImprovement() {
  if (document.hidden) return;
  // Without a key, the view asks for one, and not this line every few seconds.
  const response = await ask("/jobs", { query: { kind: "fit", state: ["queued", "running"], limit: 1 }, also: [401] });
  const [job] = response.ok ? (await response.json()).jobs : [];
  if (job) {
    const { stateInWords } = await import("./jobs.js");
    const { done, total } = job.progress;
    fill(improving, h("strong", {}, job.label), `: ${stateInWords(job)}, ${percent(total ? done / total : 0)}`);
  }
  improving.hidden = !job;
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
setInterval(() => showImprovement().catch(() => (improving.hidden = true)), IMPROVING_SECONDS * 1000);
listMaps().then(route, (error) => {
  noteError(error);
  route();
});
