// Calls of the API: the map, the key, and errors that say what they mean.

import { field, h, openDialog } from "./dom.js";

const KEY = "placewise-key";
const MAP = "placewise-map";
const ROOT = "/api/v1";
export const UNREACHABLE = "The server can’t be reached. Is it running?";

/** What the server refused, by its RFC 9457 problem. */
export class Problem extends Error {
  constructor(status, body, retryAfter) {
    super(WORDS[body.code]?.(body) ?? body.detail ?? `The server answered ${status}.`);
    this.name = "Problem";
    this.status = status;
    this.code = body.code ?? "unknown";
    /** Seconds after which the same call may work; null where it never will. */
    this.retryAfter = retryAfter;
  }
}

// What the page says instead of the API's details, which name its own ways.
const WORDS = {
  scope_missing: ({ needed }) => `You may not do this: it requires the scope “${needed.join("”, “")}”. Get a key with it from an administrator${hasKey() ? ", and enter it after “Forget the key” on Status" : ""}.`,
  reconstruction_running: () => "The map is being reconstructed already. Wait until that has ended, or cancel it.",
  model_change_running: () => "The model of this map is being changed. Wait until that has ended, or cancel it under Advanced.",
};

const REFUSALS = [400, 403, 413, 415, 422];

/** Whether the same request, or a job with this error, may succeed when it is repeated. */
export const maySucceed = ({ status, code }) => code === "no_heic_decoder" || !(REFUSALS.includes(status) || code === "photo_differs");

export const currentMap = () => localStorage.getItem(MAP) ?? "default";
export const chooseMap = (name) => localStorage.setItem(MAP, name);

/** 32 random hexadecimal digits (crypto.randomUUID wants HTTPS). */
export function idempotencyKey() {
  return Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");
}

function address(path, query) {
  const url = new URL(path.startsWith("/api/") ? path : ROOT + path, location.origin);
  const map = url.searchParams.has("map") ? {} : { map: currentMap() };
  for (const [name, value] of Object.entries({ ...map, ...query })) {
    for (const one of [value].flat()) {
      if (one !== null && one !== undefined && one !== "") url.searchParams.append(name, one);
    }
  }
  return url;
}

const knownKey = () => sessionStorage.getItem(KEY) ?? localStorage.getItem(KEY);
export const hasKey = () => knownKey() !== null;

/** Forget the key, in this tab and on this device. */
export function forgetKey() {
  sessionStorage.removeItem(KEY);
  localStorage.removeItem(KEY);
}

function headersOf(more) {
  const key = knownKey();
  return { ...(key ? { Authorization: `Bearer ${key}` } : {}), ...more };
}

let asking = null;

/** Ask for the key, once for all calls that miss it. */
function askForKey(problem) {
  asking ??= (async () => {
    const input = h("input", { type: "password", autocomplete: "current-password", required: true, name: "key" });
    const remember = h("input", { type: "checkbox" });
    const known = knownKey() !== null;
    const form = h("form", { method: "dialog" },
      h("p", {}, known ? "The server does not know this key." : "This server needs a key for every call. It was shown at the first start, or set with ADMIN_KEY."),
      field("Key", input, "Kept until this tab is closed, unless you remember it."),
      h("label", { class: "check" }, remember, h("span", {}, "Remember the key on this device")),
      h("div", { class: "row end" }, h("button", { class: "primary", value: "yes" }, "Go on")));
    const answer = await openDialog("The server's key", form).closed;
    asking = null;
    if (answer !== "yes") throw problem;
    forgetKey();
    (remember.checked ? localStorage : sessionStorage).setItem(KEY, input.value.trim());
  })();
  return asking;
}

async function problemOf(response) {
  const retryAfter = response.headers.get("Retry-After");
  const body = await response.json().catch(() => ({}));
  return new Problem(response.status, body, retryAfter === null ? null : Number(retryAfter));
}

/** The response of a call; a Problem for 4xx and 5xx, but those in `also`. */
export async function ask(path, { method = "GET", query, json, body, headers, signal, also = [] } = {}) {
  while (true) {
    const own = json === undefined ? headers : { "Content-Type": "application/json", ...headers };
    let response;
    try {
      response = await fetch(address(path, query), {
        method,
        headers: headersOf(own),
        body: json === undefined ? body : JSON.stringify(json),
        signal,
      });
    } catch (error) {
      if (error.name === "AbortError") throw error;
      throw new Error(UNREACHABLE, { cause: error });
    }
    if (response.ok || response.status === 304 || also.includes(response.status)) return response;
    const problem = await problemOf(response);
    if (problem.status !== 401) throw problem;
    await askForKey(problem);
  }
}

/** The JSON that a call answers. */
export async function get(path, options) {
  return (await ask(path, options)).json();
}

/** POST with an Idempotency-Key. */
export const post = (path, options = {}) =>
  get(path, { method: "POST", ...options, headers: { "Idempotency-Key": idempotencyKey(), ...options.headers } });

/** POST a form, and report the share that was sent: `onSent(share)`. fetch can't. */
export async function send(path, form, { query, key, onSent }) {
  while (true) {
    const response = await new Promise((resolve, reject) => {
      const request = new XMLHttpRequest();
      request.open("POST", address(path, query));
      for (const [name, value] of Object.entries(headersOf({ "Idempotency-Key": key }))) request.setRequestHeader(name, value);
      request.upload.addEventListener("progress", (event) => event.lengthComputable && onSent(event.loaded / event.total));
      request.addEventListener("load", () => resolve(new Response(request.response, {
        status: request.status,
        headers: { "Retry-After": request.getResponseHeader("Retry-After") ?? "" },
      })));
      request.addEventListener("error", () => reject(new Error("The connection to the server was lost.")));
      request.send(form);
    });
    if (response.ok) return response.json();
    const wait = response.headers.get("Retry-After");
    const problem = new Problem(response.status, await response.json().catch(() => ({})), wait ? Number(wait) : null);
    if (problem.status !== 401) throw problem;
    await askForKey(problem);
  }
}

/** Save a file of the API under the name that the server gives it. */
export async function download(path) {
  const response = await ask(path);
  const url = URL.createObjectURL(await response.blob());
  const name = /filename="(.+)"/.exec(response.headers.get("Content-Disposition"))[1];
  h("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
}
