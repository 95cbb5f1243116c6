// Smaller copies of query photos, made before they are sent: a camera's photo has 5 to 50 MB.

const LONGER_SIDE = 2048; // pixels; preprocessing makes photos smaller than that
const QUALITY = 0.9;
const SENT_AS_IT_IS = 1_000_000; // bytes
// Preprocessings of published results, which ignore how EXIF turns a photo. A copy has been turned.
const AS_STORED = /preprocessing=(demo1024|paper480x640|round14)/;

/** A JPEG as a smaller, upright one without EXIF; any other file, and a small one, as it is. */
export async function shrinkPhoto(file, extractor) {
  if (file.type !== "image/jpeg" || file.size <= SENT_AS_IT_IS || AS_STORED.test(extractor)) return file;
  let picture;
  try {
    picture = await createImageBitmap(file);
  } catch {
    return file; // the server reports what is wrong with it
  }
  const scale = LONGER_SIDE / Math.max(picture.width, picture.height);
  if (scale >= 1) return file;
  const canvas = document.createElement("canvas");
  canvas.width = Math.round(picture.width * scale);
  canvas.height = Math.round(picture.height * scale);
  const context = canvas.getContext("2d");
  context.imageSmoothingQuality = "high";
  context.drawImage(picture, 0, 0, canvas.width, canvas.height);
  picture.close();
  const small = await new Promise((done) => canvas.toBlob(done, "image/jpeg", QUALITY));
  return small === null || small.size >= file.size ? file : new File([small], file.name, { type: "image/jpeg" });
}
