// The map: Leaflet with a graticule, or with streets once the visitor, or who runs the server, has agreed to load them.

import { confirmed, h, note, noteError } from "./dom.js";
import { serverSettings } from "./settings.js";

const STREETS = "placewise-streets"; // the origin of the tiles that this device may load, or HIDDEN
const HIDDEN = "hidden";

const MOST_ZOOM = 21;
const LINES = 9; // about so many across the map
const POINTS_DRAWN = 5000;
const DEGREE_M = 111_195; // of latitude
const CONE_POINTS = 13; // on the rim of a cone
const LABEL_PIXELS = 20; // height of a label of the graticule
const SCALE_PIXELS = 40; // height of the scale, with a label above it
const STREETS_PIXELS = 130; // width of the streets button, with a label beside it

let loaded = null;

/** Leaflet, and the settings of the tiles; loaded with the first map. */
function load() {
  loaded ??= Promise.all([
    new Promise((resolve, reject) => {
      // Before the page's own style sheet, which has the last word.
      document.head.prepend(h("link", { rel: "stylesheet", href: "/console/leaflet/leaflet.css", onload: resolve, onerror: reject }));
    }),
    new Promise((resolve, reject) => {
      document.head.append(h("script", { src: "/console/leaflet/leaflet.js", onload: resolve, onerror: reject }));
    }),
    serverSettings(),
  ]).then(([, , settings]) => settings);
  return loaded;
}

/** Degrees between two lines, so that about LINES of them are seen: 1, 2 or 5 times a power of ten. */
function stepOf(extent) {
  const rough = extent / LINES;
  const power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= rough);
}

function drawGraticule(map, layer) {
  layer.clearLayers();
  const bounds = map.getBounds().pad(0.1);
  const step = stepOf(Math.max(bounds.getNorth() - bounds.getSouth(), bounds.getEast() - bounds.getWest()));
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const line = (from, to, text, at) => {
    L.polyline([from, to], { className: "graticule", interactive: false }).addTo(layer);
    if (text) L.marker(at, { interactive: false, keyboard: false, icon: L.divIcon({ className: "graticule-label", html: text, iconSize: null }) }).addTo(layer);
  };
  const { x: width, y: height } = map.getSize();
  const corner = map.containerPointToLatLng([4, height - 6]);
  for (let lat = Math.ceil(bounds.getSouth() / step) * step; lat < bounds.getNorth(); lat += step) {
    if (Math.abs(lat) > 85) continue;
    const { y } = map.latLngToContainerPoint([lat, corner.lng]);
    // Labels of the meridians are at the top, the scale at the bottom.
    const text = y < LABEL_PIXELS || y > height - SCALE_PIXELS ? "" : `${lat.toFixed(digits)}°`;
    line([lat, bounds.getWest()], [lat, bounds.getEast()], text, [lat, corner.lng]);
  }
  const top = map.containerPointToLatLng([width, 4]);
  for (let lng = Math.ceil(bounds.getWest() / step) * step; lng < bounds.getEast(); lng += step) {
    const { x } = map.latLngToContainerPoint([top.lat, lng]);
    const text = x < 0 || x > width - STREETS_PIXELS ? "" : `${lng.toFixed(digits)}°`;
    line([bounds.getSouth(), lng], [bounds.getNorth(), lng], text, [top.lat, lng]);
  }
}

/** A map in the element, with its name for screen readers. `onpick(latitude, longitude)` makes it a
 * field: a click, or Enter at the middle, chooses a point. */
export async function openMap(element, label, { onpick = null, signal } = {}) {
  const settings = await load();
  signal?.throwIfAborted();
  element.setAttribute("role", "group");
  element.setAttribute("aria-label", label);
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const map = L.map(element, {
    fadeAnimation: !still,
    zoomAnimation: !still,
    markerZoomAnimation: !still,
    inertia: !still,
    maxZoom: MOST_ZOOM,
    minZoom: 1,
    preferCanvas: false,
    scrollWheelZoom: false,
    worldCopyJump: true,
    zoomControl: false,
    zoomSnap: 0.25,
  });
  map.setView([20, 0], 1);
  // Where no label of the graticule lies.
  L.control.zoom({ position: "bottomright" }).addTo(map);
  L.control.scale({ imperial: false }).addTo(map);
  map.attributionControl.setPrefix("");
  addGround(map, element, settings);
  // The wheel scrolls the page until the map is focused or clicked.
  map.on("focus click", () => map.scrollWheelZoom.enable());
  map.on("blur mouseout", () => map.scrollWheelZoom.disable());
  const things = L.layerGroup().addTo(map);
  const resized = new ResizeObserver(() => map.invalidateSize({ pan: false }));
  resized.observe(element);
  signal?.addEventListener("abort", () => {
    resized.disconnect();
    map.remove();
  });
  if (onpick) {
    element.classList.add("picks");
    map.on("click", ({ latlng }) => onpick(latlng.lat, latlng.wrap().lng));
    element.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" || event.target !== element) return;
      const middle = map.getCenter().wrap();
      onpick(middle.lat, middle.lng);
    });
  }
  return new PlaceMap(map, things);
}

/** The graticule, or streets; with a button that changes between them, if the server names tiles. */
function addGround(map, element, settings) {
  const lines = L.layerGroup().addTo(map);
  const drawLines = () => drawGraticule(map, lines);
  map.on("moveend resize", drawLines);
  if (map.getSize().x) drawLines();
  if (!settings.map_tiles) {
    addControl(map, h("p", { class: "map-note" }, "No streets: this server names no street map."));
    return;
  }
  const { origin } = new URL(settings.map_tiles, location.href);
  const tiles = L.tileLayer(settings.map_tiles, { attribution: escaped(settings.map_attribution), className: "streets", maxZoom: MOST_ZOOM, maxNativeZoom: 19 });
  // An operator who has named a tile server has decided for the visitors, who can hide the streets.
  const isChosen = origin === location.origin || settings.map_tiles_are_chosen;
  const allowed = () => localStorage.getItem(STREETS) === origin || (isChosen && localStorage.getItem(STREETS) !== HIDDEN);
  const toggle = h("button", { type: "button", class: "streets-button", "aria-pressed": "false" }, "Streets");
  const show = (shown) => {
    toggle.setAttribute("aria-pressed", String(shown));
    if (shown) {
      map.off("moveend resize", drawLines);
      lines.clearLayers();
      tiles.addTo(map);
    } else {
      tiles.remove();
      map.on("moveend resize", drawLines);
      if (map.getSize().x) drawLines();
    }
  };
  // A server that gives no tile at all leaves the graticule; where it lacks some, the others are shown.
  let given = false;
  tiles.on("tileload", () => (given = true));
  tiles.on("load", () => {
    if (given) return;
    show(false);
    note(`The streets can’t be loaded from ${new URL(origin).host}. The map shows latitude and longitude instead.`, "bad");
  });
  toggle.addEventListener("click", async () => {
    try {
      if (map.hasLayer(tiles)) {
        localStorage.setItem(STREETS, HIDDEN);
        show(false);
      } else if (isChosen || allowed() || await mayLoad(origin)) {
        localStorage.setItem(STREETS, origin);
        show(true);
      }
    } catch (error) {
      noteError(error);
    }
  });
  addControl(map, toggle);
  element.classList.add("has-streets");
  if (allowed()) show(true);
}

function addControl(map, element) {
  const control = L.control({ position: "topright" });
  control.onAdd = () => {
    L.DomEvent.disableClickPropagation(element);
    return element;
  };
  control.addTo(map);
}

/** Ask before the browser loads anything from another server. */
const mayLoad = (origin) => confirmed("Show streets?",
  `Your browser then loads the street map from ${new URL(origin).host}. That server sees your network address and which area you look at; it does not see your photos. Until you agree, this page loads nothing from other servers.`,
  "Load streets", { kind: "primary", otherwise: "Not now" });

class PlaceMap {
  constructor(map, things) {
    this.map = map;
    this.things = things;
    this.bounds = [];
  }

  clear() {
    this.things.clearLayers();
    this.bounds = [];
  }

  /** A photo's point. `kind` is a class of the style sheet. */
  point(latitude, longitude, { kind = "", text = "", radius = 6, onclick = null } = {}) {
    if (this.bounds.length >= POINTS_DRAWN) return null;
    const drawn = L.circleMarker([latitude, longitude], { radius, className: `point ${kind}` }).addTo(this.things);
    if (text) drawn.bindTooltip(escaped(text));
    if (onclick) drawn.on("click", onclick);
    this.bounds.push([latitude, longitude]);
    return drawn;
  }

  /** A point with its number, for the list beside the map. */
  numbered(latitude, longitude, number, text, onclick) {
    const icon = L.divIcon({ className: `number-pin ${number === 1 ? "first" : ""}`, html: String(number), iconSize: [24, 24] });
    L.marker([latitude, longitude], { icon, title: text, alt: text, zIndexOffset: -number }).on("click", onclick).addTo(this.things);
    this.bounds.push([latitude, longitude]);
  }

  /** A circle of so many metres. */
  circle(latitude, longitude, radiusM, kind) {
    const drawn = L.circle([latitude, longitude], { radius: radiusM, className: kind, interactive: false }).addTo(this.things);
    const box = L.latLng(latitude, longitude).toBounds(2 * radiusM);
    this.bounds.push(box.getSouthWest(), box.getNorthEast());
    return drawn;
  }

  /** A sector of so many metres around a direction, `half` degrees to both sides. */
  cone(latitude, longitude, heading, half, lengthM, kind) {
    const east = DEGREE_M * Math.cos((latitude * Math.PI) / 180);
    const rim = Array.from({ length: CONE_POINTS }, (_, index) => {
      const angle = ((heading + half * ((2 * index) / (CONE_POINTS - 1) - 1)) * Math.PI) / 180;
      return [latitude + (lengthM * Math.cos(angle)) / DEGREE_M, longitude + (lengthM * Math.sin(angle)) / east];
    });
    L.polygon([[latitude, longitude], ...rim], { className: kind, interactive: false }).addTo(this.things);
    this.bounds.push(...rim);
  }

  /** A line through points of latitude and longitude. */
  line(points, kind) {
    L.polyline(points, { className: kind, interactive: false }).addTo(this.things);
    this.bounds.push(...points);
  }

  /** Show all that was drawn. */
  fit() {
    this.map.invalidateSize({ pan: false });
    if (this.bounds.length) this.map.fitBounds(this.bounds, { padding: [36, 36], maxZoom: 19, animate: false });
  }
}

function escaped(text) {
  return text.replace(/[&<>"']/g, (letter) => `&#${letter.charCodeAt(0)};`);
}
