// Swagger UI on the server's own description.
const target = document.getElementById("description");
SwaggerUIBundle({
  url: target.dataset.url,
  domNode: target,
  deepLinking: true,
  validatorUrl: null, // otherwise the public validator would be called
  presets: [SwaggerUIBundle.presets.apis],
  layout: "BaseLayout",
});
