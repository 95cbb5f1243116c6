// How good the map's answers are, and what they are made with: vocabularies and model versions.

import { ask, currentMap, download, get, post } from "../api.js";
import { advancedTabs, button, field, fill, h, note, noteError, openDialog, time } from "../dom.js";
import { count, percent, plural } from "../format.js";
import { followJob } from "../jobs.js";

const CHANGES = { fit: "Improving the map", import_vocabulary: "Importing a vocabulary", switch: "Switching the vocabulary", pca: "Fitting a PCA" };
const RECALLS = ["R@1", "R@5", "R@10"];

const STANDING = {
  own: ["Its own", "The vocabulary was fitted on this map’s photos. Fit it again when you have added many."],
  provisional: ["Provisional", "The vocabulary was fitted when this map had fewer than 50 photos. Fit it again when it has more: nothing improves the answers as much."],
  foreign: ["Foreign", "The vocabulary was fitted on photos of other places. Fit one on this map’s photos: nothing improves the answers as much."],
  pending: ["Not yet", "Until this map has a vocabulary, its photos are compared by an average of their features. Fit one: nothing improves the answers as much."],
  none: ["None", "This extractor uses no vocabulary."],
};

export async function showModel(view, { signal }) {
  const path = `/maps/${encodeURIComponent(currentMap())}`;
  const [map, generations, vocabularies, { evaluations }, { jobs }, { models }] = await Promise.all([
    get(path, { signal }), get("/generations", { signal }), get("/vocabularies", { signal }),
    get("/evaluations", { query: { limit: 50 }, signal }),
    get("/jobs", { query: { kind: Object.keys(CHANGES), state: ["queued", "running"] }, signal }),
    get("/models", { signal }).catch(() => ({ models: [] })), // a key of single maps may not list them
  ]);
  const again = () => showModel(view, { signal });
  const work = h("div", { class: "work" });
  const follow = (job, words) => followJob(work, job, words, again, signal);
  const [standing, meaning] = STANDING[map.vocabulary] ?? ["Not yet", "The map has no descriptors yet. Photos that wait for a vocabulary are described once one is fitted."];
  const fits = map.vocabulary !== "none";
  fill(view,
    h("header", { class: "head" }, h("h1", {}, "Model"), advancedTabs("model")),
    h("section", { class: "card standing" },
      h("div", {}, h("h2", {}, "Model in use"),
        h("dl", { class: "facts" },
          h("dt", {}, "Extractor"), h("dd", {}, map.extractor),
          h("dt", {}, "Dimension"), h("dd", {}, map.dimension ? count(map.dimension) : "–"),
          h("dt", {}, "Photos"), h("dd", {}, `${count(map.searchable)} of ${count(map.photos)} searchable`),
          h("dt", {}, "Vocabulary"), h("dd", {}, h("span", { class: `chip ${map.vocabulary ?? ""}` }, standing)),
          h("dt", {}, "Labels"), h("dd", {}, labelsField(map, path)),
          h("dt", {}, "Queries from elsewhere"), h("dd", {}, elsewhereField(map, path), " %"))),
      h("div", { class: "standing-words" },
        h("p", {}, map.photos ? meaning : "This map has no photos yet: there is nothing to fit a vocabulary on."),
        map.photos ? fits && button(["own", "provisional"].includes(map.vocabulary) ? "Fit it again…" : "Fit a vocabulary…", () => fitVocabulary(follow), "primary") : h("a", { class: "button primary", href: "#/add" }, "Add photos"),
        fits && automatic(map, path, again)),
      work),
    comparison(evaluations, generations, vocabularies, () => measure(follow)),
    generationsTable(generations, vocabularies),
    vocabulariesTable(vocabularies, generations, follow),
    modelsTable(models, map, follow));
  for (const job of jobs.slice(0, 1)) follow(job, CHANGES[job.kind]);
}

/** Whether the map gets vocabularies of its own photos without being asked. */
function automatic(map, path, again) {
  const box = h("input", { type: "checkbox", checked: map.auto_fit });
  box.addEventListener("change", () => ask(path, { method: "PATCH", json: { auto_fit: box.checked } }).then(again, noteError));
  return h("label", { class: "check" }, box, h("span", {}, "Improve this map automatically", map.next_fit_photos ? ` (next time at ${plural(map.next_fit_photos, "photo")})` : ""));
}

const LABELS = { auto: "as they look", true: "paths, such as tower/floor 7", false: "names" };

/** Whether labels are paths: by their look, or as it is chosen here. */
function labelsField(map, path) {
  const input = h("select", { "aria-label": "Labels" }, Object.entries(LABELS).map(([value, words]) => h("option", { value }, value === "auto" && map.place_labels_are_automatic ? `${words} (${map.place_labels_are_paths ? "paths" : "names"})` : words)));
  input.value = map.place_labels_are_automatic ? "auto" : String(map.place_labels_are_paths);
  input.addEventListener("change", () => ask(path, { method: "PATCH", json: { place_labels_are_paths: JSON.parse(input.value === "auto" ? '"auto"' : input.value) } }).then(() => note("Saved."), noteError));
  return input;
}

/** The share of the map's queries that are from elsewhere, in percent. */
function elsewhereField(map, path) {
  const input = h("input", { type: "number", "aria-label": "Queries from elsewhere", min: 1, max: 99, required: true, value: Math.round(100 * map.elsewhere) });
  input.addEventListener("change", () => input.reportValidity() && ask(path, { method: "PATCH", json: { elsewhere: input.valueAsNumber / 100 } }).then(() => note("Saved."), noteError));
  return input;
}

async function fitVocabulary(follow) {
  const clusters = h("input", { type: "number", min: 1, max: 4096, placeholder: "set by the extractor" });
  const sample = h("input", { type: "number", min: 1, value: "500" });
  const { dialog, closed } = openDialog("Fit a vocabulary", h("form", { method: "dialog" },
    h("p", {}, "Centres are found in this map’s own photos, and every photo is described again with them. Answers go on meanwhile; the new descriptors take over when all are ready."),
    h("div", { class: "pair" }, field("Clusters", clusters), field("Photos to fit on, at most", sample)),
    h("div", { class: "row end" }, h("button", { type: "button", onclick: () => dialog.close() }, "Cancel"), h("button", { class: "primary", value: "yes" }, "Fit it"))));
  if ((await closed) !== "yes") return;
  const options = { sample: Number(sample.value) || 500, clusters: Number(clusters.value) || null };
  follow(await post("/vocabularies", { json: options }), CHANGES.fit);
}

async function measure(follow) {
  follow(await post("/evaluations", { json: {} }), "Measuring the map");
}

/** The newest measurement of each of the two newest generations that have one, side by side. */
function comparison(evaluations, generations, vocabularies, onmeasure) {
  const measured = [];
  for (const evaluation of evaluations) {
    if (measured.length < 2 && !measured.some((one) => one.generation_id === evaluation.generation_id)) measured.push(evaluation);
  }
  const [after, before] = measured;
  const head = h("header", { class: "head" }, h("h2", {}, before ? "Before and after" : "How good the answers are"), button("Measure now", onmeasure));
  if (!after) {
    return h("section", { class: "card" }, head, h("p", {}, "Not measured yet. Placewise searches with the map’s own photos, each left out once, and counts how often another photo of the same place comes first. It does so automatically once 20 photos have coordinates or a place."));
  }
  const nameOf = (evaluation) => nameGeneration(generations.find((one) => one.generation_id === evaluation.generation_id), vocabularies);
  const sets = [["labelled_queries", "Test photos"], ["leave_one_out_without_sequence", "The map’s own photos, each searched without the photos of its minute and its numbered series"], ["leave_one_out", "The map’s own photos, each left out once. This flatters: the photo before it and the one after it are easy to find"]];
  return h("section", { class: "card" }, head,
    h("p", { class: "soft" }, `Right means within ${after.figures.radius_m} m, or the same place label. R@k: the share of queries with a right photo among the first k.`),
    h("div", { class: "comparisons" }, sets.filter(([set]) => after.figures[set]?.queries).map(([set, title]) =>
      h("table", { class: "recalls" },
        h("caption", {}, `${title} (${count(after.figures[set].queries)})`),
        h("thead", {}, h("tr", {}, h("th", { scope: "col" }, ""), before && h("th", { scope: "col" }, "Before", h("small", {}, nameOf(before))), h("th", { scope: "col" }, before ? "After" : "Now", h("small", {}, nameOf(after))), before && h("th", { scope: "col" }, "Points"))),
        h("tbody", {}, RECALLS.map((recall) => {
          const [was, is] = [before?.figures[set]?.[recall], after.figures[set][recall]];
          return h("tr", {}, h("th", { scope: "row" }, recall), before && h("td", {}, share(was)), h("td", {}, share(is)), before && h("td", { class: "figure" }, gain(was, is)));
        }))))));
}

function share(value) {
  if (value === null || value === undefined) return "–";
  return h("div", { class: "share" }, h("span", { class: "figure" }, percent(value)), h("meter", { min: 0, max: 1, value, "aria-hidden": "true" }));
}

function gain(was, is) {
  if (was === undefined || was === null || is === null) return "–";
  const points = 100 * (is - was);
  return h("span", { class: points > 0 ? "good" : points < 0 ? "bad" : "" }, `${points > 0 ? "+" : points < 0 ? "−" : "±"}${Math.abs(points).toFixed(1)}`);
}

function nameGeneration(generation, vocabularies) {
  if (!generation) return "a deleted model version";
  const vocabulary = vocabularies.find((one) => one.vocabulary_id === generation.vocabulary_id);
  const name = vocabulary ? nameVocabulary(vocabulary) : "no vocabulary";
  return generation.pca_from ? `${name}, PCA ${count(generation.dimension)}` : name;
}

const nameVocabulary = (vocabulary) => ({ fitted: "fitted here" })[vocabulary.origin] ?? vocabulary.origin;

function generationsTable(generations, vocabularies) {
  if (!generations.length) return null;
  const states = { active: ["in use", "succeeded"], building: ["being built", "running"], retired: ["replaced", ""], abandoned: ["given up", ""] };
  const chip = ([words, tone]) => h("span", { class: `chip ${tone}` }, words);
  return h("section", { class: "card" }, h("h2", {}, "Model versions"),
    h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Model versions" }, h("table", {},
      h("thead", {}, h("tr", {}, ["State", "Vocabulary", "Dimension", "Photos", "Begun"].map((name) => h("th", { scope: "col", class: { Dimension: "number wide-only", Photos: "number" }[name] ?? "" }, name)))),
      h("tbody", {}, generations.map((one) => h("tr", {},
        h("td", {}, chip(states[one.state] ?? [one.state, ""])),
        h("td", {}, nameGeneration(one, vocabularies)),
        h("td", { class: "number wide-only" }, count(one.dimension)), h("td", { class: "number" }, count(one.photos)), h("td", {}, time(one.created_at))))))));
}

function vocabulariesTable(vocabularies, generations, follow) {
  if (!vocabularies.length) return null;
  const active = generations.find((one) => one.state === "active");
  return h("section", { class: "card" }, h("h2", {}, "Vocabularies"),
    h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Vocabularies" }, h("table", {},
      h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Origin"), h("th", { scope: "col", class: "number wide-only" }, "Clusters"), h("th", { scope: "col", class: "wide-only" }, "Fitted on"), h("th", { scope: "col" }, "Made"), h("th", { scope: "col" }, h("span", { class: "visually-hidden" }, "What can be done")))),
      h("tbody", {}, vocabularies.map((one) => h("tr", {},
        h("td", {}, nameVocabulary(one)), h("td", { class: "number wide-only" }, count(one.clusters)),
        h("td", { class: "wide-only" }, one.provenance.photos ? plural(Number(one.provenance.photos), "photo") : "–"), h("td", {}, time(one.created_at)),
        h("td", { class: "row end" },
          button("Download", () => download(`/vocabularies/${one.vocabulary_id}/file`)),
          active?.vocabulary_id === one.vocabulary_id && !active.pca_from ? h("span", { class: "chip own" }, "in use") : button("Switch to it", async () => follow(await post("/generations", { json: { vocabulary_id: one.vocabulary_id } }), CHANGES.switch)))))))));
}

/** Models that were added to the server; a map switches to one by its extractor. */
function modelsTable(models, map, follow) {
  if (!models.length) return null;
  const change = (extractor) => async () => follow(await post("/generations", { json: { extractor } }), "Switching the extractor");
  return h("section", { class: "card" }, h("h2", {}, "Added models"),
    h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Added models" }, h("table", {},
      h("thead", {}, h("tr", {}, ["Extractor", "Licence", "Maps"].map((name) => h("th", { scope: "col" }, name)), h("th", { scope: "col" }, h("span", { class: "visually-hidden" }, "What can be done")))),
      h("tbody", {}, models.map((one) => h("tr", {},
        h("td", {}, one.extractor), h("td", {}, one.licence), h("td", {}, one.maps.join(", ")),
        h("td", { class: "row end" }, map.extractor === one.extractor ? h("span", { class: "chip own" }, "in use") : button("Switch to it", change(one.extractor)))))))));
}
