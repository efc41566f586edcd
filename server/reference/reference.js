// Renders the API description with Swagger UI. Its validator is disabled, so nothing is requested from other sites.
"use strict";

window.ui = SwaggerUIBundle({
  url: "/openapi.json",
  dom_id: "#reference",
  deepLinking: true,
  defaultModelsExpandDepth: 0,
  displayRequestDuration: true,
  persistAuthorization: false, // keeps the token only in memory
  validatorUrl: null,
});
