// Tracks: a list, and one track on the map with its uncertainty and its frames.

import { ask, currentMap, get } from "../api.js";
import { advancedTabs, button, confirmed, fill, h, noteError, time } from "../dom.js";
import { count, degrees, metres, percent, plural, when } from "../format.js";

const PHOTOS_SHOWN = 1000; // of the map, behind the track
const FRAMES_SHOWN = 500; // in the table
const TONES = { tracking: "own", converging: "foreign", lost: "failed", failed: "failed", pending: "" };

export async function showTracks(view, { signal, id }) {
  if (id) await showTrack(view, id, signal);
  else await showList(view, signal);
}

const chip = (status) => h("span", { class: `chip ${TONES[status] ?? ""}` }, status);
const statusOf = (frame) => frame.state?.status ?? frame.status;
const heads = (...names) => h("thead", {}, h("tr", {}, names.map((name) => h("th", { scope: "col", class: name === "Probability" ? "number" : "" }, name))));
const table = (label, head, rows) => h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": label }, h("table", { class: "stacked" }, head, h("tbody", {}, rows)));

async function showList(view, signal) {
  const { tracks } = await get("/tracks", { query: { limit: 100 }, signal });
  const none = h("section", { class: "card empty" }, h("h2", {}, "No tracks yet"), h("p", {}, "A track follows a camera through the map, frame by frame: ", h("code", {}, `placewise track PHOTOS_OR_VIDEO --map ${currentMap()}`), ", or ", h("code", {}, "POST /tracks"), " of the API."));
  const rows = tracks.map((track) => h("tr", {},
    h("td", {}, h("a", { href: `#/tracks/${track.track_id}` }, time(track.created_at))),
    h("td", {}, plural(track.version, "frame")),
    h("td", {}, track.state ? chip(track.state.status) : "–"),
    h("td", { class: "number" }, percent(track.state?.probability)),
    h("td", { class: "name" }, whereabouts(track.state))));
  fill(view,
    h("header", { class: "head" }, h("h1", {}, "Tracks"), advancedTabs("tracks")),
    tracks.length ? h("section", { class: "card" }, table("Tracks", heads("Begun", "Length", "Status", "Probability", "Last place"), rows)) : none);
}

async function showTrack(view, id, signal) {
  const smoothed = h("input", { type: "checkbox", checked: true });
  const drawn = h("div", { class: "view" });
  const draw = async () => {
    const track = await get(`/tracks/${id}`, { query: { smoothed: smoothed.checked }, signal });
    await drawTrack(drawn, track, draw, signal);
  };
  smoothed.addEventListener("change", () => draw().catch((error) => {
    smoothed.checked = !smoothed.checked;
    noteError(error);
  }));
  const remove = button("Delete…", async () => {
    if (!(await confirmed("Delete this track?", "Its frames and states are deleted. The photos of the map stay.", "Delete"))) return;
    await ask(`/tracks/${id}`, { method: "DELETE" });
    location.hash = "#/tracks";
  }, "danger");
  const choice = h("label", { class: "check" }, smoothed, h("span", {}, "Use later frames, too", h("small", {}, "The place given the whole track, not only the frames before it.")));
  fill(view, h("header", { class: "head" }, h("h1", {}, "Track"), h("div", { class: "row" }, h("a", { class: "button", href: "#/tracks" }, "All tracks"), remove)), choice, drawn);
  await draw().catch(async (error) => {
    if (error.code !== "track_too_long") throw error;
    smoothed.checked = false;
    await draw();
  });
}

async function drawTrack(element, track, again, signal) {
  const { frames } = track;
  const located = frames.filter(({ state }) => state && state.latitude !== null);
  const ground = h("div", { class: "ground browse" });
  const cut = h("p", { class: "soft small" });
  const followed = frames.filter((frame) => statusOf(frame) === "tracking").length;
  const rows = frames.slice(-FRAMES_SHOWN).reverse().map((frame) => h("tr", {},
    h("td", { class: "name" }, frame.filename),
    h("td", {}, h("time", { datetime: frame.captured_at, title: when(frame.captured_at) }, new Date(frame.captured_at).toLocaleTimeString("en-GB"))),
    h("td", {}, chip(statusOf(frame)), frame.error && h("p", { class: "bad small" }, frame.error.detail)),
    h("td", { class: "number" }, percent(frame.state?.probability)),
    h("td", { class: "name" }, whereabouts(frame.state)),
    h("td", {}, frame.state?.image_id ? h("a", { href: `#/photo/${frame.state.image_id}` }, "Nearest photo") : "–")));
  const shown = frames.length > FRAMES_SHOWN ? `; the last ${count(FRAMES_SHOWN)} are listed` : "";
  fill(element,
    h("p", {}, `${plural(frames.length, "frame")}, ${count(followed)} of them tracked${shown}. `, frames.length > 0 && `The first is of ${when(frames[0].captured_at)}.`),
    track.pending > 0 && h("p", { class: "row" }, `${plural(track.pending, "frame")} not described yet.`, button("Refresh", again)),
    located.length > 0 && [ground, cut],
    h("section", { class: "card" }, h("h2", {}, "Frames"), table("Frames", heads("Photo", "Time", "Status", "Probability", "Place", "On the map"), rows)));
  if (located.length) await drawPath(ground, cut, frames, signal);
}

/** The track over the map's photos: a point for each frame; lines and circles of 68 % for those that are not lost: the others' circles would hide the track. */
async function drawPath(ground, cut, frames, signal) {
  const [{ openMap }, { images, next_cursor: more, total_found: total, total_is_exact: exact }] = await Promise.all([
    import("../map.js"),
    get("/search", { query: { role: "database", limit: PHOTOS_SHOWN }, signal }),
  ]);
  fill(cut, more && `Behind the track are ${count(images.length)} of ${exact ? "" : "more than "}${count(total)} photos of the map, the newest.`);
  const map = await openMap(ground, "The track over the photos of the map", { signal });
  for (const photo of images) {
    if (photo.latitude !== null) map.point(photo.latitude, photo.longitude, { kind: "behind", radius: 3 });
  }
  for (const { state } of frames) {
    if (state && state.latitude !== null && state.status !== "lost" && state.radius_68_m !== null) map.circle(state.latitude, state.longitude, state.radius_68_m, "uncertainty");
  }
  map.bounds = []; // the track is shown, not the whole map
  let segment = [];
  for (const frame of [...frames, null]) {
    const state = frame?.state;
    const known = state && state.latitude !== null;
    if (known && state.status !== "lost") {
      segment.push([state.latitude, state.longitude]);
    } else if (frame === null || frame.state) {
      if (segment.length > 1) map.line(segment, "path");
      segment = [];
    }
  }
  for (const { state, captured_at: time, filename } of frames) {
    if (!state || state.latitude === null) continue;
    const words = `${filename}, ${new Date(time).toLocaleTimeString("en-GB")}: ${state.status}, ${percent(state.probability)}`;
    map.point(state.latitude, state.longitude, { kind: state.status, radius: 5, text: words });
  }
  map.fit();
}

function whereabouts(state) {
  if (!state) return "–";
  if (state.latitude === null) return state.place ?? "–";
  const radius = state.radius_68_m === null ? "" : ` ± ${metres(state.radius_68_m)}`;
  return `${state.place ? `${state.place} · ` : ""}${degrees(state.latitude, state.longitude)}${radius}`;
}
