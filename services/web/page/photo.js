// Photos of the server as pictures. They are fetched, because an <img> can't send a key.

import { Problem, ask } from "./api.js";
import { h } from "./dom.js";

const AT_ONCE = 6;
const waiting = [];
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
  try {
    let response;
    try {
      response = await ask(image.dataset.url);
    } catch (error) {
      // Until it is described, a photo has no thumbnail.
      if (!(error instanceof Problem) || error.code !== "thumbnail_not_found") throw error;
      response = await ask(image.dataset.url.replace("/thumbnail", "/image"));
    }
    const url = URL.createObjectURL(await response.blob());
    try {
      image.src = url;
      await image.decode();
    } finally {
      URL.revokeObjectURL(url);
    }
  } catch {
    image.classList.add("missing");
    image.alt = `${image.alt} (can't be loaded)`;
  }
}

// An <img> without a source is drawn as a broken one.
const NOTHING = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw==";

function picture(url, photo, alt) {
  const image = h("img", { src: NOTHING, alt, "data-url": url, width: photo.width, height: photo.height });
  inSight.observe(image);
  return image;
}

/** The thumbnail, loaded when it comes into sight. */
export const thumbnail = (photo, alt = photo.original_filename) => picture(photo.thumbnail_url, photo, alt);

/** The photo itself. */
export const original = (photo, alt = photo.original_filename) => picture(photo.image_url, photo, alt);
