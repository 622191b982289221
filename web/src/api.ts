// What the service is asked. Every request of the page passes here, with the token where there is one.
import { Signal } from "./ui/signal";
import { texts } from "./texts";

const KEY = "semdb.token";

/** Something that the service, or the network, answered with instead. `detail` is for people. */
export class ApiError extends Error {
  constructor(
    readonly status: number,
    readonly detail: string,
    readonly requestId: string | null = null,
  ) {
    super(detail);
  }
}

/** The token of this tab, or null. Images need `load` where there is one. */
export const token = new Signal<string | null>(sessionStorage.getItem(KEY));
token.watch((value) => (value === null ? sessionStorage.removeItem(KEY) : sessionStorage.setItem(KEY, value)));

/** Set when the service answered 401: the page asks for a token. */
export const tokenNeeded = new Signal<string | null>(null);

export interface Ask {
  method?: string;
  body?: BodyInit | null;
  /** Sent as JSON. */
  json?: unknown;
  headers?: Record<string, string>;
  until?: AbortSignal | undefined;
}

/** Raises ApiError for whatever is no success, AbortError where it was given up. */
export async function ask(address: string, options: Ask = {}): Promise<Response> {
  const headers = new Headers(options.headers);
  const secret = token.get();
  if (secret !== null) headers.set("Authorization", `Bearer ${secret}`);
  let body = options.body ?? null;
  if (options.json !== undefined) {
    headers.set("Content-Type", "application/json");
    body = JSON.stringify(options.json);
  }
  let answer: Response;
  try {
    answer = await fetch(address, {
      method: options.method ?? "GET",
      headers,
      body,
      signal: options.until ?? null,
      credentials: "omit",
    });
  } catch (error) {
    if (error instanceof DOMException && error.name === "AbortError") throw error;
    throw new ApiError(0, texts.errors.unreachable);
  }
  if (answer.ok) return answer;
  const problem = await problemOf(answer);
  if (answer.status === 401) tokenNeeded.set(problem.detail);
  throw problem;
}

async function problemOf(answer: Response): Promise<ApiError> {
  try {
    const told = (await answer.json()) as { detail?: string; request_id?: string };
    return new ApiError(answer.status, told.detail ?? answer.statusText, told.request_id ?? null);
  } catch {
    return new ApiError(answer.status, answer.statusText || texts.errors.unknown(answer.status));
  }
}

export async function get<T>(address: string, until?: AbortSignal): Promise<T> {
  return (await (await ask(address, { until })).json()) as T;
}

export async function getBytes(address: string, until?: AbortSignal): Promise<ArrayBuffer> {
  return (await ask(address, { until })).arrayBuffer();
}

/** All pages of a list, or the first `most` items of it; `under` is what the answer calls them. */
export async function getAll<T>(address: string, until?: AbortSignal, most = Infinity, under = "items"): Promise<T[]> {
  const items: T[] = [];
  let next: string | null = address;
  while (next !== null && items.length < most) {
    const page: Record<string, unknown> = await get(next, until);
    for (const item of page[under] as T[]) items.push(item);
    next = page["next"] as string | null;
  }
  return items;
}

export function isAbort(error: unknown): boolean {
  return error instanceof DOMException && error.name === "AbortError";
}

/** Part of an address of the API: a name, with its slashes written %2F. */
export function part(name: string | number): string {
  return encodeURIComponent(String(name));
}

// pictures of keyframes stay in the cache of the browser for ever; another database may be at this address the next time
const LOADED = Date.now().toString(36);

/** Shows a picture of the API in `image`: through the tag itself, or by fetch where a token is to be sent. */
export function load(image: HTMLImageElement, place: string, until?: AbortSignal): void {
  const address = `${place}${place.includes("?") ? "&" : "?"}loaded=${LOADED}`;
  if (token.get() === null) {
    image.src = address;
    return;
  }
  ask(address, { until })
    .then((answer) => answer.blob())
    .then((blob) => {
      const url = URL.createObjectURL(blob);
      const done = (): void => URL.revokeObjectURL(url);
      image.addEventListener("load", done, { once: true });
      image.addEventListener("error", done, { once: true });
      image.src = url;
    })
    .catch(() => image.dispatchEvent(new Event("error")));
}
