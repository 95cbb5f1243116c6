// Ask with a photo: which known place is this?

import { Problem, ask, currentMap, get, idempotencyKey } from "../api.js";
import { bar, button, fill, h, noteError, say } from "../dom.js";
import { takesDrops, takesPastes } from "../drop.js";
import { count, degrees, percent, plural, score, whereabouts } from "../format.js";
import { stateInWords, watchJob } from "../jobs.js";
import { original, thumbnail } from "../photo.js";

const TOP_K = 12;
const NEWEST = 14;
const WAIT_SECONDS = 10;

export async function showAsk(view, { signal, id }) {
  const answer = h("div", { class: "answer" });
  if (id) {
    const photo = await get(`/uploads/${id}`, { signal });
    const asked = {
      name: photo.original_filename,
      picture: () => original(photo, `The photo asked with: ${photo.original_filename}`),
      find: (query, onjob) => findSimilar(`/similarity/${id}`, query, null, onjob, signal),
    };
    fill(view, h("h1", {}, "Which photos show this place?"), answer);
    await showAnswer(answer, asked, signal);
    return;
  }
  const map = await get(`/maps/${encodeURIComponent(currentMap())}`, { signal });
  const entry = askEntry(map, (file) => {
    const asked = {
      name: file.name,
      picture: () => localPicture(file, signal),
      find: (query, onjob) => findSimilar("/similarity", query, file, onjob, signal),
    };
    view.classList.add("asked");
    return showAnswer(answer, asked, signal);
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
    h("ul", { class: "mosaic" }, images.map((photo) => h("li", {}, h("a", { href: `#/ask/${photo.image_id}`, "aria-label": `Ask with ${photo.original_filename}` }, thumbnail(photo, ""))))));
}

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
      map.searchable ? null : h("p", { class: "hint" }, map.photos ? `The ${plural(map.photos, "photo")} of this map are not described yet. ` : `The map “${map.name}” has no photos yet, so nothing can be found. `, map.photos ? h("a", { href: "#/status" }, "See how far it is") : h("a", { href: "#/add" }, "Add some first")),
      h("div", { class: "row" },
        button("Choose a photo", () => choose.click(), "primary"),
        button("Take a photo", () => camera.click(), "only-touch"),
        choose, camera)),
    h("img", { class: "drop-mark", src: "/console/place.svg", alt: "", width: "220", height: "180" }));
  takesDrops(zone, take);
  takesPastes(take, signal);
  return zone;
}

/** A file of this machine as a picture. */
function localPicture(file, signal) {
  const url = URL.createObjectURL(file);
  signal.addEventListener("abort", () => URL.revokeObjectURL(url));
  return h("img", { src: url, alt: `The photo asked with: ${file.name}` });
}

/** The answer to a photo, stored or not; `onjob` is told while it takes longer than a moment. */
async function findSimilar(path, query, file, onjob, signal) {
  const form = file ? new FormData() : null;
  form?.append("file", file, file.name);
  let response = await ask(path, {
    method: "POST",
    query,
    body: form,
    headers: { Prefer: `wait=${WAIT_SECONDS}`, "Idempotency-Key": idempotencyKey() },
    signal,
  });
  // 202: its job first; of a photo that is then compared, a second one.
  while (response.status === 202) {
    const started = await response.json();
    const ended = await watchJob(started.job_id, onjob, signal);
    if (ended.state !== "succeeded") throw new Problem(422, ended.error ?? { detail: "The photo could not be described." }, null);
    response = await ask(started.result_url, { signal });
  }
  return response.json();
}

let questions = 0;

async function showAnswer(answer, asked, signal) {
  const mine = ++questions; // of two that overlap, the later one is shown
  const progress = h("p", { class: "soft" }, "Looking…");
  fill(answer, h("section", { class: "card asking" }, h("figure", {}, asked.picture()), h("div", {}, h("h2", {}, "Looking for the place"), bar("Looking for the place", 0, 0), progress)));
  answer.scrollIntoView({ block: "start" });
  let found;
  try {
    found = await asked.find({ top_k: TOP_K }, (job) => fill(progress, `The photo is ${stateInWords(job)}.`));
  } catch (error) {
    if (signal.aborted) throw error;
    if (mine !== questions) return;
    fill(answer, h("section", { class: "card refused" }, h("figure", {}, asked.picture()), h("div", {}, h("h2", {}, "No answer"), h("p", {}, error.message))));
    return;
  }
  if (mine !== questions) return;
  const photos = found.similar_images;
  const { openMap } = await import("../map.js");
  const { compare } = await import("./compare.js");
  const open = (index) => compare(asked, photos, index, signal);
  const located = photos.some((photo) => photo.latitude !== null);
  const ground = h("div", { class: "ground" });
  fill(answer,
    h("section", { class: "result" },
      h("figure", { class: "query-photo" }, asked.picture(), h("figcaption", {}, asked.name)),
      verdict(found),
      located ? ground : null),
    h("section", {},
      h("h2", { class: "matches-title" }, photos.length ? "Most similar photos" : "No photo is similar enough"),
      h("ol", { class: "matches" }, photos.map((photo, index) => h("li", {}, matchCard(photo, index, () => open(index)))))));
  say(`${answer.querySelector(".badge").textContent}. ${plural(photos.length, "similar photo")}.`);
  if (located) await drawAnswer(openMap, ground, found, open, signal);
}

async function drawAnswer(openMap, ground, found, open, signal) {
  const map = await openMap(ground, "Where the matches were taken", { signal });
  const { estimate, similar_images: photos } = found;
  if (estimate.latitude !== null) map.circle(estimate.latitude, estimate.longitude, estimate.radius_m, "estimate");
  // From the last to the first, so that the best lies on top.
  photos.map((photo, index) => ({ photo, index })).reverse().forEach(({ photo, index }) => {
    if (photo.latitude !== null) map.numbered(photo.latitude, photo.longitude, index + 1, `${index + 1}: ${photo.original_filename}`, () => open(index));
  });
  map.fit();
}

function verdict(found) {
  const { estimate } = found;
  const [kind, title] = { true: ["known", "In this map"], false: ["unknown", "Not in this map"] }[estimate.in_map] ?? ["open", "Best guess"];
  const place = [
    estimate.place && h("p", { class: "place" }, estimate.place),
    estimate.latitude !== null && h("p", { class: estimate.place ? "where" : "place where" }, degrees(estimate.latitude, estimate.longitude), h("span", { class: "radius" }, ` ± ${Math.round(estimate.radius_m)} m`)),
  ];
  const unsure = {
    true: ["How sure this is can’t be said yet: ", h("a", { href: "#/add" }, "add labelled queries"), " of another day."],
    false: ["The photos below are the nearest that the map has."],
  }[estimate.in_map] ?? ["Whether it is in the map can’t be told yet: ", h("a", { href: "#/model" }, "measure the map"), "."];
  const sure = estimate.confidence === null
    ? h("p", { class: "soft" }, unsure)
    : h("div", { class: "sure" }, h("span", { class: "figure" }, percent(estimate.confidence)), h("span", { class: "soft" }, " sure"), h("meter", { min: 0, max: 1, value: estimate.confidence, "aria-label": "Confidence" }));
  return h("div", { class: `verdict ${kind}` },
    h("p", { class: "badge" }, title),
    place, sure,
    h("details", {}, h("summary", {}, "Why"),
      h("p", {}, estimate.reason),
      h("dl", { class: "facts" },
        h("dt", {}, "Compared"), h("dd", {}, `${count(found.rows_scanned)} rows, ${found.certificate}`),
        h("dt", {}, "Ranked by"), h("dd", {}, found.word_weights === "applied" ? "similarity of the words that this map trusts" : "similarity"),
        h("dt", {}, "Took"), h("dd", {}, `${found.processing_time_ms.toFixed(0)} ms`),
        h("dt", {}, "Vocabulary"), h("dd", {}, found.vocabulary))),
    found.vocabulary === "foreign" && h("p", { class: "hint" }, "This map uses a vocabulary of elsewhere. ", h("a", { href: "#/model" }, "Fit its own"), " and the right place comes first more often."),
    found.missing.length > 0 && h("p", { class: "hint bad" }, `Degraded: a part of the map could not be searched (${found.missing.join(", ")}).`));
}

function matchCard(photo, index, onclick) {
  return h("button", { type: "button", class: "match", onclick, "aria-label": `Match ${index + 1}, similarity ${score(photo.similarity_score)}: ${photo.original_filename}` },
    thumbnail(photo, ""),
    h("span", { class: "rank", "aria-hidden": "true" }, String(index + 1)),
    h("span", { class: "match-words" },
      h("span", { class: "match-name" }, photo.place ?? photo.original_filename),
      h("span", { class: "figure" }, score(photo.similarity_score))),
    h("span", { class: "soft match-where" }, photo.place && photo.latitude === null ? photo.original_filename : whereabouts({ ...photo, place: null })));
}
