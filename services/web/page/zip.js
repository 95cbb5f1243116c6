// Zips, read by slices where the browser has them: APPNOTE.TXT, 4.3.

const END = { signature: 0x06054b50, bytes: 22 };
const ENTRY = { signature: 0x02014b50, bytes: 46 };
const MEMBER = { signature: 0x04034b50, bytes: 30 };
const MAX_COMMENT = 0xffff;
const ENCRYPTED = 1;
const STORED = 0;
const DEFLATED = 8;

/** An Error that names the zip and says what to do. */
const unreadable = (zip, reason) => new Error(`${zip.name} ${reason}. Unpack it and add the folder.`);

const view = async (zip, begin, end) => new DataView(await zip.slice(begin, end).arrayBuffer());

/** The files of a zip as [{path, size, read}], where `read` resolves to a Blob. */
export async function readZip(zip) {
  try {
    return await listFiles(zip);
  } catch (error) {
    throw error instanceof RangeError ? unreadable(zip, "is damaged") : error;
  }
}

async function listFiles(zip) {
  const tail = await view(zip, Math.max(0, zip.size - END.bytes - MAX_COMMENT), zip.size);
  let end = tail.byteLength - END.bytes;
  while (tail.getUint32(end, true) !== END.signature) end -= 1; // a RangeError before the begin
  const count = tail.getUint16(end + 10, true);
  const size = tail.getUint32(end + 12, true);
  const begin = tail.getUint32(end + 16, true);
  if (count === 0xffff || size === 0xffffffff || begin === 0xffffffff) throw unreadable(zip, "is too large to be read here");
  const directory = await view(zip, begin, begin + size);
  const files = [];
  for (let at = 0, number = 0; number < count; number++) {
    if (directory.getUint32(at, true) !== ENTRY.signature) throw unreadable(zip, "is damaged");
    const length = directory.getUint16(at + 28, true);
    const path = new TextDecoder().decode(new Uint8Array(directory.buffer, at + ENTRY.bytes, length));
    const entry = {
      encrypted: directory.getUint16(at + 8, true) & ENCRYPTED,
      method: directory.getUint16(at + 10, true),
      packed: directory.getUint32(at + 20, true),
      size: directory.getUint32(at + 24, true),
      begin: directory.getUint32(at + 42, true),
    };
    if (!path.endsWith("/")) files.push({ path, size: entry.size, read: () => readMember(zip, path, entry) });
    at += ENTRY.bytes + length + directory.getUint16(at + 30, true) + directory.getUint16(at + 32, true);
  }
  return files;
}

async function readMember(zip, path, { encrypted, method, packed, size, begin }) {
  try {
    if (encrypted || (method !== STORED && method !== DEFLATED)) throw new Error();
    const header = await view(zip, begin, begin + MEMBER.bytes);
    if (header.getUint32(0, true) !== MEMBER.signature) throw new Error();
    const data = begin + MEMBER.bytes + header.getUint16(26, true) + header.getUint16(28, true);
    const bytes = zip.slice(data, data + packed);
    const blob = method === STORED ? bytes : await new Response(bytes.stream().pipeThrough(new DecompressionStream("deflate-raw"))).blob();
    if (blob.size !== size) throw new Error();
    return blob;
  } catch {
    throw unreadable(zip, `has a photo that can't be read, ${path}`);
  }
}
