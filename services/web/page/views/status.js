// The health and the figures of the server, its jobs, the newest searches, and the way in for a phone.

import { currentMap, forgetKey, get, hasKey, maySucceed, post } from "../api.js";
import { button, fill, h, time } from "../dom.js";
import { bytes, count, duration, score } from "../format.js";
import { stateInWords } from "../jobs.js";
import { serverSettings } from "../settings.js";
import { drawLibrary } from "./library.js";
import { judge, measurementInWords } from "./verdict.js";

const LOOK_SECONDS = 5;

export async function showStatus(view, { signal }) {
  const drawn = { health: h("section", { class: "card" }), figures: h("section", { class: "card" }), library: h("section", { class: "card", hidden: true }), jobs: h("section", { class: "card" }), searches: h("section", { class: "card" }) };
  const settings = await serverSettings();
  const look = async () => {
    const [health, stats, map, { jobs }, { searches }] = await Promise.all([
      // 503 with the same answer, where a part does not respond.
      get("/health", { signal, also: [503] }), get("/database/stats", { signal }), get(`/maps/${encodeURIComponent(currentMap())}`, { signal }),
      get("/jobs", { query: { limit: 12, kind: settings.job_kinds }, signal }), get("/searches", { query: { limit: 12 }, signal }),
    ]);
    drawHealth(drawn.health, health);
    const failed = stats.failed_images ? (await get("/search", { query: { failed: true, limit: 12 }, signal })).images : [];
    drawFigures(drawn.figures, stats, map, failed, look);
    drawJobs(drawn.jobs, jobs, look);
    await drawLibrary(drawn.library, signal);
    drawSearches(drawn.searches, searches);
  };
  await look();
  fill(view, h("header", { class: "head" }, h("h1", {}, "Status"), h("p", { class: "row" }, h("a", { class: "button", href: "/docs" }, "The API"))), h("div", { class: "status-grid" }, drawn.figures, drawn.health), drawn.library, drawn.jobs, drawn.searches, phoneCard(settings));
  const timer = setInterval(() => {
    // Not while someone is at a button of what would be drawn anew.
    if (!document.hidden && ![drawn.jobs, drawn.figures, drawn.library].some((card) => card.contains(document.activeElement))) look().catch((error) => !signal.aborted && drawUnreachable(drawn.health, error));
  }, LOOK_SECONDS * 1000);
  signal.addEventListener("abort", () => clearInterval(timer));
}

/** Health that can't be read; the other cards stay as they were. */
function drawUnreachable(card, error) {
  fill(card,
    h("h2", {}, "Health ", h("span", { class: "chip unhealthy" }, "unknown")),
    h("p", {}, error.message),
    h("p", { class: "soft" }, "What you see here is of the last answer. The page keeps trying."));
}

const PARTS = { catalog: "Catalog", object_store: "Object store", search: "Search", queue: "Queue", extractors: "Extractors", uploads: "Uploads", stewards: "Stewards" };

function drawHealth(card, health) {
  const { load } = health;
  fill(card,
    h("h2", {}, "Health ", h("span", { class: `chip ${health.status}` }, health.status)),
    h("ul", { class: "parts" }, Object.entries(health.parts).map(([name, part]) => h("li", {}, h("span", { class: `light ${part.status}`, "aria-hidden": "true" }), h("strong", {}, PARTS[name] ?? name), h("span", { class: "soft" }, part.detail ?? part.status)))),
    load && h("dl", { class: "facts" },
      h("dt", {}, "Jobs that wait"), h("dd", {}, `${count(load.waiting_jobs)} of at most ${count(load.max_queued_jobs)}`),
      h("dt", {}, "Photos described"), h("dd", {}, `${load.finished_per_second.toFixed(1)} a second`),
      h("dt", {}, "Uploads now"), h("dd", {}, `${count(load.receiving_uploads)} of at most ${count(load.max_concurrent_uploads)}`),
      load.free_bytes !== null && [h("dt", {}, "Disk free"), h("dd", {}, bytes(load.free_bytes))]),
    h("p", { class: "soft small" }, `Placewise ${health.version}, up for ${duration(health.uptime_seconds)}`));
}

function drawFigures(card, stats, map, failed, look) {
  const tile = (figure, name) => h("div", { class: "tile" }, h("span", { class: "figure" }, figure), h("span", { class: "soft" }, name));
  fill(card, h("h2", {}, `The map “${stats.map}”`),
    h("div", { class: "tiles" },
      tile(count(stats.total_images), "photos"), tile(count(stats.searchable_images), "searchable"),
      tile(count(map.located), "with coordinates or a label"),
      stats.failed_images > 0 && tile(count(stats.failed_images), "could not be described")),
    h("p", {}, measurementInWords(map, look)),
    h("dl", { class: "facts" },
      h("dt", {}, "Test photos"), h("dd", {}, count(stats.labelled_queries)),
      h("dt", {}, "Stored"), h("dd", {}, bytes(stats.total_storage_bytes)),
      h("dt", {}, "Searches"), h("dd", {}, `${count(stats.total_searches)}${stats.avg_processing_time_ms === null ? "" : `, ${stats.avg_processing_time_ms.toFixed(0)} ms on average`}`)),
    failed.length > 0 && h("p", {}, "Photos that could not be described, and are not found: ", failed.flatMap((photo, index) => [index > 0 && ", ", h("a", { href: `#/photo/${photo.image_id}` }, photo.original_filename)]), stats.failed_images > failed.length && ` and ${count(stats.failed_images - failed.length)} more`, "."));
}

function drawJobs(card, jobs, look) {
  if (!jobs.length) {
    fill(card, h("h2", {}, "Jobs"), h("p", { class: "soft" }, "None yet: each photo that you add makes one."));
    return;
  }
  fill(card, h("h2", {}, "Newest jobs"), h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Newest jobs" }, h("table", {},
    h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Job"), h("th", { scope: "col" }, "State"), h("th", { scope: "col", class: "number wide-only" }, "Done"), h("th", { scope: "col" }, "Begun"), h("th", { scope: "col" }, h("span", { class: "visually-hidden" }, "What can be done")))),
    h("tbody", {}, jobs.map((job) => h("tr", {},
      h("td", { class: "name" }, job.file_id ? h("a", { href: `#/photo/${job.file_id}` }, job.filename ?? job.label) : job.filename ?? job.label, job.filename && h("p", { class: "soft small" }, job.label)),
      h("td", {}, h("span", { class: `chip ${job.state}` }, stateInWords(job)), job.error && h("p", { class: "bad small" }, job.error.detail)),
      h("td", { class: "number wide-only" }, job.progress.total ? `${count(job.progress.done)} / ${count(job.progress.total)}` : "–"),
      h("td", {}, time(job.created_at)),
      h("td", { class: "row end" },
        job.state === "failed" && (!job.error || maySucceed(job.error)) && button("Try again", () => post(`/jobs/${job.job_id}/retry`).then(look)),
        ["queued", "running"].includes(job.state) && button("Cancel", () => post(`/jobs/${job.job_id}/cancel`).then(look)))))))));
}

const TONES = { known: "own", unknown: "foreign", open: "" };

function drawSearches(card, searches) {
  if (!searches.length) {
    fill(card, h("h2", {}, "Questions"), h("p", { class: "soft" }, "None yet. ", h("a", { href: "#/ask" }, "Ask with a photo"), "."));
    return;
  }
  fill(card, h("h2", {}, "Newest questions"), h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Newest questions" }, h("table", {},
    h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Photo"), h("th", { scope: "col" }, "Answer"), h("th", { scope: "col", class: "number wide-only" }, "Similarity"), h("th", { scope: "col", class: "number wide-only" }, "Took"), h("th", { scope: "col" }, "When"))),
    h("tbody", {}, searches.map((one) => {
      const [kind, title] = judge(one);
      return h("tr", {},
        h("td", { class: "name" }, one.query_file_id ? h("a", { href: `#/ask/${one.query_file_id}` }, one.query_filename) : one.query_filename),
        h("td", {}, h("span", { class: `chip ${TONES[kind]}` }, title)),
        h("td", { class: "number wide-only" }, one.best_score === null ? "–" : score(one.best_score)),
        h("td", { class: "number wide-only" }, `${one.processing_time_ms.toFixed(0)} ms`), h("td", {}, time(one.searched_at)));
    })))));
}

const LOOPBACK = /^(localhost|127\.\d+\.\d+\.\d+|\[::1\])$/;

/** The address of this server for a phone in the same network, and the key of this device. */
function phoneCard({ lan_url: lanUrl }) {
  const url = LOOPBACK.test(location.hostname) ? lanUrl : location.origin;
  return h("section", { class: "card" },
    h("h2", {}, "On a phone"),
    url
      ? h("div", { class: "phone-address" },
        h("img", { src: `/console/qr.svg?url=${encodeURIComponent(url)}`, alt: `QR code of ${url}`, width: "180", height: "180" }),
        h("div", {}, h("p", {}, "Scan this code with the camera of a phone in the same network, or open ", h("a", { href: url }, url), " there."), h("p", { class: "soft" }, "The phone asks for the key once, and can remember it.")))
      : h("p", {}, "Only this machine can reach this server. To use it from a phone, start it for the network: ", h("code", {}, "make run HOST=0.0.0.0"), ", or with Docker Compose ", h("code", {}, "BIND=0.0.0.0"), ". Every call then needs a key."),
    hasKey() && h("p", { class: "row" }, "This browser has a key. ", button("Forget the key", () => {
      forgetKey();
      location.reload();
    })));
}
