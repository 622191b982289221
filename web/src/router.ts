// One address for each state: a path says what is looked at, ?name=value how.

export interface Route {
  /** Segments; one that begins with a colon is a parameter: ["maps", ":map", "queries"]. */
  path: readonly string[];
  /** Other paths that are the same view. */
  also?: readonly (readonly string[])[];
  load: () => Promise<View>;
}

/** What a view is given. It ends when `until` is aborted: another view comes. */
export interface Context {
  params: Readonly<Record<string, string>>;
  query: URLSearchParams;
  until: AbortSignal;
  /** Where the view puts itself. */
  root: HTMLElement;
}

/** Shows itself in `root`. It may return what takes a new query or parameters without building the view anew. */
export type View = (context: Context) => void | Promise<void> | Updatable | Promise<Updatable>;

export interface Updatable {
  /** The address changed to another one of the same route: true where the view followed. */
  update: (params: Readonly<Record<string, string>>, query: URLSearchParams) => boolean;
}

export interface Matched {
  route: Route;
  params: Record<string, string>;
}

export function match(routes: readonly Route[], path: string): Matched | null {
  let parts: string[];
  try {
    parts = path.split("/").filter((part) => part !== "").map(decodeURIComponent);
  } catch {
    return null;
  }
  const spelled = routes.flatMap((route) => [route.path, ...(route.also ?? [])].map((path) => ({ route, path })));
  for (const { route, path: segments } of spelled) {
    if (segments.length !== parts.length) continue;
    const params: Record<string, string> = {};
    const fits = segments.every((segment, index) => {
      const part = parts[index] ?? "";
      if (!segment.startsWith(":")) return segment === part;
      params[segment.slice(1)] = part;
      return true;
    });
    if (fits) return { route, params };
  }
  return null;
}

/** An address: `link(["maps", name], { q: "cup" })`. Values that are null are left out. */
export function link(path: readonly (string | number)[], query: Record<string, string | number | null | undefined> = {}): string {
  const given = Object.entries(query).filter((entry): entry is [string, string | number] => entry[1] != null && entry[1] !== "");
  const search = new URLSearchParams(given.map(([key, value]) => [key, String(value)])).toString();
  return `/${path.map((part) => encodeURIComponent(String(part))).join("/")}${search ? `?${search}` : ""}`;
}

/** Goes to an address of this page. `replace`: without a step to go back to. */
export function go(address: string, replace = false): void {
  if (address === location.pathname + location.search) return;
  if (replace) history.replaceState(null, "", address);
  else history.pushState(null, "", address);
  dispatchEvent(new Event("semdb:address"));
}

/** Changes some of ?name=value and leaves the path. */
export function setQuery(change: Record<string, string | number | null | undefined>, replace = true): void {
  const query = new URLSearchParams(location.search);
  for (const [key, value] of Object.entries(change)) {
    if (value === null || value === undefined || value === "") query.delete(key);
    else query.set(key, String(value));
  }
  const search = query.toString();
  go(location.pathname + (search ? `?${search}` : ""), replace);
}
