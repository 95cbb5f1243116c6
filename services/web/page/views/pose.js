// Where the camera of a photo stood and looked: in words, as a cone on the map, and the points that it saw.

import { h } from "../dom.js";
import { metres, plural } from "../format.js";
import { coordinateTools } from "../places.js";

const SVG = "http://www.w3.org/2000/svg";
const WINDS = ["N", "NNE", "NE", "ENE", "E", "ESE", "SE", "SSE", "S", "SSW", "SW", "WSW", "W", "WNW", "NW", "NNW"];
const CONE_M = 15; // length of a cone, unless the radius is larger
const RADII = 3; // of 95 %, that a cone is at least as long as

/** Position, radius and direction; null without a pose that has coordinates. */
export function poseInWords(pose) {
  if (pose?.radius_68_m == null) return null;
  const wind = WINDS[Math.round(pose.heading / 22.5) % WINDS.length];
  return [
    h("p", { class: "where pose" },
      `The camera stood at ${pose.latitude.toFixed(6)}, ${pose.longitude.toFixed(6)}`,
      h("span", { class: "radius" }, ` ± ${metres(pose.radius_68_m)} (68 %)`),
      ` and looked ${wind}, ${pose.heading.toFixed(0)}°`,
      h("span", { class: "radius" }, ` ± ${Math.max(1, Math.round(pose.heading_68_degrees))}°`)),
    coordinateTools(pose.latitude, pose.longitude),
  ];
}

/** The view of the camera as a cone, with the circles that contain the camera with 95 % and 68 %. */
export function drawPose(map, pose) {
  if (pose?.radius_68_m == null) return;
  const half = Math.atan(pose.camera.width / 2 / pose.camera.focal_pixels) * (180 / Math.PI);
  map.cone(pose.latitude, pose.longitude, pose.heading, half, Math.max(CONE_M, RADII * pose.radius_95_m), "pose-cone");
  map.circle(pose.latitude, pose.longitude, pose.radius_95_m, "pose-95");
  map.circle(pose.latitude, pose.longitude, pose.radius_68_m, "pose-68");
}

/** Dots over a picture of the photo that fills its frame, where it shows points of the map's model. */
export function seenPoints(pose) {
  if (!pose) return null;
  const { width, height } = pose.camera;
  const dots = document.createElementNS(SVG, "svg");
  const attributes = { class: "seen", viewBox: `0 0 ${width} ${height}`, preserveAspectRatio: "xMidYMid slice", role: "img", "aria-label": `${plural(pose.inliers, "point")} of the map’s model, seen in the photo` };
  Object.entries(attributes).forEach(([name, value]) => dots.setAttribute(name, value));
  dots.append(...pose.seen.map(({ query: [x, y] }) => {
    const dot = document.createElementNS(SVG, "circle");
    Object.entries({ cx: x, cy: y, r: Math.max(width, height) / 180 }).forEach(([name, value]) => dot.setAttribute(name, value));
    return dot;
  }));
  return dots;
}
