// Proposals to accept: cards in a grid and, by their numbers, points on a map that also shows what was before.

import { get } from "./api.js";
import { button, fill, h } from "./dom.js";
import { nameOf } from "./format.js";
import { openMap } from "./map.js";
import { thumbnail } from "./photo.js";

const KNOWN_ON_MAP = 1000;

/** A photo under its name; a link to its view. */
const figureOf = (photo, words) => h("figure", {}, h("a", { href: `#/photo/${photo.image_id}`, "aria-label": words }, thumbnail(photo, "")), h("figcaption", {}, words));

/** The card of a proposal: its photo and what that looks like, `[figure, words]` of how sure it is, and its buttons. */
export function proposalCard(number, { photo, like = null, sure = false, certainty: [figure, words], before, after, reason = null, actions }) {
  return h("article", { class: sure ? "proposal sure" : "proposal" },
    h("div", { class: "two-photos" }, figureOf(photo, nameOf(photo)), like && figureOf(like, `Looks like ${nameOf(like)}`)),
    h("p", { class: "match-words" }, h("span", { class: "rank-word" }, String(number)), h("span", { class: "figure" }, figure), h("span", { class: "soft" }, words)),
    h("p", { class: "soft small" }, `Before: ${before}. After: ${after}`),
    reason && h("p", { class: "small" }, reason.charAt(0).toUpperCase() + reason.slice(1)),
    h("div", { class: "row" }, actions));
}

/** What was accepted: `[photo, words]` of each, with the way back. */
export const acceptedList = (rows, undo) => h("ul", { class: "given" }, rows.map(([photo, words]) => h("li", {},
  h("a", { href: `#/photo/${photo.image_id}` }, thumbnail(photo, ""), h("span", {}, nameOf(photo))),
  h("span", { class: "soft small" }, words),
  button("Undo", () => undo([photo]), "link"))));

/** A grid of proposals, and a map of them over the photos that have a place, with a button that shows it as it was before. */
export function proposalBoard(label, signal) {
  const ground = h("div", { class: "ground browse", hidden: true });
  const grid = h("ul", { class: "proposals" });
  let map = null;
  let known = [];
  let shown = [];
  let after = true;
  const toggle = button("Show the map as it was before", () => {
    after = !after;
    toggle.setAttribute("aria-pressed", String(!after));
    drawPoints();
  });
  toggle.setAttribute("aria-pressed", "false");
  toggle.hidden = true;

  function drawPoints() {
    map.clear();
    const moved = new Set(shown.map(({ photo }) => photo.image_id));
    for (const photo of known) if (!moved.has(photo.image_id)) map.point(photo.latitude, photo.longitude, { kind: "behind", radius: 4, text: nameOf(photo) });
    shown.map((proposal, index) => [proposal, index + 1]).reverse().forEach(([{ photo, from, to }, number]) => {
      if (after && from && to) {
        map.line([from, to], "path");
        map.point(...from, { kind: "lost", radius: 4, text: `${nameOf(photo)}, before` });
      }
      const point = after ? to : from;
      if (point) map.numbered(...point, number, `${number}: ${nameOf(photo)}`, () => grid.children[number - 1]?.scrollIntoView({ block: "center" }));
    });
  }

  return {
    grid,
    elements: [toggle, ground],

    /** Show these, the first with number 1: `photo`, `card(number)`, and `[latitude, longitude]` before (`from`) and after (`to`), or null. */
    draw(proposals) {
      shown = proposals;
      fill(grid, shown.map(({ card }, index) => h("li", {}, card(index + 1))));
      if (map) drawPoints();
    },

    /** Open the map once a proposal has coordinates. */
    async openMap() {
      if (!ground.hidden || !shown.some(({ to }) => to)) return;
      ground.hidden = toggle.hidden = false;
      const opened = await openMap(ground, label, { signal });
      known = (await get("/search", { query: { box: "-90,-180,90,180", limit: KNOWN_ON_MAP }, signal })).images;
      signal.throwIfAborted();
      map = opened;
      drawPoints();
      map.fit();
    },

    fit: () => map?.fit(),
  };
}
