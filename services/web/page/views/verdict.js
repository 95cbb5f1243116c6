// The place estimate in words, bars and rings.

import { h } from "../dom.js";
import { count, degrees, metres, percent } from "../format.js";
import { coordinateTools } from "../places.js";

const RINGS = [[0.95, "radius_95_m", "ring-95"], [0.68, "radius_68_m", "ring-68"]];

/** A share without the zero of a whole percentage. */
const short = (share) => `${Number((100 * share).toFixed(1))} %`;

/** The card with the estimate of a similarity search. */
export function verdict(found) {
  const { estimate } = found;
  const { levels } = estimate;
  const [kind, title] = judge(estimate);
  const anyFound = found.similar_images.length > 0;
  return h("div", { class: `verdict ${kind}` },
    h("p", { class: "badge" }, title),
    kind === "unknown" ? null : whereabouts(estimate),
    h("p", { class: "reason" }, reason(estimate)),
    levels.length > 0 && levelBars(estimate),
    ringsInWords(estimate),
    source(estimate),
    h("details", {}, h("summary", {}, "Details"),
      h("dl", { class: "facts" },
        estimate.confidence !== null && [h("dt", {}, "Confidence"), h("dd", {}, percent(estimate.confidence))],
        h("dt", {}, "Compared"), h("dd", {}, `${count(found.rows_scanned)} rows, ${found.certificate}`),
        h("dt", {}, "Ranked by"), h("dd", {}, found.word_weights === "applied" ? "similarity, with word weights" : "similarity"),
        h("dt", {}, "Took"), h("dd", {}, `${found.processing_time_ms.toFixed(0)} ms`),
        h("dt", {}, "Vocabulary"), h("dd", {}, found.vocabulary))),
    anyFound && found.vocabulary === "foreign" && h("p", { class: "hint" }, "This map uses a vocabulary fitted on photos of other places. ", h("a", { href: "#/model" }, "Fit its own"), " and the right place comes first more often."),
    anyFound && found.vocabulary === "provisional" && h("p", { class: "hint" }, "This map’s vocabulary was fitted on too few photos. ", h("a", { href: "#/model" }, "Fit it again"), " when it has 50 or more."),
    found.missing.length > 0 && h("p", { class: "hint bad" }, `Degraded: a part of the map could not be searched (${found.missing.join(", ")}).`));
}

/** Draw the circles that contain the true position with 95 % and 68 %; where the levels are labels, the estimated position. */
export function drawRings(map, estimate) {
  const { levels: [finest], latitude, longitude, radius_m: radiusM } = estimate;
  if (!finest?.radius_m && latitude !== null) map.circle(latitude, longitude, radiusM, "estimate");
  for (const [, radius, kind] of RINGS) {
    if (estimate[radius] !== null) map.circle(finest.latitude, finest.longitude, estimate[radius], kind);
  }
}

/** The style and the title of an estimate, or of an entry of the search history. Without levels there is no probability of “not in this map”. */
export function judge({ answer_level: answer, not_in_map_probability: outside, in_map: accepted, latitude = null, place = null }) {
  const hasLevels = outside !== null;
  if (hasLevels ? answer !== null : accepted) return ["known", "In this map"];
  return (hasLevels ? outside > 0.5 : accepted === false) ? ["unknown", "Not in this map"] : ["open", hasLevels || latitude !== null || place ? "Best guess" : "No estimate"];
}

/** The estimated place. Its error is the widest ring of the map that is known, so that both agree. */
function whereabouts(estimate) {
  const [share, ring] = RINGS.find(([, radius]) => estimate[radius] !== null) ?? [];
  const level = estimate.levels[ring ? 0 : estimate.answer_level ?? 0] ?? estimate;
  const { place, latitude, longitude } = level;
  const [radius, probability] = ring ? [estimate[ring], share] : [level.radius_m, level.probability];
  return [
    place && h("p", { class: "place" }, place),
    latitude !== null && h("p", { class: place ? "where" : "place where" }, degrees(latitude, longitude), h("span", { class: "radius" }, ` ± ${metres(radius)}`, probability !== undefined && ` (${short(probability)})`)),
    latitude !== null && coordinateTools(latitude, longitude),
  ];
}

/** Why the estimate answers at its level, or does not answer: one sentence. */
function reason({ levels, answer_level: answer, certainty, not_in_map_probability: outside, reason: withoutLevels }) {
  if (!levels.length) return withoutLevels;
  const required = short(certainty);
  // An answer that is finer than the coarsest level also requires odds against “not in this map”.
  const unsure = levels.slice(0, answer ?? levels.length).some(({ probability }) => probability >= certainty);
  if (answer !== null) return `At a certainty of ${required}, the finest answer is ${quoted(levels[answer])}, with a probability of ${percent(levels[answer].probability)}.${unsure ? " Finer levels require stronger evidence that the place is in the map." : ""}`;
  if (outside > 0.5) return `The map probably has no photo of this place (${percent(outside)}).`;
  const coarsest = levels.at(-1);
  return `No level is certain enough at a certainty of ${required}; the most probable is ${quoted(coarsest)}, with ${percent(coarsest.probability)}${unsure ? ", but it requires stronger evidence that the place is in the map" : ""}.`;
}

const named = (level) => level.place ?? `Within ${metres(level.radius_m)}`;
const quoted = (level) => (level.place ? `“${level.place}”` : `a radius of ${metres(level.radius_m)}`);

/** A bar for each level, and one for "not in this map". */
function levelBars({ levels, answer_level: answer, not_in_map_probability: outside }) {
  const row = (name, probability, kind) => h("li", { class: kind },
    h("span", { class: "level" }, name),
    h("span", { class: "figure" }, percent(probability)),
    h("meter", { min: 0, max: 1, value: probability, "aria-label": `Probability: ${name}` }));
  return h("ul", { class: "levels", "aria-label": "Levels, finest first" },
    levels.map((level, index) => row(named(level), level.probability, index === answer ? "chosen" : null)),
    row("Not in this map", outside, "outside"));
}

function ringsInWords(estimate) {
  const rings = RINGS.filter(([, radius]) => estimate[radius] !== null)
    .map(([share, radius, kind]) => h("li", {}, h("span", { class: `swatch ${kind}` }), `${100 * share} %: within ${metres(estimate[radius])}`));
  return rings.length > 0 && h("ul", { class: "rings", "aria-label": "Rings on the map" }, rings.reverse());
}

/** What the probabilities were fitted on, and how they become better. */
function source({ calibration_source: fitted }) {
  const words = {
    prior: ["This map has few photos: these probabilities are mostly those of other maps. ", h("a", { href: "#/add" }, "Add more photos"), " or test photos."],
    own_photos: ["These probabilities were fitted on the map’s own photos. ", h("a", { href: "#/add" }, "Add test photos"), " of another day to correct them."],
    labelled_queries: ["These probabilities were fitted on test photos."],
  }[fitted];
  return words && h("p", { class: "soft" }, words);
}
