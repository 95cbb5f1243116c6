// Places to give: proposals for the photos of the map that have none, beside what they rest on.

import { get, post } from "../api.js";
import { announce, bar, button, field, fill, h, note, noteError } from "../dom.js";
import { fileChooser } from "../drop.js";
import { count, metres, nameOf, percent, plural, whereabouts } from "../format.js";
import { acceptedList, proposalBoard, proposalCard } from "../proposals.js";
import { readTrack } from "./locate.js";

const PAGE = 10; // photos of one call: each is searched with
const PER_CALL = 1000; // given at once, as the server allows
const GIVEN_SHOWN = 48;

/** A line with the number of photos without a place and the way to their proposals; nothing where all have one. */
export async function unplacedCard(signal) {
  const { total_found: total } = await get("/search", { query: { without_place: true, role: "database", limit: 1 }, signal });
  return total > 0 && h("section", { class: "card unplaced" },
    h("p", {}, h("strong", {}, `${plural(total, "photo")} ${total === 1 ? "has" : "have"} no place.`), " Placewise can propose where they were taken; nothing is changed until you accept it."),
    h("a", { class: "button", href: "#/places" }, "See proposals"));
}

/** Take back the places of these photos, or of all; says what was left as it is. */
export async function undoPlaces(photos = null) {
  const undone = await post("/places/undo", { json: photos && { file_ids: photos } || {} });
  const left = undone.changed_since.length;
  note(`${plural(undone.restored.length, "place")} taken back.${left ? ` ${plural(left, "photo")} got another place since, and ${left === 1 ? "keeps" : "keep"} it.` : ""}`);
}

/** Give a place to one photo of the map, with the way back. */
export async function givePlace(place, ondone = async () => {}) {
  const { skipped } = await post("/places", { json: { photos: [place] } });
  const [reason] = Object.values(skipped);
  if (reason) throw new Error(`Not changed: the photo ${reason}.`);
  note(place.denied ? "Kept: the photo was not taken there." : "The photo has this place now.", "", async () => {
    await undoPlaces([place.file_id]);
    await ondone();
  });
  await ondone();
}

/** A proposal as POST /places takes it; null if it has no place. */
function placeOf({ photo, latitude, longitude, heading, place, place_probability: labelled, probability, reason }) {
  if (latitude !== null) return { file_id: photo.image_id, latitude, longitude, heading, probability, reason };
  return place && { file_id: photo.image_id, place, probability: labelled, reason };
}

const surety = ({ latitude, probability, place_probability: labelled }) => (latitude === null ? labelled ?? 0 : probability);

export async function showPlaces(view, { signal }) {
  const least = h("input", { type: "number", min: 0, max: 100, step: 1, value: 95, required: true });
  const motion = h("select", {}, ["walk", "bicycle", "car", "train"].map((kind) => h("option", { value: kind }, kind)));
  const together = h("input", { type: "checkbox" });
  const words = h("p", { class: "lead", role: "status" });
  const progress = h("div", {});
  const board = proposalBoard("Before: the photos with a place. After: the proposals, by their numbers", signal);
  const tools = h("div", { class: "row" });
  const rest = h("details", { class: "card", hidden: true });
  const given = h("section", { class: "card", hidden: true });
  let track = [];
  let proposals = [];
  let total = 0;
  let looking = null;

  const gpx = fileChooser({ accept: ".gpx", "data-use": "track" }, (files) => readTracks(files).catch(noteError));
  const options = h("details", { class: "card" }, h("summary", {}, "What else is known"), h("div", { class: "filters-more" },
    field("The photographer moved by", motion),
    h("div", { class: "field" }, h("span", {}, "GPX track"), button("Choose a GPX file", () => gpx.click()), gpx),
    h("label", { class: "check" }, together, h("span", {}, "The cameras travelled together"))));
  const leastField = field("Accept from (%)", least);
  fill(view,
    h("header", { class: "head" }, h("h1", {}, "Places to give"), h("a", { class: "button", href: "#/photos" }, "All photos")),
    words, progress, options, board.elements, h("div", { class: "proposal-tools", hidden: true }, leastField, tools), board.grid, rest, given);
  least.addEventListener("input", draw);
  for (const input of [motion, together]) input.addEventListener("change", () => start());

  async function readTracks(files) {
    track = [];
    for (const { file } of files) track.push(...readTrack(await file.text(), file.name));
    note(`${plural(track.length, "point")} of a track are used.`);
    start();
  }

  /** Look again from the beginning; what an earlier look still finds is left out. */
  function start() {
    looking?.abort();
    looking = new AbortController();
    look(AbortSignal.any([signal, looking.signal])).catch((error) => {
      if (error.name !== "AbortError") fill(progress, h("p", { class: "bad" }, error.message), button("Try again", start));
    });
  }

  async function look(turn) {
    proposals = [];
    let cursor = null;
    const json = { track, motion: motion.value, together: together.checked };
    draw();
    do {
      const page = await get("/places/proposals", { method: "POST", query: { limit: PAGE, cursor }, json, signal: turn });
      turn.throwIfAborted();
      total = page.total;
      cursor = page.next_cursor;
      proposals.push(...page.proposals);
      fill(progress, cursor && [h("p", { class: "soft" }, `Looking at ${count(proposals.length)} of ${plural(total, "photo")}`), bar("Looking for places", proposals.length, total)]);
      draw();
      await board.openMap();
    } while (cursor);
    announce(words.textContent);
    board.fit();
  }

  const isSure = (proposal) => placeOf(proposal) && surety(proposal) >= Number(least.value) / 100;

  function draw() {
    const located = proposals.filter(placeOf).sort((one, other) => surety(other) - surety(one));
    const sure = located.filter(isSure);
    const unknown = proposals.filter((proposal) => !placeOf(proposal));
    fill(words, total ? `${plural(total, "photo")} ${total === 1 ? "has" : "have"} no place: ${count(sure.length)} can be located with at least ${least.value} %.` : proposals.length || progress.children.length ? "" : "All photos have a place.");
    tools.parentElement.hidden = !located.length;
    fill(tools,
      sure.length > 0 && button(`Give ${plural(sure.length, "place")}`, () => give(sure), "primary"),
      button("None of them", () => forget(located)));
    board.draw(located.map((proposal) => ({
      photo: proposal.photo, from: null, to: proposal.latitude === null ? null : [proposal.latitude, proposal.longitude], card: (number) => card(proposal, number),
    })));
    rest.hidden = !unknown.length;
    fill(rest, h("summary", {}, `${plural(unknown.length, "photo")} without a proposal`),
      h("ul", { class: "unlocated" }, unknown.map(({ photo, reason, error }) => h("li", {}, h("a", { href: `#/photo/${photo.image_id}` }, nameOf(photo)), h("span", { class: "soft" }, ` ${error ?? reason}`)))));
  }

  function card(proposal, number) {
    const { photo, looks_like: like, latitude, radius_m: radius, reason, place } = proposal;
    return proposalCard(number, {
      photo, like, reason, sure: isSure(proposal), before: "no place", after: latitude === null ? place : whereabouts({ ...proposal, place: null }),
      certainty: [percent(surety(proposal)), latitude === null ? place : `within ${metres(radius)}`],
      actions: [button("Give this place", () => give([proposal])), button("Not this", () => forget([proposal]), "link")],
    });
  }

  /** Leave these photos as they are, until the next look. */
  function forget(some) {
    proposals = proposals.filter((proposal) => !some.includes(proposal));
    draw();
    note(`Nothing was changed: ${plural(some.length, "proposal")} left out.`);
  }

  async function give(some) {
    const places = some.map(placeOf);
    const done = [];
    const skipped = [];
    for (let begin = 0; begin < places.length; begin += PER_CALL) {
      const answer = await post("/places", { json: { photos: places.slice(begin, begin + PER_CALL) } });
      done.push(...answer.given);
      skipped.push(...Object.keys(answer.skipped));
    }
    const ids = new Set([...done, ...skipped]);
    proposals = proposals.filter(({ photo }) => !ids.has(photo.image_id));
    total -= ids.size;
    draw();
    await drawGiven();
    note(`${plural(done.length, "place")} given.${skipped.length ? ` ${plural(skipped.length, "photo")} had one meanwhile.` : ""}`, "", () => takeBack(done));
  }

  async function takeBack(photos) {
    await undoPlaces(photos);
    await drawGiven();
    start();
  }

  async function drawGiven() {
    const { images, total_found: found } = await get("/search", { query: { place_given: true, limit: GIVEN_SHOWN }, signal });
    given.hidden = found === 0;
    fill(given,
      h("header", { class: "head" }, h("h2", {}, `${plural(found, "place")} given or denied here`), button("Undo all", () => takeBack(null))),
      acceptedList(images.map((photo) => [photo, givenInWords(photo) ?? "got another place since"]), (photos) => takeBack(photos.map(({ image_id: id }) => id))),
      found > images.length && h("p", { class: "soft" }, `The newest ${count(images.length)} are shown.`));
  }

  await drawGiven();
  start();
}

/** What a given place rests on; null for a place that was sent with the photo. */
export const givenInWords = ({ given_place: given }) => given && (given.denied ? `A person said that it was not taken ${given.denied.place ? `in ${given.denied.place}` : "where an answer put it"}.` : given.probability === null ? "A person chose this place." : `Proposed with ${percent(given.probability)}: ${given.reason}`);
