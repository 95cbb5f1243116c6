// What a person says about an answer: put the photo there, where it really was, or only that it is wrong. All are evidence that the map is measured with.

import { ask, idempotencyKey, post, send } from "../api.js";
import { button, field, h, note, openDialog } from "../dom.js";
import { openMap } from "../map.js";
import { givePlace } from "./places.js";

/** Keeps a photo that is not stored as a test photo with this place, or only without the `denied` one. */
export async function keepAsTestPhoto(file, { denied, latitude, longitude, place }) {
  const form = new FormData();
  for (const [name, value] of Object.entries({ role: "query", ...(denied ? {} : { latitude, longitude, place }) })) if (value !== null && value !== "") form.append(name, value);
  form.append("file", file, file.name);
  const stored = await send("/upload", form, { key: idempotencyKey(), onSent: () => {} });
  if (stored.already_there) {
    note(denied ? "The map has this photo already. Ask with it there to say that its answer is wrong." : "The map has this photo already, with this place.");
    return false;
  }
  if (denied) await post("/places", { json: { photos: [{ file_id: stored.file_id, ...denied }] } });
  note(denied ? "Kept as a test photo that was not taken there." : "Kept as a test photo with this place: the map is measured with it.", "", async () => {
    await ask(`/uploads/${stored.file_id}`, { method: "DELETE", query: { permanently: true } });
    note("The test photo is removed again.");
  });
}

/** Gives a stored photo that has no place one that a person chose, or keeps that it was not taken at the `denied` one. */
export const giveByHand = (id, { denied, latitude, longitude, place }) =>
  givePlace({ file_id: id, ...(denied ?? { latitude, longitude, place: place || null }) });

/** The buttons below an answer; `keep(place)` stores what the person says. */
export function corrections({ estimate, similar_images: similar }, keep, signal) {
  const { latitude, longitude, place, has_place: hasPlace } = estimate;
  const kept = (action, words = "Thank you. The next measurement of the map counts it.") => async () => {
    if ((await action()) !== false) row.replaceChildren(h("p", { class: "soft" }, words));
  };
  const row = h("div", { class: "row corrections" },
    hasPlace && button("Put this photo there", kept(() => keep({ latitude, longitude, place }))),
    button("This is wrong", async () => {
      const chosen = await choosePlace(estimate, similar, signal);
      if (chosen) await kept(() => keep(chosen), chosen.denied && "Thank you. With 40 test photos whose place is known, measurements of the map count it, too.")();
    }, "link"));
  return row;
}

/** A dialog that asks where a photo was really taken; null if it is closed. */
async function choosePlace(estimate, similar, signal) {
  const latitude = h("input", { type: "number", min: -90, max: 90, step: "any" });
  const longitude = h("input", { type: "number", min: -180, max: 180, step: "any" });
  const place = h("input", { maxlength: 500, autocomplete: "off" });
  const ground = h("div", { class: "ground" });
  const form = h("form", { method: "dialog" },
    h("p", {}, "Where was it taken? Click into the map, which may lead far away from these photos, or name the place.", estimate.has_place && " If you don’t know, say only that it was not taken there."),
    ground,
    h("div", { class: "pair" }, field("Latitude", latitude), field("Longitude", longitude)),
    field("Place", place, "A label, such as a room, in a map of labels"),
    h("div", { class: "row end" },
      h("button", { type: "button", onclick: () => dialog.close() }, "Cancel"),
      estimate.has_place && h("button", { type: "button", onclick: () => dialog.close("denied") }, "I don’t know"),
      h("button", { class: "primary", value: "yes" }, "Save")));
  // Both coordinates or a label.
  const check = () => {
    const half = (latitude.value === "") !== (longitude.value === "");
    latitude.setCustomValidity(half ? "Enter both coordinates." : latitude.value === "" && !place.value.trim() ? "Click into the map, or name the place." : "");
  };
  form.addEventListener("input", check);
  check();
  const { dialog, closed } = openDialog("Where was it?", form);
  signal.addEventListener("abort", () => dialog.close());
  const drawn = { point: null };
  const map = await openMap(ground, "Where the photo was taken; click to choose", { signal, onpick: (lat, lng) => {
    latitude.value = lat.toFixed(6);
    longitude.value = lng.toFixed(6);
    check();
    drawn.point?.remove();
    drawn.point = map.point(lat, lng, { radius: 8, kind: "query" });
  } });
  for (const photo of similar) if (photo.latitude !== null) map.point(photo.latitude, photo.longitude, { kind: "behind" });
  if (estimate.latitude !== null) map.circle(estimate.latitude, estimate.longitude, estimate.radius_m ?? 100, "estimate");
  map.fit();
  const said = await closed;
  if (said === "denied") {
    const { latitude: lat, longitude: lng, radius_m: radius, place: label } = estimate;
    return { denied: { denied: true, latitude: lat, longitude: lng, radius_m: radius, place: label } };
  }
  if (said !== "yes") return null;
  const number = (input) => (input.value === "" ? null : Number(input.value));
  return { latitude: number(latitude), longitude: number(longitude), place: place.value.trim() };
}
