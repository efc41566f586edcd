// Renders the API description with Swagger UI. Its validator is disabled, so nothing is requested from other sites.
"use strict";

const root = location.pathname.replace(/\/docs\/[^/]*$/, ""); // a proxy may serve the page under a path prefix

window.ui = SwaggerUIBundle({
  url: "../openapi.json",
  requestInterceptor: (request) => {
    const url = new URL(request.url, location.href);
    if (root && !url.pathname.startsWith(`${root}/`)) request.url = root + url.pathname + url.search;
    return request;
  },
  dom_id: "#reference",
  deepLinking: true,
  defaultModelsExpandDepth: 0,
  displayRequestDuration: true,
  persistAuthorization: false, // keeps the token only in memory
  validatorUrl: null,
});
