// What is being added: a few uploads at a time, each with its job, many photos as batches.

import { Problem, currentMap, get, idempotencyKey, maySucceed, post, send } from "./api.js";
import { withoutHidden } from "./drop.js";
import { count, plural } from "./format.js";
import { stateInWords, watchJob } from "./jobs.js";
import { readZip } from "./zip.js";

const AT_ONCE = 3; // browsers keep six connections to a server, and each job that is polled takes one
const ONE_BY_ONE = 24; // more than these go as batches
const BATCH_PHOTOS = 60;
const BATCH_BYTES = 120_000_000;
const ERRORS_SHOWN = 100;
const BUSY_TRIES = 20;
const ZIP = /\.zip$/i;
const TAR = /\.(tar|tgz|tar\.gz)$/i;
const SIDECAR = /\.xmp$/i;
const TABLE = /(^|\/)(photos\.csv|manifest\.jsonl)$/;
const PHOTO = /\.(jpe?g|jpe|jfif|png|webp|bmp|tiff?|heic|heif)$/i;

/** How many were added, and how many the map had before. */
export function addedInWords({ done, already }) {
  const added = `${plural(done - already, "photo")} added`;
  return already ? `${added}, ${count(already)} already there` : added;
}

/** One row of the list: a photo, or a batch of photos. */
class Entry {
  constructor(queue, name, total) {
    this.queue = queue;
    this.name = name;
    this.total = total;
    this.map = currentMap(); // also when another one is looked at meanwhile
    this.picture = null;
    this.begin();
  }

  begin() {
    this.key = idempotencyKey();
    /** waiting, sending, working, done, failed */
    this.phase = "waiting";
    this.sent = 0;
    this.done = 0;
    this.failed = 0;
    /** How many of the done ones the map had before. */
    this.already = 0;
    this.job = null;
    this.errors = [];
    this.hold = null;
    this.again = false;
    /** Whether what failed may succeed when it is repeated. */
    this.canRetry = false;
  }

  set(changes) {
    Object.assign(this, changes);
    this.queue.changed();
  }

  /** Sent again while the server has no room for it. */
  async sendForm(path, form) {
    for (let turn = 1; ; turn++) {
      try {
        this.set({ phase: "sending", sent: 0, hold: null });
        return await send(path, form, { query: { map: this.map }, key: this.key, onSent: (sent) => this.set({ sent }) });
      } catch (error) {
        if (!(error instanceof Problem) || error.retryAfter === null || turn === BUSY_TRIES) throw error;
        this.set({ hold: error.retryAfter });
        await new Promise((resolve) => setTimeout(resolve, error.retryAfter * 1000));
      }
    }
  }

  async run() {
    try {
      await this.work();
    } catch (error) {
      this.set({ phase: "failed", failed: this.total - this.done, canRetry: maySucceed(error), errors: [...this.errors, { name: "", detail: error.message }] });
    }
  }

  watch(id) {
    return watchJob(id, (job) => this.set({ job, phase: "working", done: job.progress.done, failed: job.progress.failed, total: Math.max(job.progress.total, this.total) }), undefined, { map: this.map });
  }

  async retry() {
    this.begin();
    this.queue.start();
  }

  /** Failures that are not listed: the server's list of them is cut. */
  get unlisted() {
    return this.phase === "failed" && this.errors.length >= ERRORS_SHOWN ? this.failed - this.errors.length : 0;
  }

  words() {
    if (this.hold !== null) return `The server is busy: sent again after ${this.hold} s`;
    switch (this.phase) {
      case "waiting": return "Waiting for its turn";
      case "sending": return this.sent < 1 ? `Being sent, ${Math.floor(100 * this.sent)} %` : "Being stored";
      case "working": return this.total > 1 ? `${count(this.done)} of ${count(this.total)} searchable` : `Stored, ${this.job ? stateInWords(this.job) : "waiting"}`;
      case "failed": return this.total > 1 ? `${addedInWords(this)}, ${count(this.failed)} failed` : "Failed";
      default: return this.total > 1 ? addedInWords(this) : this.already ? "Searchable; the map had it already" : "Searchable";
    }
  }
}

class PhotoEntry extends Entry {
  constructor(queue, { file, path }, fields) {
    super(queue, path, 1);
    this.picture = file;
    this.fields = fields;
  }

  async work() {
    const form = new FormData();
    // Fields first: the server reads the form as it comes.
    if (this.name.includes("/")) form.append("relative_path", this.name);
    for (const [name, value] of Object.entries(this.fields)) form.append(name, Array.isArray(value) ? value.join(",") : value);
    form.append("file", this.picture, this.picture.name);
    const stored = await this.sendForm("/upload", form);
    this.already = Number(stored.already_there);
    if (stored.job_id && stored.status !== "succeeded") {
      this.set({ phase: "working" });
      const job = await this.watch(stored.job_id);
      if (job.state !== "succeeded") throw new Problem(job.error?.status, job.error ?? { detail: `The job is ${job.state}.` }, null);
    }
    this.set({ phase: "done", done: 1, failed: 0 });
  }
}

class BatchEntry extends Entry {
  constructor(queue, name, files, fields) {
    super(queue, name, files.length);
    this.files = files;
    this.fields = fields;
  }

  async form() {
    const form = new FormData();
    const hasFields = Object.keys(this.fields).length > 0;
    if (hasFields) form.append("manifest", this.files.map(({ path }) => JSON.stringify({ filename: path, ...this.fields })).join("\n"));
    for (const { path, read } of this.files) form.append("file", await read(), path);
    return form;
  }

  async work() {
    if (!this.again) this.batch = (await this.sendForm("/upload/batch", await this.form())).job_id;
    this.set({ phase: "working" });
    const job = await this.watch(this.batch);
    const { done, failed, total } = job.progress;
    this.already = job.result?.already_there ?? 0;
    const errors = failed ? await this.#failedItems() : [];
    if (job.state !== "succeeded" && job.error && !errors.length) errors.push({ ...job.error, name: "" });
    const canRetry = job.state === "cancelled" || failed > errors.length || errors.some(maySucceed);
    this.set({ phase: failed || job.state !== "succeeded" ? "failed" : "done", done, failed: job.state === "succeeded" ? failed : Math.max(total, this.total) - done, canRetry, errors });
  }

  async #failedItems() {
    const { items } = await get(`/jobs/${this.batch}/items`, { query: { map: this.map, state: "failed", limit: ERRORS_SHOWN } });
    return items.map((item) => ({ detail: "not known why", ...item.error, name: item.name }));
  }

  /** The server has the bytes of what it took: only what has failed is done again. */
  async retry() {
    const { batch } = this;
    this.begin();
    if (batch) {
      try {
        await post(`/jobs/${batch}/retry`, { query: { map: this.map } });
        this.again = true;
      } catch (error) {
        if (error.code !== "job_not_retryable") throw error;
      }
    }
    this.queue.start();
  }
}

/** Runs AT_ONCE entries at a time, in their order. */
export class UploadQueue {
  constructor() {
    this.entries = [];
    this.running = 0;
    this.onchange = () => {};
    this.drawing = false;
  }

  /** `files` as [{file, path}]; `fields` are those of POST /upload, and hold for all of them. Resolves to sentences
   * about what was left out; hidden files are not counted. */
  async add(chosen, fields) {
    const files = withoutHidden(chosen);
    const zips = files.filter(({ path }) => ZIP.test(path));
    const tars = files.filter(({ path }) => TAR.test(path));
    const photos = files.filter(({ file, path }) => !ZIP.test(path) && !TAR.test(path) && (file.type.startsWith("image/") || PHOTO.test(path) || files.length === 1));
    const countSidecars = (some) => some.filter(({ path }) => SIDECAR.test(path) && some.length > 1).length;
    let sidecars = countSidecars(files);
    let leftOut = files.length - zips.length - tars.length - photos.length - sidecars;
    if (photos.length <= ONE_BY_ONE) this.entries.push(...photos.map((one) => new PhotoEntry(this, one, fields)));
    else this.entries.push(...this.#batches(photos.map(({ file, path }) => ({ path, size: file.size, read: () => file })), fields));
    this.start();
    const notes = tars.map(({ path }) => `${path} left out: unpack it, or run placewise index.`);
    for (const { file } of zips) {
      try {
        const members = withoutHidden(await readZip(file));
        const inside = members.filter(({ path }) => PHOTO.test(path));
        const tables = members.filter(({ path }) => TABLE.test(path));
        if (inside.length) this.entries.push(...this.#batches(inside, fields));
        else notes.push(`${file.name} has no photos.`);
        notes.push(...tables.map(({ path }) => `${path} of ${file.name} is not read here: run placewise index.`));
        sidecars += countSidecars(members);
        leftOut += members.length - inside.length - tables.length - countSidecars(members);
      } catch (error) {
        notes.push(error.message);
      }
    }
    this.start();
    if (sidecars) notes.push(`${plural(sidecars, "sidecar")} (XMP) not read here: run placewise index.`);
    if (leftOut) notes.push(`${plural(leftOut, "file")} left out: no photos.`);
    return notes;
  }

  #batches(photos, fields) {
    const batches = [[]];
    let size = 0;
    for (const photo of photos) {
      if (batches.at(-1).length === BATCH_PHOTOS || (size && size + photo.size > BATCH_BYTES)) {
        batches.push([]);
        size = 0;
      }
      batches.at(-1).push(photo);
      size += photo.size;
    }
    const name = (some) => (some.length === 1 ? some[0].path : `${some[0].path} … ${some.at(-1).path}`);
    return batches.map((some) => new BatchEntry(this, name(some), some, fields));
  }

  start() {
    while (this.running < AT_ONCE) {
      const next = this.entries.find((entry) => entry.phase === "waiting");
      if (!next) break;
      this.running += 1;
      next.phase = "sending";
      next.run().finally(() => {
        this.running -= 1;
        this.start();
      });
    }
    this.changed();
  }

  /** At most one drawing for each of the screen's. */
  changed() {
    if (this.drawing) return;
    this.drawing = true;
    requestAnimationFrame(() => {
      this.drawing = false;
      this.onchange();
    });
  }

  figures() {
    const sum = (name) => this.entries.reduce((all, entry) => all + entry[name], 0);
    return { total: sum("total"), done: sum("done"), failed: sum("failed"), already: sum("already"), sending: this.entries.some((entry) => ["waiting", "sending"].includes(entry.phase)) };
  }

  retryable() {
    return this.entries.filter((entry) => entry.canRetry);
  }

  async retryAll() {
    for (const entry of this.retryable()) await entry.retry();
  }

  clear() {
    this.entries = [];
    this.changed();
  }
}
