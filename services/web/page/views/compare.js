// Two photos side by side, with lines between the points that both show.

import { fill, h, openDialog } from "../dom.js";
import { nameOf, percent, plural, score, strength, whereabouts } from "../format.js";
import { preview } from "../photo.js";
import { coordinateTools } from "../places.js";

const SVG = "http://www.w3.org/2000/svg";
const LINES = [0, 30, 150]; // of the most similar points; more hide the photos
const NARROW = "(max-width: 460px)"; // the photos lie below one another: lines would cover both

/** Open the dialog at one of the matches; the arrow keys lead to the others. */
export function compare(queryPhoto, { matches }, photos, index, signal) {
  const body = h("div", { class: "compare" });
  const { dialog, heading } = openDialog("", body);
  dialog.classList.add("wide");
  signal.addEventListener("abort", () => dialog.close());
  let redraw = () => {};
  let most = matchMedia(NARROW).matches ? LINES[0] : LINES[1];
  const resized = new ResizeObserver(() => redraw());
  dialog.addEventListener("close", () => resized.disconnect());

  function show(next) {
    index = (next + photos.length) % photos.length;
    const photo = photos[index];
    const points = pointsInWords(photo, matches);
    fill(heading, `Match ${index + 1} of ${photos.length}`);
    const frames = [h("div", { class: "frame" }, queryPhoto.picture()), h("div", { class: "frame" }, preview(photo))];
    const lines = document.createElementNS(SVG, "svg");
    lines.classList.add("lines");
    lines.setAttribute("role", "img");
    lines.setAttribute("aria-label", points);
    fill(body,
      h("figure", {}, frames[0], h("figcaption", {}, queryPhoto.name)),
      h("figure", {}, frames[1], h("figcaption", {}, h("a", { href: `#/photo/${photo.image_id}` }, nameOf(photo)), h("span", { class: "soft" }, ` ${whereabouts(photo)}`)),
        photo.latitude !== null && coordinateTools(photo.latitude, photo.longitude)),
      photo.pairs?.length && lines,
      h("div", { class: "compare-words" },
        h("div", {},
          photo.match_probability !== null && h("p", {}, h("span", { class: `strength ${strength(photo.match_probability)}` }, strength(photo.match_probability)), h("span", { class: "figure large" }, ` ${percent(photo.match_probability)}`), h("span", { class: "soft" }, " the same place")),
          h("details", {}, h("summary", {}, "Details"), h("p", { class: "soft" }, `Similarity ${score(photo.similarity_score)} (cosine)`))),
        h("div", {}, h("p", { class: "points", role: "status" }, points),
          photo.pairs?.length > 0 && linesSwitch()),
        h("div", { class: "row end" },
          h("button", { type: "button", onclick: () => show(index - 1) }, "← Previous"),
          h("button", { type: "button", onclick: () => show(index + 1) }, "Next →"))));
    redraw = () => photo.pairs?.length && drawLines(lines, frames, photo, matches, most);
    resized.disconnect();
    frames.forEach((frame) => resized.observe(frame)); // their heights are known when the photos are loaded
  }

  function linesSwitch() {
    const choice = h("select", {}, LINES.map((number) => h("option", { value: number }, number ? `at most ${number}` : "none")));
    choice.value = most;
    choice.addEventListener("change", () => {
      most = Number(choice.value);
      redraw();
    });
    return h("label", { class: "check" }, h("span", {}, "Lines"), choice);
  }

  dialog.addEventListener("keydown", (event) => {
    if (event.target.matches("select")) return;
    if (event.key === "ArrowLeft") show(index - 1);
    if (event.key === "ArrowRight") show(index + 1);
  });
  show(index);
}

function pointsInWords(photo, matches) {
  if (photo.inliers !== null) return `${plural(photo.inliers, "point")} of both photos match.`;
  return matches?.reason ? `No points can be compared. ${matches.reason}` : "This photo has no points to compare.";
}

/** Lines over both frames; the pairs are in pixels of the originals. */
function drawLines(svg, frames, photo, matches, most) {
  const origin = svg.getBoundingClientRect();
  const [query, other] = frames.map((frame) => frame.firstChild.getBoundingClientRect());
  const place = ([x, y], area, width, height) => [area.left - origin.left + (x / width) * area.width, area.top - origin.top + (y / height) * area.height];
  const shown = photo.pairs.slice(0, most);
  svg.replaceChildren(...shown.map((pair, number) => {
    const [x1, y1] = place(pair.query, query, matches.query_width, matches.query_height);
    const [x2, y2] = place(pair.photo, other, photo.width, photo.height);
    const line = document.createElementNS(SVG, "line");
    Object.entries({ x1, y1, x2, y2, stroke: `hsl(${(360 * number) / shown.length} 90% 55%)` }).forEach(([name, value]) => line.setAttribute(name, value));
    return line;
  }));
}
