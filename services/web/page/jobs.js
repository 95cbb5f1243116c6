// A job until it ends: server-sent events, or polling where a proxy keeps those back.

import { ask, get, post } from "./api.js";
import { bar, button, fill, h, note, noteError } from "./dom.js";
import { percent } from "./format.js";

const ENDED = ["succeeded", "failed", "cancelled"];
const SILENCE_MS = 40_000; // the server sends a heartbeat every 15 s
const POLL_SECONDS = 10;

export const hasEnded = (job) => ENDED.includes(job.state);

/** Tells `onChange` of every change; resolves with the job as it ended. `query` may name its map. */
export async function watchJob(id, onChange, signal, query = {}) {
  try {
    for await (const job of events(id, signal, query)) {
      onChange(job);
      if (hasEnded(job)) return job;
    }
  } catch (error) {
    if (signal?.aborted) throw error;
  }
  while (true) {
    const job = await get(`/jobs/${id}`, { query: { ...query, wait: POLL_SECONDS }, signal });
    onChange(job);
    if (hasEnded(job)) return job;
  }
}

// Not EventSource: it can't send a key.
async function* events(id, signal, query) {
  const silence = new AbortController();
  let timer;
  const spoken = () => {
    clearTimeout(timer);
    timer = setTimeout(() => silence.abort(), SILENCE_MS);
  };
  const leave = () => silence.abort();
  signal?.addEventListener("abort", leave);
  try {
    spoken();
    const response = await ask(`/jobs/${id}/events`, { query, signal: silence.signal });
    const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
    let text = "";
    while (true) {
      const { done, value } = await reader.read();
      if (done) return;
      spoken();
      text += value;
      const whole = text.split("\n\n");
      text = whole.pop();
      for (const event of whole) {
        const data = event.split("\n").filter((line) => line.startsWith("data:")).map((line) => line.slice(5)).join("\n");
        if (data) yield JSON.parse(data);
      }
    }
  } finally {
    clearTimeout(timer);
    signal?.removeEventListener("abort", leave);
    silence.abort();
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
