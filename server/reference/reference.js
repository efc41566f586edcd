// Draws the description of the API with Swagger UI. Nothing is asked of another site: its validator is off.
"use strict";

window.ui = SwaggerUIBundle({
  url: "/openapi.json",
  dom_id: "#reference",
  deepLinking: true,
  defaultModelsExpandDepth: 0,
  displayRequestDuration: true,
  persistAuthorization: false, // a token stays in the page's memory
  validatorUrl: null,
});
