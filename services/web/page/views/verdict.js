// The place estimate in words, bars and rings.

import { post } from "../api.js";
import { button, h } from "../dom.js";
import { count, day, degrees, folderOf, metres, percent, plural } from "../format.js";
import { coordinateTools } from "../places.js";
import { poseInWords } from "./pose.js";

const RINGS = [[0.95, "radius_95_m", "ring-95"], [0.68, "radius_68_m", "ring-68"]];

/** The card with the estimate of a similarity search: one sentence and one position, the rest folded. `measurement` is an
 * element with `measurementInWords`, null for an estimate with probabilities; `best` the photo that is shown first. */
export function verdict(found, measurement, best) {
  const { estimate, matches_without_place: without } = found;
  const [kind, title] = judge(estimate);
  const anyFound = found.similar_images.length > 0;
  const bars = estimate.levels.length > 0 && shares(estimate);
  const pose = poseInWords(found.pose);
  const reason = measurement ?? (estimate.reason !== estimate.headline && h("p", { class: "reason" }, estimate.reason));
  return h("div", { class: `verdict ${kind}` },
    h("p", { class: "badge" }, title),
    h("p", { class: "headline" }, estimate.headline),
    kind === "unknown" || !best ? null : looksLike(best),
    kind === "unknown" ? null : whereabouts(pose ? { ...estimate, latitude: null } : estimate),
    pose,
    !bars && reason,
    found.missing.length > 0 && h("p", { class: "hint bad" }, `Degraded: a part of the map could not be searched (${found.missing.join(", ")}).`),
    h("details", {}, h("summary", {}, "Details"),
      bars && reason,
      bars && kind !== "unknown" && [drawBars(bars), ringsInWords(estimate)],
      source(estimate),
      without > 0 && without < found.total_similar && h("p", { class: "soft" }, `${count(without)} of these ${plural(found.total_similar, "photo")} ${without === 1 ? "has" : "have"} neither coordinates nor a label. The estimate is that of the photos that have.`),
      anyFound && found.vocabulary === "foreign" && h("p", { class: "hint" }, "This map uses a vocabulary fitted on photos of other places. ", h("a", { href: "#/model" }, "Fit its own"), " and the right place comes first more often."),
      anyFound && found.vocabulary === "provisional" && h("p", { class: "hint" }, "This map’s vocabulary was fitted on too few photos. ", h("a", { href: "#/model" }, "Fit it again"), " when it has 50 or more."),
      h("dl", { class: "facts" },
        bars && [h("dt", {}, "Not in this map"), h("dd", {}, percent(estimate.not_in_map_probability))],
        h("dt", {}, "Compared"), h("dd", {}, `${count(found.rows_scanned)} rows, ${found.certificate}`),
        h("dt", {}, "Ranked by"), h("dd", {}, "similarity"),
        h("dt", {}, "Took"), h("dd", {}, `${found.processing_time_ms.toFixed(0)} ms`),
        (found.no_pose ?? found.pose?.reason) && [h("dt", {}, "Pose"), h("dd", {}, found.no_pose ?? found.pose.reason, " ", h("a", { href: "#/reconstruction" }, "Reconstruction"))],
        h("dt", {}, "Vocabulary"), h("dd", {}, found.vocabulary))));
}

/** The folder and the day of the most probable photo: where to look for the same trip. */
function looksLike(photo) {
  const folder = folderOf(photo);
  if (!folder && !photo.captured_at) return null;
  return h("p", { class: "looks-like" }, "Looks like ", folder && h("em", {}, folder), folder && photo.captured_at && ", ", photo.captured_at && day(photo.captured_at));
}

/** Draw the circles that contain the true position with 95 % and 68 %; without them, the estimated position. */
export function drawRings(map, estimate) {
  const { levels: [finest], latitude, longitude } = estimate;
  if (judge(estimate)[0] === "unknown") return;
  if (!finest?.radius_m && latitude !== null) map.point(latitude, longitude, { kind: "estimate", radius: 10 });
  for (const [, radius, kind] of RINGS) {
    if (estimate[radius] !== null) map.circle(finest.latitude, finest.longitude, estimate[radius], kind);
  }
}

/** The style and the title of an estimate, or of an entry of the search history. */
export function judge({ in_map: inMap, has_place: hasPlace }) {
  if (inMap) return ["known", "In this map"];
  if (inMap === false) return ["unknown", "Not in this map"];
  return hasPlace ? ["open", "Best guess"] : ["open", "No estimate"];
}

/** Whether it is known how certain the map's answers are; `onchange` is called when that may have changed. */
export function measurementInWords({ measurement, located }, onchange) {
  switch (measurement) {
    case "measured": return ["The certainty of answers is measured."];
    case "running": return ["The certainty of answers is being measured now."];
    case "due": return ["The certainty of answers is not measured yet. That starts by itself once all photos are described."];
    case "not_measured": return ["The certainty of answers is not measured yet. ", button("Measure now", () => post("/evaluations", { json: {} }).then(onchange))];
    default: return [`The certainty of answers is not measured yet: that takes 20 photos with coordinates or a label, and this map has ${count(located)}. `, h("a", { href: "#/add" }, "Add photos")];
  }
}

/** The place that the headline speaks of. */
function whereabouts({ place, latitude, longitude }) {
  return [
    place && h("p", { class: "place" }, place),
    latitude !== null && h("p", { class: place ? "where" : "place where" }, degrees(latitude, longitude)),
    latitude !== null && coordinateTools(latitude, longitude),
  ];
}

/** What the place may be, with shares in whole percent that add up to 100: `{name, share, kind}`. */
function shares({ levels, answer_level: answer }) {
  const [finest] = levels;
  const names = levels.map(({ place, radius_m: radius, whole_map: whole }, index) => {
    if (whole) return index ? "Elsewhere in this map" : "In this map";
    if (place) return index ? `Elsewhere in ${place}` : place;
    return index ? `${metres(levels[index - 1].radius_m)} to ${metres(radius)} away` : `Within ${metres(finest.radius_m)}`;
  });
  const bounds = [...levels.map(({ probability }) => Math.round(100 * probability)), 100];
  return [...names, "Not in this map"].map((name, index) => ({
    name,
    share: bounds[index] - (bounds[index - 1] ?? 0),
    kind: index === levels.length ? "outside" : index <= answer && answer !== null ? "chosen" : null,
  }));
}

const drawBars = (bars) => h("ul", { class: "levels", "aria-label": "Where it may be" }, bars.map(({ name, share, kind }) => h("li", { class: kind },
  h("span", { class: "level" }, name),
  h("span", { class: "figure" }, `${share} %`),
  h("meter", { min: 0, max: 100, value: share, "aria-label": `Probability: ${name}` }))));

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
