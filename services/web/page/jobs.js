// A job until it ends.

import { get, post } from "./api.js";
import { bar, button, fill, h, note, noteError } from "./dom.js";
import { percent } from "./format.js";

const ENDED = ["succeeded", "failed", "cancelled"];
const POLL_SECONDS = 1; // short, so that the progress moves; the end is answered at once

export const hasEnded = (job) => ENDED.includes(job.state);

/** Tells `onChange` of each state; resolves with the job as it ended. `query` may name its map. */
export async function watchJob(id, onChange, signal, query = {}) {
  while (true) {
    const job = await get(`/jobs/${id}`, { query: { ...query, wait: POLL_SECONDS }, signal });
    onChange(job);
    if (hasEnded(job)) return job;
  }
}

/** What a job is at, in words. */
export function stateInWords(job) {
  if (job.waiting_for === "disk_space") return "waits for disk space";
  const stage = { sample: "looking at photos", cluster: "finding centres", gather: "reading descriptors", reduce: "computing the projection", describe: "describing", load: "loading into search", list: "listing", store: "storing", pairs: "choosing pairs", match: "matching photos", map: "computing the model", align: "aligning it", calibrate: "testing its poses" }[job.stage];
  if (job.state === "running") return stage ?? "being described";
  return { queued: "waiting", succeeded: "done", failed: "failed", cancelled: "cancelled" }[job.state];
}

/** The bar of a job in `work`; `again` draws the view anew when it has ended. */
export async function followJob(work, started, words, again, signal) {
  const state = h("p", { class: "soft" });
  const progress = h("div", {});
  const cancel = button("Cancel", () => post(`/jobs/${started.job_id}/cancel`));
  fill(work, h("div", { class: "job" }, h("p", { role: "status" }, h("strong", {}, words)), progress, h("div", { class: "row" }, state, cancel)));
  const draw = (job) => {
    fill(progress, bar(words, job.progress.done, job.progress.total));
    // Its stages count different things: a share says how far it is.
    fill(state, stateInWords(job), job.state === "running" && job.progress.total ? `: ${percent(job.progress.done / job.progress.total)}` : "");
  };
  try {
    const job = await watchJob(started.job_id, draw, signal);
    if (job.state === "failed") note(job.error?.detail ?? `${words} has failed.`, "bad");
    else note(`${words}: ${stateInWords(job)}.`);
    await again();
  } catch (error) {
    if (!signal.aborted) noteError(error);
  }
}
