// ReDoc on the server's own description, in fonts that the machine has.
const target = document.getElementById("description");
const fontFamily = "system-ui, sans-serif";
Redoc.init(
  target.dataset.url,
  { theme: { typography: { fontFamily, headings: { fontFamily } } } },
  target,
);
