// Coordinates that can be copied and opened on a map of the streets.

import { button, h, note } from "./dom.js";
import { degrees } from "./format.js";

const ZOOM = 18;

/** Copies the coordinates, or opens them on the map of another site. */
export function coordinateTools(latitude, longitude) {
  const at = `${latitude.toFixed(6)}/${longitude.toFixed(6)}`;
  const url = `https://www.openstreetmap.org/?mlat=${latitude.toFixed(6)}&mlon=${longitude.toFixed(6)}#map=${ZOOM}/${at}`;
  return h("span", { class: "place-tools" },
    button("Copy", () => copy(degrees(latitude, longitude)), "link"),
    h("a", { href: url, target: "_blank", rel: "noopener noreferrer" }, "OpenStreetMap"));
}

async function copy(text) {
  // Browsers have a clipboard only on HTTPS and on the server's own machine, not on a phone in its network.
  if (navigator.clipboard) await navigator.clipboard.writeText(text);
  else copySelected(text);
  note(`Copied: ${text}`);
}

function copySelected(text) {
  const input = h("input", { value: text, class: "visually-hidden", readonly: true });
  document.body.append(input);
  input.select();
  const copied = document.execCommand("copy");
  input.remove();
  if (!copied) throw new Error(`This browser does not copy. The coordinates are ${text}.`);
}
