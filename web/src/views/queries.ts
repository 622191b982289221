// The log of what was localized: a list with filters, and one of them in detail.
import { get, part } from "../api";
import { type Context, type Updatable, go, link, setQuery } from "../router";
import { texts } from "../texts";
import type { LoggedQuery } from "../types";
import { bdi, fill, h } from "../ui/h";
import { key } from "../ui/keys";
import { a, button, empty, failed, loading, show } from "../ui/parts";
import { mapHead } from "../ui/tabs";
import { moment, verdictTag, verdictWords } from "../ui/verdict";
import { candidatesTable, matchedOf, poseFacts, sceneOfMap } from "./parts/evidence";
import { type Placed, Space } from "./parts/space";

const FILTERS = ["verdict", "text", "since", "until", "keyframe"] as const;
const VERDICTS = ["localized", "ambiguous", "coarse", "failed"];

interface Page {
  items: LoggedQuery[];
  next: string | null;
}

export function queries({ root, until, params, query }: Context): Updatable {
  const map = params["map"] ?? "";
  document.title = texts.title(`${texts.tabs.queries} · ${map}`);
  root.className = "page";
  const list = h("div");
  const form = filters(query);
  root.append(mapHead(map, "queries"), form, list);
  key("/", () => form.querySelector<HTMLInputElement>("[name=text]")?.focus(), until);
  let asking = new AbortController();
  until.addEventListener("abort", () => asking.abort());
  const ask = (chosen: URLSearchParams): void => {
    asking.abort();
    asking = new AbortController();
    const now = asking.signal;
    void show(list, now, async () => table(map, await get<Page>(addressOf(map, chosen), now), chosen, now));
  };
  ask(query);
  return {
    update: (next, chosen) => {
      if (next["map"] !== map) return false;
      ask(chosen);
      return true;
    },
  };
}

function addressOf(map: string, query: URLSearchParams): string {
  const asked = new URLSearchParams({ limit: "100" });
  for (const name of FILTERS) {
    const value = query.get(name);
    if (value) asked.set(name, name === "until" && /^\d{4}-\d\d-\d\d$/.test(value) ? `${value}T23:59:59.999` : value);
  }
  return `/v1/maps/${part(map)}/queries?${asked}`;
}

function filters(query: URLSearchParams): HTMLFormElement {
  const t = texts.queries;
  const change = (name: string) => (event: Event) => setQuery({ [name]: (event.target as HTMLInputElement).value });
  const field = (name: string, label: string, type: string): HTMLElement =>
    h("label", null, label, h("input", { attrs: { name, type, value: query.get(name) ?? "" }, on: { change: change(name) } }));
  const verdict = h(
    "select",
    { attrs: { name: "verdict" }, on: { change: change("verdict") } },
    h("option", { attrs: { value: "" } }, t.anyVerdict),
    VERDICTS.map((name) => h("option", { attrs: { value: name, selected: name === query.get("verdict") } }, texts.verdicts.names[name])),
  );
  return h(
    "form",
    { class: "filters", attrs: { role: "search" }, on: { submit: (event) => event.preventDefault() } },
    field("text", t.text, "search"),
    h("label", null, t.verdict, verdict),
    field("since", t.since, "date"),
    field("until", t.until, "date"),
    field("keyframe", t.keyframe, "number"),
    button(t.clear, () => {
      for (const input of document.querySelectorAll<HTMLInputElement | HTMLSelectElement>(".filters input, .filters select")) input.value = "";
      setQuery(Object.fromEntries(FILTERS.map((name) => [name, null])));
    }),
  );
}

function table(map: string, page: Page, chosen: URLSearchParams, until: AbortSignal): HTMLElement {
  const t = texts.queries;
  if (page.items.length === 0) {
    if (FILTERS.some((name) => chosen.get(name))) return empty(t.noneSuch, t.noneSuchHint);
    return empty(t.none, [t.noneHint, " ", a(link(["maps", map, "locate"]), null, texts.tabs.locate)]);
  }
  const body = h("tbody");
  const more = h("div", { class: "row" });
  const add = (found: Page): void => {
    body.append(...found.items.map((one) => row(map, one)));
    fill(more, found.next !== null && button(t.more, () => void next(found.next ?? "")));
  };
  const next = async (address: string): Promise<void> => {
    fill(more, loading());
    try {
      add(await get<Page>(address, until));
    } catch (error) {
      if (!until.aborted) fill(more, failed(error, () => void next(address)));
    }
  };
  add(page);
  const heads = [t.when, t.image, t.verdict, t.confidence, t.inliers, t.reason];
  return h(
    "div",
    { class: "stack" },
    h("div", { class: "table-wrap", attrs: { tabindex: 0, role: "region", "aria-label": texts.tabs.queries } },
      h("table", { class: "data" }, h("thead", null, h("tr", null, heads.map((text, k) => h("th", { class: k === 3 || k === 4 ? "number" : "", attrs: { scope: "col" } }, text)))), body)),
    more,
  );
}

function row(map: string, one: LoggedQuery): HTMLElement {
  return h(
    "tr",
    null,
    h("td", { class: "nowrap" }, a(link(["maps", map, "queries", one.id]), null, moment(one.created_at))),
    h("td", null, bdi(one.image)),
    h("td", null, verdictTag(one.verdict)),
    h("td", { class: "number" }, one.pose === null ? "–" : one.confidence.toFixed(2)),
    h("td", { class: "number" }, one.inliers),
    h("td", { attrs: { dir: "auto" } }, one.reason),
  );
}

/** One localization of the log. */
export function query({ root, until, params }: Context): Updatable {
  const map = params["map"] ?? "";
  const id = params["query"] ?? "";
  document.title = texts.title(texts.queries.one(id));
  root.className = "page";
  const place = h("div");
  let space: Space | null = null;
  root.append(mapHead(map, "queries"), place);
  void show(place, until, async () => {
    const found = await get<LoggedQuery & { map: string }>(`/v1/queries/${part(id)}`, until);
    if (found.map !== map) go(link(["maps", found.map, "queries", id]), true); // its places are of that map
    const scene = await sceneOfMap(found.map, until);
    const matched = matchedOf(scene, found.candidates);
    const own: Placed | null = found.pose && { pose: found.pose, verdict: found.verdict, by: matched.slice(0, 3) };
    space = new Space(scene, until);
    space.show(own ? [own] : [], matched);
    if (own) space.flyTo(own);
    return h(
      "div",
      { class: "stack" },
      h("p", null, a(link(["maps", map, "queries"]), null, texts.queries.back)),
      h("h2", null, bdi(found.image), " ", verdictTag(found.verdict)),
      h("p", null, verdictWords(found.verdict)),
      h("p", { attrs: { dir: "auto" } }, found.reason),
      h("div", { class: "answer" }, space.element, h("div", { class: "stack" }, poseFacts(found.pose, null, found.confidence, found.inliers), h("p", { class: "faint" }, `${moment(found.created_at)} · ${texts.queries.notKept}`), timing(found.timing_ms))),
      candidatesTable(map, found.candidates),
    );
  });
  return {
    update: (next, chosen) => {
      if (next["map"] !== map || next["query"] !== id) return false;
      space?.follow(chosen);
      return true;
    },
  };
}

function timing(found: Record<string, number | null>): HTMLElement {
  const parts = Object.entries(found).filter((entry): entry is [string, number] => entry[1] !== null);
  return h("details", null, h("summary", null, texts.queries.timing((found["total"] ?? 0).toFixed(0))), h("ul", { class: "plain" }, parts.map(([name, ms]) => h("li", null, `${name}: ${ms.toFixed(1)} ms`))));
}
