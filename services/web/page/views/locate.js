// Locate a folder: proposals for photos without coordinates, in a table and on the map, as CSV or GPX.

import { currentMap, get } from "../api.js";
import { announce, bar, button, field, fill, h, note, noteError } from "../dom.js";
import { fileChooser, takesDrops, withoutHidden } from "../drop.js";
import { count, degrees, metres, nameOf, percent, plural } from "../format.js";
import { shrinkPhoto } from "../shrink.js";
import { findSimilar, readHeader as headerOf } from "./ask.js";

const SIMILAR = 50;
const WITH_COORDINATES = "-90,-180,90,180"; // a box around all photos with coordinates
const AT_ONCE = 3;
const PER_CALL = 100; // photos without coordinates, as the server allows
const TRACK_POINTS = 5000;
const PHOTO = /\.(jpe?g|jpe|jfif|png|webp|bmp|tiff?|heic|heif)$/i;
const OWN_ZONE = Intl.DateTimeFormat().resolvedOptions().timeZone;

export async function showLocate(view, { signal }) {
  const map = await get(`/maps/${encodeURIComponent(currentMap())}`, { signal });
  const together = h("input", { type: "checkbox" });
  const motion = h("select", {}, ["walk", "bicycle", "car", "train"].map((kind) => h("option", { value: kind }, kind)));
  const zone = h("select", {}, [...new Set([OWN_ZONE, "UTC", ...Intl.supportedValuesOf("timeZone")])].map((name) => h("option", { value: name }, name)));
  const ahead = h("input", { type: "number", step: "any", value: 0, required: true });
  const least = h("input", { type: "number", min: 0, max: 100, step: 1, value: 95, required: true });
  const progress = h("div", {});
  const result = h("div", { class: "view" });
  let track = [];
  let photos = [];

  const propose = async () => {
    setTimes(photos, zone.value, Number(ahead.value));
    const proposals = await proposePositions(photos, track, { motion: motion.value, together: together.checked }, signal);
    const draw = () => drawResult(result, photos, proposals, Number(least.value) / 100, signal).catch(fail);
    least.onchange = draw;
    await draw();
  };
  const fail = (error) => !signal.aborted && noteError(error);
  const take = async (chosenFiles) => {
    const files = withoutHidden(chosenFiles);
    const tracks = files.filter(({ path }) => /\.gpx$/i.test(path));
    const sidecars = files.filter(({ path }) => /\.xmp$/i.test(path)).length;
    if (sidecars) note(`${plural(sidecars, "sidecar")} (XMP) not read here: run placewise locate.`);
    if (tracks.length) track = [];
    for (const { file } of tracks) track.push(...readTrack(await file.text(), file.name));
    const chosen = files.filter(({ path }) => PHOTO.test(path));
    if (!chosen.length && !photos.length) {
      note(track.length ? "Now add the photos of the trip." : "There are no photos in it.");
      return;
    }
    if (chosen.length) photos = await readPhotos(chosen, map, progress, signal);
    await propose();
  };
  for (const input of [together, motion, zone, ahead]) input.addEventListener("change", () => photos.length && propose().catch(fail));
  fill(view,
    locateZone(map, (files) => take(files).catch(fail)),
    h("section", { class: "card filters-more" },
      field("The photographer moved by", motion),
      field("Accept from", least, "Probability in %"),
      field("Time zone of the cameras", zone, "For photos whose EXIF has none"),
      field("The clock was ahead by", ahead, "Seconds, for the cameras of photos without coordinates"),
      h("label", { class: "check" }, together, h("span", {}, "The cameras travelled together: photos of a phone show where a camera was"))),
    progress, result);
}

function locateZone(map, take) {
  const files = fileChooser({ "data-use": "locate", accept: "image/*,.gpx" }, take);
  const folder = fileChooser({ webkitdirectory: true }, take);
  const zone = h("section", { class: "drop", "aria-label": "Locate a folder" },
    h("div", { class: "drop-words" },
      h("h1", {}, "Locate a folder"),
      h("p", { class: "lead" }, `Drop a folder of photos. Placewise proposes where those without coordinates were taken: by similar photos of the map “${map.name}”, by photos of the same camera shortly before and after, and by a GPX track if you add its file.`),
      h("div", { class: "row" }, button("Choose a folder", () => folder.click(), "primary not-touch"), button("Choose photos or a GPX file", () => files.click()), folder, files),
      h("p", { class: "soft small" }, "Nothing is stored or changed.")));
  takesDrops(zone, take);
  return zone;
}

/** Headers of all photos, and searches with those that have no coordinates. */
async function readPhotos(files, map, progress, signal) {
  const photos = files.toSorted((one, other) => one.path.localeCompare(other.path)).map(({ file, path }) => ({ file, name: path, clock: null, captured_at: null, time_zone_is_known: false, camera: null, latitude: null, longitude: null, search: null, error: null }));
  const step = async (label, some, work) => {
    let done = 0;
    const next = some.values();
    const show = () => fill(progress, h("p", { class: "soft" }, `${label}: ${count(done)} of ${plural(some.length, "photo")}`), bar(label, done, some.length));
    show();
    await Promise.all(Array.from({ length: AT_ONCE }, async () => {
      for (const photo of next) {
        signal.throwIfAborted();
        try {
          await work(photo);
        } catch (error) {
          if (signal.aborted || ![413, 415, 422].includes(error.status)) throw error;
          photo.error = error.message;
        }
        done += 1;
        show();
      }
    }));
  };
  try {
    await step("Reading times and coordinates", photos, (photo) => readHeader(photo, signal));
    await step("Looking for similar photos", photos.filter((photo) => photo.latitude === null && !photo.error && !photo.unread), (photo) => search(photo, map, signal));
  } finally {
    fill(progress);
  }
  return photos;
}

async function readHeader(photo, signal) {
  if (photo.file.size === 0) {
    photo.error = "The file is empty.";
    return;
  }
  const { captured_at: time, time_zone_is_known: zoned, focal_length: focal, gps_error: unread, ...header } = await headerOf(photo.file, signal);
  Object.assign(photo, header, { clock: time && { time: Date.parse(time), zoned }, focal, unread });
}

/** Set `captured_at` by the cameras' clocks: those without a time zone, which no GPS time of the camera
 * shows to the server, show that of `zone`, and those of photos without coordinates are `ahead` by so
 * many seconds. */
function setTimes(photos, zone, ahead) {
  const known = new Set(photos.filter(({ clock_offset: offset }) => offset).map(({ camera }) => camera));
  const unlocated = new Set(photos.filter(({ latitude }) => latitude === null).map(({ camera }) => camera));
  for (const photo of photos.filter(({ clock }) => clock)) {
    const { time, zoned } = photo.clock;
    const seconds = unlocated.has(photo.camera) ? ahead : 0;
    photo.time_zone_is_known = zoned || !photo.camera || !known.has(photo.camera);
    photo.captured_at = new Date((zoned || !photo.time_zone_is_known ? time : toUtc(time, zone)) - 1000 * seconds).toISOString();
  }
}

/** The time at which clocks of the zone show `shown`; both in milliseconds, `shown` as if it were UTC. */
function toUtc(shown, zone) {
  const format = new Intl.DateTimeFormat("sv", { timeZone: zone, dateStyle: "short", timeStyle: "medium" });
  const offset = (time) => Date.parse(`${format.format(time).replace(" ", "T")}Z`) - Math.floor(time / 1000) * 1000;
  // The offset at the result, which may be another one where daylight saving time begins or ends.
  return shown - offset(shown - offset(shown));
}

async function search(photo, map, signal) {
  const file = await shrinkPhoto(photo.file, map.extractor);
  const find = (query) => findSimilar("/similarity", { top_k: SIMILAR, history: false, ...query }, file, () => {}, signal);
  const found = await find({ pose: true, focal_length: photo.focal });
  // Photos of the map without coordinates, such as this one, hide those that have some.
  const { similar_images: similar } = found.matches_without_place ? await find({ box: WITH_COORDINATES }) : found;
  const { estimate, pose } = found;
  const named = estimate.has_place || estimate.levels.length > 0;
  photo.search = {
    similar: similar.filter(({ latitude }) => named && latitude !== null).map((match) => ({ name: nameOf(match), latitude: match.latitude, longitude: match.longitude, score: match.similarity_score })),
    circles: estimate.levels.filter(({ radius_m: radius }) => radius !== null).map(({ latitude, longitude, radius_m, probability }) => ({ latitude, longitude, radius_m, probability })),
    not_in_map: estimate.not_in_map_probability ?? estimate.elsewhere ?? 1,
    headline: estimate.headline,
    pose: pose?.radius_68_m == null ? null : { latitude: pose.latitude, longitude: pose.longitude, radius_68_m: pose.radius_68_m, heading: pose.heading },
  };
}

/** The points of a GPX track that have a time; every n-th of a very long one. */
export function readTrack(text, name) {
  const parsed = new DOMParser().parseFromString(text, "application/xml");
  const points = Array.from(parsed.getElementsByTagNameNS("*", "trkpt"), (point) => ({
    time: point.getElementsByTagNameNS("*", "time")[0]?.textContent.trim(),
    latitude: Number(point.getAttribute("lat")),
    longitude: Number(point.getAttribute("lon")),
  })).filter(({ time }) => !Number.isNaN(Date.parse(time)));
  if (!points.length) throw new Error(`${name} has no track points with a time.`);
  const every = Math.ceil(points.length / TRACK_POINTS);
  return points.filter((_, index) => index % every === 0).map((point) => ({ ...point, time: new Date(point.time).toISOString() }));
}

async function proposePositions(photos, track, options, signal) {
  const sent = photos.filter(({ unread }) => !unread).map(({ file, error, clock, focal, unread, ...photo }) => photo);
  const located = sent.filter(({ latitude }) => latitude !== null);
  const others = sent.filter(({ latitude }) => latitude === null);
  const proposals = [];
  for (let begin = 0; begin < others.length; begin += PER_CALL) {
    const json = { ...options, photos: [...located, ...others.slice(begin, begin + PER_CALL)], track };
    proposals.push(...(await get("/positions", { method: "POST", json, signal })).proposals);
  }
  return proposals;
}

async function drawResult(result, photos, proposals, least, signal) {
  const accepted = proposals.filter(({ latitude, probability }) => latitude !== null && probability >= least);
  const located = photos.filter(({ latitude }) => latitude !== null);
  const errors = new Map(photos.map(({ name, error }) => [name, error]));
  const ground = h("div", { class: "ground browse" });
  const words = `${plural(proposals.length, "photo")} without coordinates, ${count(accepted.length)} accepted`;
  const chip = (proposal) => {
    const [words, kind] = accepted.includes(proposal) ? ["accepted", "own"] : errors.get(proposal.name) ? ["failed", "failed"] : ["uncertain", ""];
    return h("span", { class: `chip ${kind}` }, words);
  };
  const row = (proposal) => h("tr", {},
    h("td", { class: "name" }, proposal.name),
    h("td", {}, proposal.latitude === null ? "–" : `${degrees(proposal.latitude, proposal.longitude)} ± ${metres(proposal.radius_m)}`),
    h("td", { class: "number" }, percent(proposal.probability)),
    h("td", {}, chip(proposal)),
    h("td", { class: "name" }, errors.get(proposal.name) ?? proposal.reason));
  const known = proposals.some(({ latitude }) => latitude !== null) || located.length > 0;
  fill(result,
    known && ground,
    h("section", { class: "card" },
      h("header", { class: "head" }, h("h2", { role: "status" }, words),
        h("div", { class: "row" },
          accepted.length > 0 && button("Download CSV", () => download("placewise-locations.csv", "text/csv", csvOf(accepted)), "primary"),
          accepted.length > 0 && button("Download GPX", () => download("placewise-locations.gpx", "application/gpx+xml", gpxOf(accepted, photos))))),
      photos.some(({ unread }) => unread) && h("p", { class: "hint" }, `${plural(photos.filter(({ unread }) => unread).length, "photo")} with a GPS tag that could not be read, left out: `, photos.filter(({ unread }) => unread).map(({ name, unread }) => `${name} (${unread})`).join(", ")),
      h("p", { class: "soft small" }, `${plural(located.length, "photo")} with coordinates. To write into photos or sidecars, run `, h("code", {}, "placewise locate"), "."),
      h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Proposals" }, h("table", { class: "stacked" },
        h("thead", {}, h("tr", {}, ["Photo", "Position", "Probability", "", "Reason"].map((name) => h("th", { scope: "col", class: name === "Probability" ? "number" : "" }, name || h("span", { class: "visually-hidden" }, "Accepted"))))),
        h("tbody", {}, proposals.map(row))))));
  announce(words);
  if (!known) return;
  const { openMap } = await import("../map.js");
  const map = await openMap(ground, "The photos with coordinates, and the proposals", { signal });
  for (const { name, latitude, longitude } of located) map.point(latitude, longitude, { kind: "behind", radius: 4, text: name });
  for (const proposal of proposals.filter(({ latitude }) => latitude !== null)) {
    const kind = accepted.includes(proposal) ? "tracking" : "converging";
    map.point(proposal.latitude, proposal.longitude, { kind, text: `${proposal.name}: ${percent(proposal.probability)}` });
  }
  map.fit();
}

// An apostrophe before what a spreadsheet would run as a formula: `placewise index --csv` removes it.
const quoted = (text) => `"${text.replace(/^(?='*[=+@\t\r-])/, "'").replaceAll('"', '""')}"`;
const csvOf = (accepted) => ["filename,latitude,longitude,heading", ...accepted.map(({ name, latitude, longitude, heading }) => `${quoted(name)},${latitude},${longitude},${heading ?? ""}`), ""].join("\n");

function gpxOf(accepted, photos) {
  const times = new Map(photos.map(({ name, captured_at: time }) => [name, time]));
  const gpx = document.implementation.createDocument("http://www.topografix.com/GPX/1/1", "gpx");
  const add = (parent, name, text = "") => {
    const element = gpx.createElementNS(gpx.documentElement.namespaceURI, name);
    element.textContent = text;
    parent.append(element);
    return element;
  };
  gpx.documentElement.setAttribute("version", "1.1");
  gpx.documentElement.setAttribute("creator", "Placewise");
  for (const { name, latitude, longitude, probability, radius_m: radius, reason } of accepted) {
    const point = add(gpx.documentElement, "wpt");
    point.setAttribute("lat", latitude);
    point.setAttribute("lon", longitude);
    if (times.get(name)) add(point, "time", times.get(name));
    add(point, "name", name);
    add(point, "desc", `${percent(probability)} within ${metres(radius)}: ${reason}`);
  }
  return new XMLSerializer().serializeToString(gpx);
}

function download(name, type, text) {
  const address = URL.createObjectURL(new Blob([text], { type }));
  h("a", { href: address, download: name }).click();
  URL.revokeObjectURL(address);
}
