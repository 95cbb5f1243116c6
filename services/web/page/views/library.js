// The card of the photo library that the map follows: counts, last run, errors.

import { get, post } from "../api.js";
import { button, fill, h, time } from "../dom.js";
import { count, plural } from "../format.js";
import { stateInWords } from "../jobs.js";

/** Draw the card; empty and hidden where the map follows no library. */
export async function drawLibrary(card, signal) {
  const { jobs: [job] } = await get("/jobs", { query: { kind: "sync_library", limit: 1 }, signal });
  card.hidden = !job;
  if (!job) return;
  const { result, error } = job;
  const hours = result?.every_hours ?? null;
  const again = () => post("/library-syncs", { json: { every_hours: hours } }).then(() => drawLibrary(card, signal));
  fill(card,
    h("h2", {}, "Photo library ", h("span", { class: `chip ${job.state}` }, stateInWords(job))),
    error && h("p", { class: "bad" }, error.detail),
    result && h("dl", { class: "facts" },
      h("dt", {}, "With coordinates"), h("dd", {}, count(result.with_coordinates)),
      h("dt", {}, "Without"), h("dd", {}, `${count(result.without_coordinates)}, of which ${count(result.located)} can be located`),
      h("dt", {}, "In the last run"), h("dd", {}, `${count(result.indexed)} indexed, ${count(result.changed)} changed, ${count(result.removed)} removed`)),
    result?.failed.length > 0 && h("details", {}, h("summary", {}, `${plural(result.failed.length, "photo")} failed`), h("ul", {}, result.failed.map(({ path, reason }) => h("li", {}, `${path}: ${reason}`)))),
    h("p", { class: "soft small" }, "Last run: ", job.finished_at ? time(job.finished_at) : "now", hours ? `; every ${plural(hours, "hour")}` : "; no schedule", ". Nothing is written into the library: ", h("code", {}, "placewise immich --write"), " does. The calls are those of the description of Immich 3.2.2; it was never run against a real Immich."),
    job.finished_at && h("p", { class: "row" }, button("Update now", again)));
}
