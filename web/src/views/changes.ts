// Two visits of a map compared: what appeared, disappeared and moved, with crops of both.
import { get, getAll, part } from "../api";
import { type Context, type Updatable, link, setQuery } from "../router";
import { texts } from "../texts";
import type { Vector3 } from "../types";
import { bdi, fill, h } from "../ui/h";
import { a, command, empty, show } from "../ui/parts";
import { mapHead } from "../ui/tabs";
import { TopMap } from "../ui/topmap";
import { metres, place as placeText } from "../ui/verdict";
import { sceneOfMap, thumbnail } from "./parts/evidence";

interface Visited {
  presence: string;
  keyframes: number;
  position: Vector3 | null;
  crop: { keyframe: number; frame_index: number; box: number[] } | null;
}

interface Change {
  kind: string;
  category: string;
  landmark: number;
  other_landmark: number | null;
  score: number;
  distance: number | null;
  before: Visited;
  after: Visited;
}

interface Changes {
  between: [string, string];
  counts: Record<string, number>;
  changes: Change[];
}

interface Recording {
  name: string;
  keyframes: number;
}

const KINDS = ["moved", "appeared", "disappeared"];
const MARKS: Record<string, "good" | "bad" | "accent"> = { appeared: "good", disappeared: "bad", moved: "accent" };

export function changes({ root, until, params, query }: Context): Updatable {
  const map = params["map"] ?? "";
  document.title = texts.title(`${texts.tabs.changes} · ${map}`);
  root.className = "page";
  const place = h("div");
  root.append(mapHead(map, "changes"), place);
  let ending = new AbortController();
  until.addEventListener("abort", () => ending.abort());
  const draw = (asked: URLSearchParams): void => {
    ending.abort();
    ending = new AbortController();
    const now = ending.signal;
    void show(place, now, () => compare(map, asked, now));
  };
  draw(query);
  return {
    update: (next, asked) => {
      if (next["map"] !== map) return false;
      draw(asked);
      return true;
    },
  };
}

async function compare(map: string, query: URLSearchParams, until: AbortSignal): Promise<HTMLElement> {
  const t = texts.changes;
  const recordings = (await getAll<Recording>(`/v1/recordings?map=${part(map)}`, until)).filter((one) => one.keyframes > 0);
  if (recordings.length < 2) return empty(t.tooFew, t.tooFewHint, [command(texts.map.emptyCommand(map))]);
  const before = query.get("before") ?? recordings.at(-2)?.name ?? "";
  const after = query.get("after") ?? recordings.at(-1)?.name ?? "";
  const choice = (name: "before" | "after", chosen: string, label: string): HTMLElement =>
    h("label", null, label, h("select", { attrs: { name }, on: { change: (event) => setQuery({ [name]: (event.target as HTMLSelectElement).value }, false) } }, recordings.map((one) => h("option", { attrs: { value: one.name, selected: one.name === chosen } }, one.name))));
  const result = h("div");
  const head = h("div", { class: "filters" }, choice("before", before, t.before), choice("after", after, t.after));
  void show(result, until, () => outcome(map, before, after, query, until));
  return h("div", { class: "stack" }, head, result);
}

async function outcome(map: string, before: string, after: string, query: URLSearchParams, until: AbortSignal): Promise<HTMLElement> {
  const t = texts.changes;
  if (before === after) return empty(t.same);
  const [found, scene] = await Promise.all([get<Changes>(`/v1/maps/${part(map)}/changes?${new URLSearchParams({ before, after })}`, until), sceneOfMap(map, until)]);
  const kind = query.get("kind");
  const shown = found.changes.filter((one) => kind === null || one.kind === kind);
  shown.sort((one, other) => KINDS.indexOf(one.kind) - KINDS.indexOf(other.kind) || (other.distance ?? 0) - (one.distance ?? 0) || other.score - one.score);
  const plan = new TopMap(scene);
  const spot = (one: Change): Vector3 | null => one.after.position ?? one.before.position;
  plan.show(
    [],
    shown.flatMap((one) => (one.kind === "moved" && one.before.position && one.after.position ? [{ from: one.before.position, to: one.after.position }] : [])),
    shown.flatMap((one) => {
      const position = spot(one);
      return position ? [{ position, kind: MARKS[one.kind] ?? "accent", label: one.category }] : [];
    }),
  );
  const chip = (name: string | null, text: string, count: number): HTMLElement => {
    const made = h("button", { class: `chip ${name ? (MARKS[name] ?? "") : ""}`, attrs: { type: "button", "aria-pressed": String(kind === name) }, on: { click: () => setQuery({ kind: name }) } }, text, h("b", null, ` ${count}`));
    return made;
  };
  const cards = h("ul", { class: "change-cards" });
  fill(cards, shown.map((one) => card(map, one, found.between)));
  return h(
    "div",
    { class: "stack" },
    h("div", { class: "row", attrs: { role: "group", "aria-label": t.kinds } }, chip(null, t.all, found.changes.length), KINDS.map((name) => chip(name, t.names[name] ?? name, found.counts[name] ?? 0)), h("span", { class: "faint" }, t.rest(found.counts["in_both"] ?? 0, found.counts["not_looked_at"] ?? 0))),
    shown.length === 0 ? empty(t.none, t.noneHint) : h("div", { class: "changes" }, plan.element, cards),
  );
}

function card(map: string, one: Change, between: [string, string]): HTMLElement {
  const t = texts.changes;
  const side = (visited: Visited, recording: string): HTMLElement =>
    h(
      "figure",
      null,
      visited.crop ? a(link(["maps", map, "keyframes", visited.crop.keyframe]), null, thumbnail(visited.crop.keyframe, t.crop(one.category, recording), 240, grown(visited.crop.box))) : h("div", { class: "no-crop" }, t.presence[visited.presence] ?? visited.presence),
      h("figcaption", null, bdi(recording)),
    );
  const told = one.kind === "moved" && one.distance !== null ? t.movedBy(metres(one.distance)) : (t.names[one.kind] ?? one.kind);
  return h(
    "li",
    { class: `change ${MARKS[one.kind] ?? ""}` },
    h("header", null, h("span", { class: "tag" }, told), a(link(["maps", map, "landmarks", one.landmark]), null, bdi(one.category), ` ${one.landmark}`), one.other_landmark !== null && one.other_landmark !== undefined && [t.now, a(link(["maps", map, "landmarks", one.other_landmark]), null, String(one.other_landmark))]),
    h("div", { class: "sides" }, side(one.before, between[0]), side(one.after, between[1])),
    h("p", { class: "faint" }, t.at(placeText(one.after.position ?? one.before.position), one.score.toFixed(2))),
  );
}

/** A box with room about it. */
function grown(box: readonly number[]): number[] {
  const [x1 = 0, y1 = 0, x2 = 0, y2 = 0] = box;
  const room = Math.max(x2 - x1, y2 - y1, 16) / 2;
  return [x1 - room, y1 - room, x2 + room, y2 + room];
}
