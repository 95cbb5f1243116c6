// The reconstruction of the map's photos: making it, its components, photos left out, and other coordinates that it proposes.

import { ask, currentMap, download, get, post } from "../api.js";
import { advancedTabs, button, confirmed, fill, h, note, time } from "../dom.js";
import { count, degrees, metres, nameOf, percent, plural } from "../format.js";
import { followJob, hasEnded } from "../jobs.js";
import { acceptedList, proposalBoard, proposalCard } from "../proposals.js";

const WORK = "Reconstructing the photos";

export async function showReconstruction(view, { signal }) {
  const [made, { jobs: [newest] }] = await Promise.all([
    get("/reconstructions", { signal }).catch((error) => {
      if (error.code !== "no_reconstruction") throw error;
      return null;
    }),
    get("/jobs", { query: { kind: "reconstruct", limit: 1 }, signal }),
  ]);
  // Old jobs are deleted; the reconstruction stays.
  const response = made && await ask(`/jobs/${made.job_id}`, { signal, also: [404] });
  const result = response?.ok ? (await response.json()).result : null;
  const again = () => showReconstruction(view, { signal });
  const work = h("div", { class: "work" });
  const follow = (job, words) => followJob(work, job, words, again, signal);
  const start = async (fromScratch) => {
    try {
      follow(await post("/reconstructions", { json: { from_scratch: fromScratch } }), WORK);
    } catch (error) {
      if (error.code !== "no_local_features") throw error;
      await addLocalFeatures(follow);
    }
  };
  const startAnew = async () => {
    if (await confirmed("Reconstruct all photos again?", "Queries use the present reconstruction until the new one is complete.", "Reconstruct", { kind: "primary" })) await start(true);
  };
  const hasFailed = newest?.state === "failed" && newest.job_id !== made?.job_id;
  const proposals = h("div", { class: "view" });
  fill(view,
    h("header", { class: "head" }, h("h1", {}, "Reconstruction"), advancedTabs("reconstruction")),
    h("section", { class: "card standing" },
      made ? summary(made, result) : h("div", {}, h("h2", {}, "Not reconstructed"), h("p", {}, "The map has no reconstruction, or none of the local features that its photos have now.")),
      h("div", { class: "standing-words" },
        h("p", {}, made ? "Photos that were added since are registered into it when you reconstruct again." : "With a reconstruction of its photos, the map says where a camera stood and where it looked, and finds photos with wrong coordinates."),
        h("div", { class: "row" },
          button(made ? "Reconstruct again" : "Reconstruct the photos", () => start(false), "primary"),
          made && button("From scratch…", startAnew),
          made && button("Download as COLMAP models", () => download(`/reconstructions/${made.reconstruction_id}/colmap`), "link"))),
      hasFailed && h("p", { class: "bad work" }, `The last run failed: ${newest.error.detail}`),
      work),
    made && componentsTable(made.components),
    result && leftOut(result),
    proposals);
  if (newest && !hasEnded(newest)) follow(newest, WORK);
  if (made) await showProposals(proposals, made, signal);
}

/** Ask, and compute what a reconstruction is made of, as a model change. */
async function addLocalFeatures(follow) {
  if (!(await confirmed("Compute local features first?", "A reconstruction is made of them, and these photos have none. Searches go on meanwhile. Reconstruct the photos when they are computed.", "Compute them", { kind: "primary", otherwise: "Not now" }))) return;
  const changed = await get(`/maps/${encodeURIComponent(currentMap())}`, { method: "PATCH", json: { matching: "on" } });
  follow({ job_id: changed.model_change_id }, "Computing local features");
}

function summary(made, result) {
  const photos = made.components.reduce((sum, component) => sum + component.photos, 0);
  return h("div", {}, h("h2", {}, "Reconstruction in use"),
    h("dl", { class: "facts" },
      h("dt", {}, "Photos"), h("dd", {}, result ? `${count(photos)} of ${count(result.photos)}` : count(photos)),
      h("dt", {}, "Components"), h("dd", {}, count(made.components.length)),
      h("dt", {}, "Made"), h("dd", {}, time(made.finished_at), made.imported && " of an imported model"),
      h("dt", {}, "Local features"), h("dd", {}, made.features_model)));
}

function componentsTable(components) {
  const numbers = ["Photos", "Points", "Error", "Poses found"];
  return h("section", { class: "card" }, h("h2", {}, "Components"),
    h("p", { class: "soft" }, "Photos that no points connect become components of their own. Poses found: the share of the photos that are localised as if they were not in it."),
    h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Components" }, h("table", {},
      h("thead", {}, h("tr", {}, ["Number", ...numbers, "Alignment"].map((name) => h("th", { scope: "col", class: numbers.includes(name) ? `number ${["Points", "Error"].includes(name) ? "wide-only" : ""}` : "" }, name)))),
      h("tbody", {}, components.map((one) => h("tr", {},
        h("td", {}, String(one.number)), h("td", { class: "number" }, count(one.photos)), h("td", { class: "number wide-only" }, count(one.points)),
        h("td", { class: "number wide-only" }, `${one.mean_reprojection_error_pixels.toFixed(2)} px`), h("td", { class: "number" }, percent(one.calibration?.share_found)),
        h("td", {}, h("p", {}, alignmentInWords(one)))))))));
}

/** How well the photos agree with their coordinates, or why a component has no place on the map. */
function alignmentInWords({ not_aligned: reason, located, agreeing, alignment_rms_m: rms, is_on_line: onLine }) {
  if (reason) return reason;
  if (!located) return "At the given origin.";
  return `${rms.toFixed(2)} m from the coordinates of ${agreeing} of ${plural(located, "photo")}${onLine ? "; on a line, turned as upright cameras are" : ""}.`;
}

/** The photos in no component, by the reason. */
function leftOut({ left_out: total, left_out_photos: photos = [] }) {
  if (!photos.length) return null;
  const reasons = [...new Set(photos.map(({ reason }) => reason))];
  return h("details", { class: "card", open: true }, h("summary", {}, `${plural(total, "photo")} left out`),
    reasons.map((reason) => h("div", {}, h("p", {}, `${reason}:`),
      h("ul", { class: "unlocated" }, photos.filter((photo) => photo.reason === reason).map(({ image_id: id, name }) => h("li", {}, h("a", { href: `#/photo/${id}` }, name)))))),
    total > photos.length && h("p", { class: "soft" }, `The first ${count(photos.length)} are listed.`));
}

/** A proposal's photo as the others of the page are. */
const photoOf = (proposal) => ({ ...proposal, image_url: `/uploads/${proposal.image_id}/image`, thumbnail_url: `/uploads/${proposal.image_id}/thumbnail` });

async function showProposals(element, made, signal) {
  const board = proposalBoard("Photos with other coordinates than the reconstruction: before and after, by their numbers", signal);
  const tools = h("div", { class: "row" });
  const words = h("p", { class: "lead", role: "status" });
  const accepted = h("section", { class: "card", hidden: true });
  const dismissed = new Set();
  let open = [];
  fill(element, h("h2", {}, "Coordinates that disagree"), words, board.elements, tools, board.grid, accepted);

  async function load() {
    const { proposals } = await get(`/reconstructions/${made.reconstruction_id}/proposals`, { signal });
    const all = proposals.map(photoOf);
    open = all.filter((proposal) => !proposal.accepted);
    const taken = all.filter((proposal) => proposal.accepted);
    draw();
    accepted.hidden = !taken.length;
    fill(accepted,
      h("header", { class: "head" }, h("h2", {}, `${plural(taken.length, "proposal")} accepted`), button("Undo all", () => undo(taken))),
      acceptedList(taken.map((proposal) => [proposal, `Moved by ${metres(proposal.distance_m)}.`]), undo));
    await board.openMap();
  }

  function draw() {
    const shown = open.filter(({ image_id: id }) => !dismissed.has(id));
    fill(words, shown.length
      ? `The reconstruction has ${plural(shown.length, "photo")} at another place than ${shown.length === 1 ? "its" : "their"} coordinates. Nothing is changed until you accept it.`
      : "No photo’s coordinates disagree with the reconstruction.");
    fill(tools, shown.length > 1 && button(`Accept ${plural(shown.length, "proposal")}`, () => accept(shown), "primary"));
    board.draw(shown.map((proposal) => ({ photo: proposal, from: before(proposal), to: after(proposal), card: (number) => card(proposal, number) })));
  }

  const card = (proposal, number) => proposalCard(number, {
    photo: proposal, before: degrees(...before(proposal)), after: degrees(...after(proposal)),
    certainty: [`${metres(proposal.distance_m)} away`, `within ${metres(proposal.radius_95_m)} (95 %)`],
    actions: [
      button("Accept", () => accept([proposal])),
      button("Not this", () => {
        dismissed.add(proposal.image_id);
        draw();
        note(`${nameOf(proposal)} keeps its coordinates.`);
      }, "link"),
    ],
  });

  /** Give each its coordinates, one after the other; what is done when one fails stays done. */
  async function change(some, place) {
    try {
      for (const proposal of some) {
        const [latitude, longitude] = place(proposal);
        await ask(`/uploads/${proposal.image_id}`, { method: "PATCH", json: { latitude, longitude } });
      }
    } finally {
      await load();
    }
  }

  async function accept(some) {
    await change(some, after);
    note(`${plural(some.length, "photo")} moved.`, "", () => undo(some));
  }

  async function undo(some) {
    await change(some, before);
    note(`${plural(some.length, "photo")} moved back.`);
  }

  await load();
}

const before = ({ latitude, longitude }) => [latitude, longitude];
const after = ({ proposed_latitude: latitude, proposed_longitude: longitude }) => [latitude, longitude];
