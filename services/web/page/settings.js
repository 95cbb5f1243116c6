// Public settings of the server: map_tiles, map_attribution, max_file_size (bytes).

let read = null;

export function serverSettings() {
  read ??= fetch("/console/settings.json").then((response) => response.json());
  return read;
}
