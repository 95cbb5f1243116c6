// Two photos side by side, and what makes them similar.

import { Problem } from "../api.js";
import { fill, h, openDialog } from "../dom.js";
import { nameOf, percent, score, strength, whereabouts } from "../format.js";
import { preview } from "../photo.js";
import { coordinateTools } from "../places.js";

/** Open the dialog at one of the matches; the arrow keys lead to the others. */
export function compare(queryPhoto, photos, index, signal) {
  const body = h("div", { class: "compare" });
  const { dialog, heading } = openDialog("", body);
  dialog.classList.add("wide");
  signal.addEventListener("abort", () => dialog.close());
  let shown = 0;

  async function show(next) {
    index = (next + photos.length) % photos.length;
    const mine = ++shown;
    const photo = photos[index];
    fill(heading, `Match ${index + 1} of ${photos.length}`);
    const overlay = h("img", { class: "overlay", alt: "", hidden: true });
    const opacity = h("input", { type: "range", min: 0, max: 100, value: 70, "aria-label": "Strength of the overlay" });
    opacity.addEventListener("input", () => (overlay.style.opacity = opacity.value / 100));
    overlay.style.opacity = 0.7;
    const why = h("div", { class: "why" }, h("p", { class: "soft" }, "Looking for what makes them similar…"));
    fill(body,
      h("figure", {}, h("div", { class: "frame" }, queryPhoto.picture(), overlay), h("figcaption", {}, queryPhoto.name)),
      h("figure", {}, h("div", { class: "frame" }, preview(photo)), h("figcaption", {}, h("a", { href: `#/photo/${photo.image_id}` }, nameOf(photo)), h("span", { class: "soft" }, ` ${whereabouts(photo)}`)),
        photo.latitude !== null && coordinateTools(photo.latitude, photo.longitude)),
      h("div", { class: "compare-words" },
        h("div", {},
          photo.match_probability !== null && h("p", {}, h("span", { class: `strength ${strength(photo.match_probability)}` }, strength(photo.match_probability)), h("span", { class: "figure large" }, ` ${percent(photo.match_probability)}`), h("span", { class: "soft" }, " the same place")),
          h("details", {}, h("summary", {}, "Details"), h("p", { class: "soft" }, `Similarity ${score(photo.similarity_score)} (cosine)`, photo.weighted_score !== null && `, weighted score ${score(photo.weighted_score)}`))),
        why,
        h("div", { class: "row end" },
          h("button", { type: "button", onclick: () => show(index - 1) }, "← Previous"),
          h("button", { type: "button", onclick: () => show(index + 1) }, "Next →"))));
    try {
      const found = await queryPhoto.find({ top_k: 1, ids: photo.image_id, explain: true, history: false }, () => {});
      const explanation = found.similar_images[0]?.explanation;
      if (mine !== shown || !explanation) return;
      overlay.src = explanation.overlay;
      overlay.hidden = false;
      fill(why,
        h("p", { class: "legend" }, h("span", { class: "swatch for" }), "increases the similarity ", h("span", { class: "swatch against" }), "decreases it"),
        h("label", { class: "field inline" }, h("span", {}, "Overlay"), opacity));
    } catch (error) {
      if (mine !== shown || signal.aborted) return;
      fill(why, h("p", { class: "soft" }, error instanceof Problem ? error.message : "The explanation is not available now."));
    }
  }

  dialog.addEventListener("keydown", (event) => {
    if (event.target instanceof HTMLInputElement) return;
    if (event.key === "ArrowLeft") show(index - 1);
    if (event.key === "ArrowRight") show(index + 1);
  });
  show(index);
}
