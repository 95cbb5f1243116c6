// Ask with a photo: which known place is this?

import { Problem, ask, currentMap, get, idempotencyKey } from "../api.js";
import { announce, bar, button, fill, h, noteError } from "../dom.js";
import { takesDrops, takesPastes } from "../drop.js";
import { count, nameOf, percent, plural, score, strength, whereabouts } from "../format.js";
import { stateInWords, watchJob } from "../jobs.js";
import { localPicture, mayNeedPreview, preview, thumbnail } from "../photo.js";
import { shrinkPhoto } from "../shrink.js";
import { corrections, giveByHand, keepAsTestPhoto } from "./correct.js";
import { drawPose, seenPoints } from "./pose.js";
import { drawRings, judge, measurementInWords, verdict } from "./verdict.js";

const TOP_K = 12;
const NEWEST = 14;
const WAIT_SECONDS = 10;
const HEADER_BYTES = 256 * 1024;
const LOOK_MS = 4000; // between two looks at a measurement

export async function showAsk(view, { signal, id }) {
  const answer = h("div", { class: "answer" });
  if (id) {
    const photo = await get(`/uploads/${id}`, { signal });
    const queryPhoto = {
      name: nameOf(photo),
      picture: () => preview(photo, `The query photo: ${nameOf(photo)}`),
      find: (query, onjob) => findSimilar(`/similarity/${id}`, query, null, onjob, signal),
      // Of a photo with a place, the map knows how right the answer is.
      keep: photo.latitude === null && photo.place === null ? (place) => giveByHand(id, place) : null,
    };
    fill(view, h("h1", {}, "Which photos show this place?"), answer);
    await showAnswer(answer, queryPhoto, signal);
    return;
  }
  const map = await readMap(signal);
  if (map.photos === 0) {
    fill(view, emptyMap(map));
    return;
  }
  const entry = askEntry(map, (file) => {
    const small = shrinkPhoto(file, map.extractor);
    const described = Promise.withResolvers();
    const shown = mayNeedPreview(file) ? described.promise.then((job) => ask(`/jobs/${job}/preview`, { signal })).catch(() => null) : null;
    const queryPhoto = {
      name: file.name,
      picture: () => localPicture(file, { alt: `The query photo: ${file.name}` }, shown),
      keep: (place) => keepAsTestPhoto(file, place),
      find: async (query, onjob) => {
        const sent = await small;
        // A copy has no EXIF; it is answered all the same if that of the original can't be read.
        const header = sent === file ? {} : await readHeader(file, signal).catch(() => ({}));
        return findSimilar("/similarity", { ...query, focal_length: header.focal_length }, sent, onjob, signal, shown && described.resolve);
      },
    };
    view.classList.add("answered");
    return showAnswer(answer, queryPhoto, signal);
  }, signal);
  const newest = h("section", { class: "newest" });
  fill(view, entry, answer, newest);
  if (map.searchable) await showNewest(newest, signal);
}

/** Photos of the map, to ask with one of them. */
async function showNewest(newest, signal) {
  const { images } = await get("/search", { query: { limit: NEWEST, role: "database" }, signal });
  fill(newest,
    h("h2", {}, "Or ask with a photo of the map"),
    h("ul", { class: "mosaic" }, images.map((photo) => {
      const item = h("li", {}, h("a", { href: `#/ask/${photo.image_id}`, "aria-label": `Ask with ${nameOf(photo)}` }, thumbnail(photo, "", () => item.remove())));
      return item;
    })));
}

/** What a visitor sees first: there is nothing to ask yet. */
const emptyMap = (map) => h("section", { class: "card empty" },
  h("img", { src: "/console/place.svg", alt: "", width: "176", height: "144" }),
  h("h1", {}, "Where was this taken?"),
  h("p", { class: "lead" }, "Placewise finds out where a photo was taken by comparing it with photos whose place is known."),
  h("a", { class: "button primary", href: "#/add" }, "Add photos"),
  h("p", {}, `The map “${map.name}” has none yet. Your photos stay on this server.`));

function askEntry(map, onfile, signal) {
  const take = (files) => {
    if (files.length) onfile(files[0].file).catch((error) => !signal.aborted && noteError(error));
  };
  const chooser = (attributes) => {
    const input = h("input", { type: "file", accept: "image/*", class: "hidden", tabindex: "-1", "aria-hidden": "true", ...attributes });
    input.addEventListener("change", () => {
      take(Array.from(input.files, (file) => ({ file })));
      input.value = "";
    });
    return input;
  };
  const choose = chooser({ "data-use": "ask" });
  const camera = chooser({ capture: "environment" });
  const known = map.searchable
    ? `Placewise compares it with ${plural(map.searchable, "photo")} of the map “${map.name}”.`
    : null;
  const zone = h("section", { class: "drop", "aria-label": "Ask with a photo" },
    h("div", { class: "drop-words" },
      h("h1", {}, "Where was this taken?"),
      h("p", { class: "lead" }, "Drop a photo here, paste one, or choose one. ", known),
      map.photos > 0 && !map.searchable && h("p", { class: "hint" }, `The ${plural(map.photos, "photo")} of this map are not described yet. `, h("a", { href: "#/status" }, "See how far it is")),
      h("div", { class: "row" },
        button("Choose a photo", () => choose.click(), "primary"),
        button("Take a photo", () => camera.click(), "only-touch"),
        choose, camera)),
    h("img", { class: "drop-mark", src: "/console/place.svg", alt: "", width: "220", height: "180" }));
  takesDrops(zone, take);
  takesPastes(take, signal);
  return zone;
}

const PIXELS = { PNG: ["IDAT"], WEBP: ["VP8 ", "VP8L", "ALPH", "ANMF"] };

/** The part of a photo's file with its metadata: of a PNG or WebP all but the pixels, which metadata
 * may follow; of others the beginning. */
async function withoutPixels(file) {
  const read = async (begin, size) => new DataView(await file.slice(begin, begin + size).arrayBuffer());
  const letters = (view, begin) => String.fromCharCode(...new Uint8Array(view.buffer, begin, 4));
  const head = file.size < 16 ? null : await read(0, 16);
  const isPng = head?.getUint32(0) === 0x89504e47;
  const kept = [];
  if (!isPng && !(head && letters(head, 0) === "RIFF" && letters(head, 8) === "WEBP" && letters(head, 12) === "VP8X")) return file.slice(0, HEADER_BYTES);
  for (let begin = isPng ? 8 : 12; begin + 8 <= file.size;) {
    const chunk = await read(begin, 8);
    const size = isPng ? 12 + chunk.getUint32(0) : 8 + 2 * Math.ceil(chunk.getUint32(4, true) / 2);
    if (!PIXELS[isPng ? "PNG" : "WEBP"].includes(letters(chunk, isPng ? 4 : 0))) kept.push(file.slice(begin, begin + size));
    begin += size;
  }
  const bytes = new Uint32Array([4 + kept.reduce((all, { size }) => all + size, 0)]); // of a RIFF's content
  return new Blob([...(isPng ? [file.slice(0, 8)] : [file.slice(0, 4), bytes, file.slice(8, 12)]), ...kept]);
}

/** What the header of a photo's file says. */
export async function readHeader(file, signal) {
  const response = await ask("/photo-headers", { method: "POST", body: await withoutPixels(file), headers: { "Content-Type": "application/octet-stream" }, signal });
  return response.json();
}

/** The answer to a photo, stored or not; `onjob` is called while it takes longer than a moment,
 * `ondescribed` with the id of the job that has described the photo. */
export async function findSimilar(path, query, file, onjob, signal, ondescribed = null) {
  const form = file ? new FormData() : null;
  form?.append("file", file, file.name);
  let response = await ask(path, {
    method: "POST",
    query,
    body: form,
    // A response that is waited for does not name its job.
    headers: { ...(ondescribed ? {} : { Prefer: `wait=${WAIT_SECONDS}` }), "Idempotency-Key": idempotencyKey() },
    signal,
  });
  if (response.status === 202) {
    const started = await response.json();
    const ended = await watchJob(started.job_id, onjob, signal);
    if (ended.state !== "succeeded") throw new Problem(422, ended.error ?? { detail: "The photo could not be described." }, null);
    ondescribed?.(started.job_id);
    response = await ask(started.result_url, { signal });
  }
  return response.json();
}

let questions = 0;

async function showAnswer(answer, queryPhoto, signal) {
  const mine = ++questions; // of two that overlap, the later one is shown
  const progress = h("p", { class: "soft" }, "Looking…");
  fill(answer, h("section", { class: "card asking" }, h("figure", {}, queryPhoto.picture()), h("div", {}, h("h2", {}, "Looking for the place"), bar("Looking for the place", 0, 0), progress)));
  answer.scrollIntoView({ block: "start" });
  let found;
  try {
    const { matching } = await readMap(signal);
    found = await queryPhoto.find({ top_k: TOP_K, matches: TOP_K, explain: matching !== "off", pose: true }, (job) => fill(progress, `The photo is ${stateInWords(job)}.`));
  } catch (error) {
    if (signal.aborted) throw error;
    if (mine !== questions) return;
    fill(answer, h("section", { class: "card refused" }, h("figure", {}, queryPhoto.picture()), h("div", {}, h("h2", {}, "No answer"), h("p", {}, error.message))));
    return;
  }
  if (mine !== questions) return;
  const photos = byProbability(found.similar_images);
  const { openMap } = await import("../map.js");
  const { compare } = await import("./compare.js");
  const open = (index) => compare(queryPhoto, found, photos, index, signal);
  const located = (found.pose?.latitude ?? null) !== null || photos.some((photo) => photo.latitude !== null);
  const ground = h("div", { class: "ground" });
  // Without levels, an estimate has no probabilities.
  const map = !found.estimate.levels.length && judge(found.estimate)[1] !== "No estimate" ? await readMap(signal) : null;
  const measurement = map && map.measurement !== "measured" ? h("p", { class: "reason" }) : null;
  fill(answer,
    h("section", { class: "result" },
      h("figure", { class: "query-photo" }, queryPhoto.picture(), seenPoints(found.pose), h("figcaption", {}, queryPhoto.name)),
      h("div", { class: "verdict-column" }, verdict(found, measurement, photos[0]), queryPhoto.keep && corrections(found, queryPhoto.keep, signal)),
      located ? ground : null),
    h("section", {},
      h("h2", { class: "matches-title" }, photos.length ? "Most similar photos" : "No photo found"),
      h("ol", { class: "matches" }, photos.map((photo, index) => h("li", {}, matchCard(photo, index, () => open(index))))),
      photos.length > 0 && figures(photos)));
  if (measurement) {
    const askAgain = () => showAnswer(answer, queryPhoto, signal);
    followMeasurement(measurement, map, askAgain, () => mine === questions && answer.isConnected, signal);
  }
  announce(`${answer.querySelector(".badge").textContent}. ${plural(photos.length, "similar photo")}.`);
  if (located) await drawAnswer(openMap, ground, found, photos, open, signal);
}

const readMap = (signal) => get(`/maps/${encodeURIComponent(currentMap())}`, { signal });

/** Say in the element whether the map is measured, and ask again once it is. */
function followMeasurement(element, map, askAgain, isShown, signal) {
  const look = async () => {
    const { measurement, located } = map;
    map = await readMap(signal);
    if (!isShown()) return;
    if (map.measurement === "measured") askAgain().catch((error) => !signal.aborted && noteError(error));
    else if (map.measurement !== measurement || map.located !== located) draw();
  };
  const draw = () => fill(element, measurementInWords(map, look));
  draw();
  const timer = setInterval(() => {
    if (signal.aborted || !isShown() || map.measurement === "measured") clearInterval(timer);
    else if (!document.hidden) look().catch(() => {}); // until the server can be reached again
  }, LOOK_MS);
}

/** The photos in the order of the number that they are shown with; those of equal probability as they are ranked, and those without a place where they are ranked. */
function byProbability(photos) {
  const likely = photos.filter(hasProbability).sort((one, other) => other.match_probability - one.match_probability);
  return photos.map((photo) => (hasProbability(photo) ? likely.shift() : photo));
}

const hasProbability = (photo) => photo.match_probability !== null;

async function drawAnswer(openMap, ground, { estimate, pose }, photos, open, signal) {
  const map = await openMap(ground, "Where the matches were taken", { signal });
  drawRings(map, estimate);
  drawPose(map, pose);
  // From the last to the first, so that the best lies on top.
  photos.map((photo, index) => ({ photo, index })).reverse().forEach(({ photo, index }) => {
    if (photo.latitude !== null) map.numbered(photo.latitude, photo.longitude, index + 1, `${index + 1}: ${nameOf(photo)}`, () => open(index));
  });
  map.fit();
}

function matchCard(photo, index, onclick) {
  const name = nameOf(photo);
  const word = strength(photo.match_probability);
  const where = photo.place && photo.latitude === null ? name : whereabouts({ ...photo, place: null });
  const likely = word ? `, ${word} match, ${percent(photo.match_probability)} the same place` : "";
  const points = photo.inliers === null ? null : plural(photo.inliers, "matching point");
  return h("button", { type: "button", class: "match", onclick, "aria-label": `Match ${index + 1}${likely}${points ? `, ${points}` : ""}: ${name}` },
    thumbnail(photo, ""),
    h("span", { class: "rank", "aria-hidden": "true" }, String(index + 1)),
    word && h("span", { class: "match-words" },
      h("span", { class: `strength ${word}` }, word),
      h("span", { class: "figure", title: "Probability that it shows the same place" }, percent(photo.match_probability))),
    h("span", { class: "match-name", title: name }, photo.place ?? name),
    points && h("span", { class: "soft match-points" }, points),
    h("span", { class: "soft match-where" }, where));
}

/** The numbers behind the ranking. */
function figures(photos) {
  const likely = photos.some(hasProbability);
  const order = likely
    ? `Photos are in the order of the probability that they show the same place. It is computed from all similarities. A match is strong from 80 %, fair from 30 %, and weak below. Photos without coordinates or a label keep their place in the order of similarity.`
    : "Photos are in the order of their similarity.";
  const matched = photos.some((photo) => photo.inliers !== null);
  const heads = ["", "Photo", ...(likely ? ["Same place"] : []), ...(matched ? ["Matching points"] : []), "Similarity"];
  const numbers = (photo) => [
    ...(likely ? [percent(photo.match_probability)] : []), ...(matched ? [photo.inliers === null ? "–" : count(photo.inliers)] : []), score(photo.similarity_score),
  ];
  return h("details", { class: "card figures" }, h("summary", {}, "Details"),
    h("p", { class: "soft" }, `${order} Similarity is the cosine of two descriptors.`),
    h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Numbers of the matches" }, h("table", {},
      h("thead", {}, h("tr", {}, heads.map((name, column) => h("th", { scope: "col", class: column > 1 ? "number" : "" }, name || h("span", { class: "visually-hidden" }, "Rank"))))),
      h("tbody", {}, photos.map((photo, index) => h("tr", {},
        h("td", {}, String(index + 1)), h("td", { class: "name" }, nameOf(photo)),
        numbers(photo).map((number) => h("td", { class: "number" }, number))))))));
}
