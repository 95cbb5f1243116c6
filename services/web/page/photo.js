// Photos of the server as pictures. They are fetched, because an <img> can't send a key.

import { ask, get } from "./api.js";
import { h, noteError } from "./dom.js";
import { nameOf } from "./format.js";
import { hasEnded } from "./jobs.js";

const AT_ONCE = 6;
const JOB_WAIT_SECONDS = 10;
const waiting = [];
const whenUndescribed = new WeakMap(); // what to do with an image whose photo has no thumbnail
let loading = 0;

const inSight = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries) {
    if (!isIntersecting) continue;
    inSight.unobserve(target);
    waiting.push(target);
    next();
  }
}, { rootMargin: "300px" });

function next() {
  while (loading < AT_ONCE && waiting.length) {
    const image = waiting.shift();
    if (!image.isConnected) continue;
    loading += 1;
    show(image).finally(() => {
      loading -= 1;
      next();
    });
  }
}

async function show(image) {
  const { url, original, waited } = image.dataset;
  try {
    const response = await ask(url).catch((error) => {
      // Until it is described, a photo has no thumbnail; one that can't be described has neither.
      if (["thumbnail_not_found", "preview_not_found"].includes(error.code)) {
        whenUndescribed.get(image)?.();
        return ask(original);
      }
      throw error;
    });
    if (response.status !== 202) {
      await draw(image, response);
      return;
    }
    // Until the preview is made, the original is shown, where the browser can.
    const { job_id: jobId } = await response.json();
    await draw(image, await ask(original)).finally(() => {
      if (!waited) showWhenMade(image, jobId).catch(noteError);
    });
  } catch {
    image.classList.add("missing");
    image.alt = `${image.alt} (can't be loaded)`;
  }
}

/** Show the picture again when the job has ended that makes it, unless the view was left. */
async function showWhenMade(image, jobId) {
  image.dataset.waited = true; // once
  const { alt } = image;
  while (image.isConnected) {
    if (!hasEnded(await get(`/jobs/${jobId}`, { query: { wait: JOB_WAIT_SECONDS } }))) continue;
    image.classList.remove("missing");
    image.alt = alt;
    waiting.push(image);
    next();
    return;
  }
}

async function draw(image, response) {
  const url = URL.createObjectURL(await response.blob());
  try {
    image.src = url;
    await image.decode();
  } finally {
    URL.revokeObjectURL(url);
  }
}

// An <img> without a source is drawn as a broken one.
const NOTHING = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw==";

function picture(url, photo, alt) {
  const image = h("img", { src: NOTHING, alt, "data-url": url, "data-original": photo.image_url, width: photo.width, height: photo.height });
  inSight.observe(image);
  return image;
}

/** The thumbnail, loaded when it comes into sight. `onundescribed` is called if the photo has none: it
 * waits to be described, or can't be. */
export function thumbnail(photo, alt = nameOf(photo), onundescribed = null) {
  const image = picture(photo.thumbnail_url, photo, alt);
  if (onundescribed) whenUndescribed.set(image, onundescribed);
  return image;
}

/** The photo at the size of a screen. */
export const preview = (photo, alt = nameOf(photo)) => picture(photo.preview_url, photo, alt);

// Formats that only some browsers show, by the file's name: not all systems know their media types.
const OTHER_FORMAT = /\.(heic|heif|tiff?)$/i;

/** Whether some browsers can't show the file. */
export const mayNeedPreview = (file) => OTHER_FORMAT.test(file.name);

/** A file of this machine; where the browser can't show its format, as it can't HEIC, the server's
 * `preview` (a promise of its response, or of null), and until then a drawing. */
export function localPicture(file, attributes, preview = null) {
  const url = URL.createObjectURL(file);
  const image = h("img", { src: url, ...attributes });
  image.addEventListener("load", () => URL.revokeObjectURL(url));
  image.addEventListener("error", () => {
    URL.revokeObjectURL(url);
    image.src = "/console/unshown.svg";
    image.title = "This browser can’t show photos of this format.";
    preview?.then(async (response) => {
      if (response === null) return; // the drawing stays
      await draw(image, response.clone());
      image.removeAttribute("title");
    }).catch(noteError);
  }, { once: true });
  return image;
}
