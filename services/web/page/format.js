// Figures as people read them.

export const count = (number) => number.toLocaleString("en");
export const plural = (number, noun) => `${count(number)} ${noun}${number === 1 ? "" : "s"}`;
export const percent = (share) => (share === null || share === undefined ? "–" : `${(100 * share).toFixed(1)} %`);
export const score = (cosine) => cosine.toFixed(3);

const STRENGTHS = [[0.8, "strong"], [0.3, "fair"], [0, "weak"]];

/** A match in one word, by the probability that it shows the same place; null where none is known. */
export const strength = (probability) => (probability === null ? null : STRENGTHS.find(([least]) => probability >= least)[1]);

/** A photo's name, with its folders if it was uploaded with them. */
export const nameOf = (photo) => photo.relative_path ?? photo.original_filename;

/** The folders of a photo that was uploaded with them, else "". */
export const folderOf = (photo) => photo.relative_path?.split("/").slice(0, -1).join("/") ?? "";

/** The day of a photo, whose clock may have had another zone: as it is stored. */
export const day = (text) => new Date(text).toLocaleDateString("en-GB", { timeZone: "UTC", day: "numeric", month: "long", year: "numeric" });

export function bytes(number) {
  const units = ["B", "kB", "MB", "GB", "TB"];
  const power = number < 1000 ? 0 : Math.min(units.length - 1, Math.floor(Math.log10(number) / 3));
  return `${(number / 1000 ** power).toFixed(power && number / 1000 ** power < 100 ? 1 : 0)} ${units[power]}`;
}

/** A length, short: 0.4 m, 25 m, 2 km, 1.5 km. */
export const metres = (length) => (length < 9.95 ? `${Number(length.toFixed(1))} m` : length < 999.5 ? `${Math.round(length)} m` : `${Number((length / 1000).toFixed(1))} km`);

/** Degrees to the decimetre or so. */
export const degrees = (latitude, longitude) => `${latitude.toFixed(5)}, ${longitude.toFixed(5)}`;

/** Local time, short. */
export function when(text) {
  return new Date(text).toLocaleString("en-GB", { year: "numeric", month: "short", day: "numeric", hour: "2-digit", minute: "2-digit" });
}

/** How long ago, or the date after a week. */
export function ago(text) {
  const seconds = (Date.now() - new Date(text)) / 1000;
  if (seconds < 45) return "just now";
  if (seconds < 5400) return `${Math.max(1, Math.round(seconds / 60))} min ago`;
  if (seconds < 129600) return `${Math.round(seconds / 3600)} h ago`;
  if (seconds < 604800) return `${Math.round(seconds / 86400)} days ago`;
  return new Date(text).toLocaleDateString("en-GB", { year: "numeric", month: "short", day: "numeric" });
}

export function duration(seconds) {
  if (seconds < 90) return `${Math.round(seconds)} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  return seconds < 129600 ? `${Math.round(seconds / 3600)} h` : `${Math.round(seconds / 86400)} days`;
}

/** The place and the coordinates of a photo. */
export function whereabouts(photo) {
  const place = photo.place ? [photo.place] : [];
  if (photo.latitude !== null) place.push(degrees(photo.latitude, photo.longitude));
  return place.join(" · ") || "no coordinates or label";
}
