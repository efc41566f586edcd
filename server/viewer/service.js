// Requests to the service. A failure is an Error with a human-readable message.

const KEY = "scas4d.token";

export class ServiceError extends Error {
  constructor(problem) {
    const end = problem.detail.endsWith(".") ? "" : ".";
    super(capital(problem.detail + end + (problem.remedy ? ` To fix it: ${problem.remedy}.` : "")));
    this.status = problem.status;
  }
}

const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

export const token = {
  get: () => sessionStorage.getItem(KEY),
  set: (value) => sessionStorage.setItem(KEY, value),
  forget: () => sessionStorage.removeItem(KEY),
  /** Whether the token is read-only. */
  reads: () => sessionStorage.getItem(KEY)?.startsWith("scas4d.read.") ?? false,
  /** Whether the token grants access to one scene only; one for all scenes has a star in place of the scene. */
  readsOne: () => token.reads() && !sessionStorage.getItem(KEY).startsWith("scas4d.read.*."),
};

/** Sends a request and returns the response, of any media type. */
export async function fetched(method, path, body, signal) {
  const headers = {};
  if (token.get()) headers.Authorization = `Bearer ${token.get()}`;
  if (body !== undefined) headers["Content-Type"] = "application/json";
  let response;
  try {
    response = await fetch(address(path), { method, headers, signal, body: body === undefined ? undefined : JSON.stringify(body) });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new ServiceError({ status: 0, detail: "the service does not respond" });
  }
  if (response.ok) return response;
  const problem = await response.json().catch(() => null);
  throw new ServiceError(problem?.detail ? problem
    : { status: response.status, detail: `the service responded with ${response.status} ${response.statusText}` });
}

/** Sends a request and returns the JSON in the response, or null if there is none. */
export async function call(method, path, body) {
  const response = await fetched(method, path, body);
  return response.status === 204 ? null : response.json();
}

/** URL of a path of the service, whose root is the folder above this file's folder, also under a path prefix. */
export const address = (path) => new URL(`..${path}`, import.meta.url);

export const scenePath = (id) => `/v1/scenes/${encodeURIComponent(id)}`;

/** Subprotocol with a ticket for one WebSocket, since a browser cannot send a token with it; null if there is no token. */
export async function ticket() {
  if (!token.get()) return null;
  return (await call("POST", "/v1/tickets")).subprotocol;
}
