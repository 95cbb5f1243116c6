// One photo: large, where it is, its metadata, and changing them.

import { ask, currentMap, get } from "../api.js";
import { button, field, fill, h, note, time } from "../dom.js";
import { bytes, degrees, nameOf, when } from "../format.js";
import { openMap } from "../map.js";
import { preview } from "../photo.js";
import { coordinateTools } from "../places.js";
import { givenInWords, undoPlaces } from "./places.js";
import { readTags } from "./photos.js";
import { remove } from "./trash.js";

const LOOKALIKES = 5;

export async function showPhoto(view, { signal, id }) {
  const photo = await get(`/uploads/${id}`, { signal });
  const job = photo.searchable || !photo.job_id ? null : await get(`/jobs/${photo.job_id}`, { signal });
  document.title = `${nameOf(photo)} · ${currentMap()} · Placewise`;
  const ground = h("div", { class: "ground" });
  const form = editForm(photo);
  const removeIt = () => remove([photo], async () => {
    location.hash = location.hash === "#/photos" ? `#/photo/${id}` : "#/photos";
  });
  fill(view,
    h("header", { class: "head" },
      h("h1", { class: "file-name" }, nameOf(photo)),
      h("div", { class: "row" },
        h("a", { class: "button primary", href: `#/ask/${id}` }, "Find similar"),
        button("Remove", removeIt, "danger"))),
    h("div", { class: "one-photo" },
      h("figure", { class: "large-photo" }, preview(photo)),
      h("div", { class: "beside" },
        h("section", { class: "card" }, form.element),
        h("section", { class: "card" }, ground, h("p", { class: "soft small" }, "Click into the map to move the photo there, then save.")),
        h("section", { class: "card" }, facts(photo, job, () => window.dispatchEvent(new HashChangeEvent("hashchange")))))));
  const map = await openMap(ground, "Where this photo was taken; click to move it", { onpick: (latitude, longitude) => {
    form.setPoint(latitude, longitude);
    draw();
  }, signal });
  const draw = (fit = false) => {
    map.clear();
    const [latitude, longitude] = form.point();
    if (latitude === null || longitude === null) return;
    map.point(latitude, longitude, { radius: 8 });
    if (fit) {
      map.circle(latitude, longitude, 60, "hidden");
      map.fit();
    }
  };
  form.element.addEventListener("input", () => draw());
  draw(true);
  if (photo.latitude === null && photo.searchable) await showLookalikes(map, id, signal);
}

/** The map of a photo without coordinates opens where its look-alikes are. */
async function showLookalikes(map, id, signal) {
  const { similar_images: similar } = await get(`/similarity/${id}`, { method: "POST", query: { top_k: LOOKALIKES, box: "-90,-180,90,180", history: false }, signal });
  for (const { latitude, longitude, ...one } of similar) map.point(latitude, longitude, { kind: "behind", text: `Looks like ${nameOf(one)}` });
  map.fit();
}

function facts(photo, job, reload) {
  const state = photo.role === "query" ? "no: a test photo" : photo.searchable ? "yes" : "not yet";
  const line = (name, value) => [h("dt", {}, name), h("dd", {}, value)];
  return h("dl", { class: "facts" },
    line("Searchable", job?.state === "failed" ? h("span", { class: "bad" }, `no. ${job.error.detail}`) : state),
    photo.latitude !== null && line("Position", [degrees(photo.latitude, photo.longitude), coordinateTools(photo.latitude, photo.longitude)]),
    photo.given_place && line(photo.given_place.denied ? "Not there" : "Given", [givenInWords(photo), " ", button("Undo", async () => {
      await undoPlaces([photo.image_id]);
      reload();
    }, "link")]),
    line("Size", `${photo.width} × ${photo.height}, ${bytes(photo.file_size)}`),
    line("Taken", photo.captured_at ? when(photo.captured_at) : "not known"),
    line("Added", time(photo.upload_time)),
    Object.entries(photo.metadata).map(([name, value]) => line(name, typeof value === "string" ? value : JSON.stringify(value))));
}

// A centimetre: more digits are rounding errors of the EXIF's degrees, minutes and seconds.
const DIGITS = 7;
const rounded = (degrees) => (degrees === null ? "" : String(Number(degrees.toFixed(DIGITS))));

const numberOf = (input) => (input.value.trim() === "" ? null : Number(input.value));

function editForm(photo) {
  const latitude = h("input", { type: "number", min: -90, max: 90, step: "any", value: rounded(photo.latitude) });
  const longitude = h("input", { type: "number", min: -180, max: 180, step: "any", value: rounded(photo.longitude) });
  const place = h("input", { maxlength: 500, value: photo.place ?? "", autocomplete: "off" });
  const tags = h("input", { value: photo.tags.join(", "), autocomplete: "off" });
  const role = h("select", {}, h("option", { value: "database" }, "Can be found"), h("option", { value: "query" }, "Test photo"));
  role.value = photo.role;
  const save = async () => {
    if (!element.reportValidity()) return;
    await ask(`/uploads/${photo.image_id}`, { method: "PATCH", json: {
      latitude: numberOf(latitude), longitude: numberOf(longitude), place: place.value, tags: readTags(tags.value), role: role.value,
    } });
    note("Saved.");
  };
  const element = h("form", { class: "edit", onsubmit: (event) => {
    event.preventDefault();
    saving.click();
  } },
    h("div", { class: "pair" }, field("Latitude", latitude), field("Longitude", longitude)),
    field("Place", place, "A label, such as a room or a shelf"),
    field("Tags", tags, "Separated by commas"),
    field("Use", role, "A test photo is never found: the map is measured with it"));
  const saving = button("Save", save, "primary");
  element.append(h("div", { class: "row end" }, saving));
  return {
    element,
    point: () => [numberOf(latitude), numberOf(longitude)],
    setPoint: (lat, lng) => {
      latitude.value = lat.toFixed(6);
      longitude.value = lng.toFixed(6);
    },
  };
}
