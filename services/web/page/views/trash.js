// The trash: photos that were removed, until their bytes are deleted.

import { ask, get, post } from "../api.js";
import { button, confirmed, fill, h, note } from "../dom.js";
import { nameOf, plural } from "../format.js";
import { thumbnail } from "../photo.js";

const PAGE = 48;

/** Restore these photos, one after the other. */
export async function restore(ids) {
  for (const id of ids) await post(`/uploads/${id}/restore`);
  note(`${plural(ids.length, "photo")} restored.`);
}

/** Remove photos; the message has the way back. `onchange` is called after both. */
export async function remove(photos, onchange) {
  const removed = [];
  try {
    for (const { image_id: id } of photos) {
      await ask(`/uploads/${id}`, { method: "DELETE" });
      removed.push(id);
    }
  } finally {
    if (removed.length) note(`${removed.length < photos.length ? `${removed.length} of ` : ""}${plural(photos.length, "photo")} moved to the trash.`, "", async () => {
      await restore(removed);
      await onchange();
    });
    await onchange();
  }
}

export async function showTrash(view, { signal }) {
  const grid = h("ul", { class: "photos" });
  const empty = h("div", { class: "row" });
  const more = h("div", { class: "more" });
  const total = h("p", { class: "total", role: "status" });
  fill(view,
    h("header", { class: "head" }, h("h1", {}, "Trash"), h("a", { class: "button", href: "#/photos" }, "All photos")),
    h("p", { class: "soft" }, "Removed photos are found by nobody, but take their space. They can be restored for a time, 30 days unless the server is set otherwise, and are then deleted for good."),
    total, empty, grid, more);

  const load = async (cursor) => {
    const page = await get("/search", { query: { removed: true, limit: PAGE, cursor }, signal });
    if (!cursor) fill(grid);
    fill(empty, page.total_found > 0 && button("Empty the trash…", () => emptyAll(page.total_found), "danger"));
    fill(total, page.total_found ? plural(page.total_found, "photo") : "The trash is empty.");
    grid.append(...page.images.map((photo) => h("li", {}, card(photo))));
    fill(more, page.next_cursor && button("Show more", () => load(page.next_cursor)));
  };
  const deleteForGood = ({ image_id: id }) => ask(`/uploads/${id}`, { method: "DELETE", query: { permanently: true } });
  const emptyAll = async (known) => {
    if (!(await confirmed("Empty the trash?", `${plural(known, "photo")} and their bytes are deleted. This can’t be undone.`, "Delete for good"))) return;
    const words = h("p", { class: "soft", role: "status" });
    fill(empty, words);
    try {
      for (let deleted = 0, page; (page = await get("/search", { query: { removed: true, limit: PAGE }, signal })).images.length;) {
        for (const photo of page.images) {
          await deleteForGood(photo);
          fill(words, `${deleted += 1} of ${plural(known, "photo")} deleted`);
        }
      }
    } finally {
      await load(null);
    }
  };
  const card = (photo) => h("article", { class: "photo-card removed" },
    thumbnail(photo),
    h("p", { class: "photo-name", title: nameOf(photo) }, nameOf(photo)),
    h("div", { class: "row" },
      button("Restore", async () => {
        await restore([photo.image_id]);
        await load(null);
      }),
      button("Delete for good…", async () => {
        if (!(await confirmed("Delete this photo for good?", `${nameOf(photo)} and its bytes are deleted. This can’t be undone.`, "Delete for good"))) return;
        await deleteForGood(photo);
        await load(null);
      }, "link")));
  await load(null);
}
