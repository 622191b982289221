// A thing: what it looks like, how sure it is, what it stands near, where it was when.
import { get, getAll, load, part } from "../../api";
import { type LandmarkItem, css, hueColour } from "../../model";
import { link } from "../../router";
import { eigen3 } from "../../statistics";
import { texts } from "../../texts";
import type { LandmarkInfo, Relation, Sighting, Vector3 } from "../../types";
import { type Child, bdi, h, fill } from "../../ui/h";
import { a, button, show } from "../../ui/parts";
import { theme } from "../../ui/theme";
import type { MapContext } from "../map";
import { facts, metres, when } from "./facts";

interface Visit {
  recording: string;
  presence: "present" | "absent" | "unobserved";
  keyframes: number;
  seen: number;
  seen_through: number;
  position: Vector3 | null;
}

interface History {
  sightings: Sighting[];
  visits: Visit[];
}

const CROPS = 12;

export function showLandmark(context: MapContext, item: LandmarkItem, place: HTMLElement): void {
  const address = `/v1/maps/${part(context.name)}/landmarks/${item.id}`;
  const { until } = context;
  const history = historyOf(`${address}/sightings`, until);
  history.catch(() => undefined);
  const about = get<LandmarkInfo>(address, until);
  about.catch(() => undefined);
  history
    .then(({ sightings: all }) => {
      const from = [...new Set(all.map((one) => one.keyframe))].map((id) => context.scene.keyframe(id)).filter((one) => one !== undefined);
      if (!until.aborted) context.viewer()?.highlight(from, [item]);
    })
    .catch(() => undefined);
  const mark = h("span", { class: "dot big" });
  mark.style.background = css(hueColour(item.categoryIndex, theme.get() === "dark"));
  const section = (title: string, make: () => Promise<Child>): HTMLElement => {
    const body = h("div");
    void show(body, until, make);
    return h("section", null, h("h3", null, title), body);
  };
  const state = item.state === "confirmed" ? texts.map.confirmed : item.state === "gone" ? texts.map.gone : texts.map.tentative;
  fill(
    place,
    h("h2", null, mark, " ", bdi(item.category), " ", h("span", { class: `tag ${item.state === "confirmed" ? "good" : item.state === "gone" ? "bad" : "warn"}` }, state)),
    h("p", { class: "faint" }, texts.landmark.sure(Math.round(100 * item.probability)), " · ", texts.map.seenBy(item.keyframes)),
    section(texts.landmark.crops, async () => crops(context, best((await history).sightings))),
    h("div", { class: "row" }, button(texts.landmark.fly, () => context.viewer()?.flyToLandmark(item)), a(link(["sql"], { q: statement(item.id) }), { class: "button" }, texts.landmark.sql)),
    facts([
      [texts.map.place, metres(item.position)],
      [texts.landmark.size, `${item.size.map((value) => value.toFixed(2)).join(" × ")} m`],
      [texts.landmark.sigma, `±${(100 * Math.sqrt(Math.max(...eigen3(item.covariance)))).toFixed(1)} cm`],
      [texts.landmark.last, when(item.lastSeenNs)],
    ]),
    section(texts.landmark.others, async () => classes((await about).classes)),
    section(texts.landmark.relations, async () => relations(context, item, (await about).relations)),
    section(texts.landmark.visits, async () => visits((await history).visits)),
    section(texts.landmark.sightings, async () => sightings(context, (await history).sightings)),
  );
}

/** With all pages of sightings: the clearest may be on any of them. */
async function historyOf(address: string, until: AbortSignal): Promise<History> {
  const first = await get<History & { next: string | null }>(address, until);
  const others = first.next === null ? [] : await getAll<Sighting>(first.next, until, Infinity, "sightings");
  return { visits: first.visits, sightings: [...first.sightings, ...others] };
}

function statement(id: number): string {
  return `SELECT o.keyframe_id, o.score, s.coverage, s.visibility FROM landmark_sightings s JOIN objects o ON o.id = s.object_id WHERE s.landmark_id = ${id} ORDER BY s.coverage * s.visibility DESC`;
}

/** The clearest views, the best first. */
function best(found: readonly Sighting[]): Sighting[] {
  const area = ({ box: [x1, y1, x2, y2] }: Sighting): number => (x2 - x1) * (y2 - y1);
  const worth = (one: Sighting): number => one.visibility * one.coverage * one.score * Math.sqrt(area(one));
  return [...found].sort((one, two) => worth(two) - worth(one)).slice(0, CROPS);
}

function crops(context: MapContext, found: readonly Sighting[]): Child {
  return h(
    "ul",
    { class: "crops" },
    found.map((one) => {
      const [x1, y1, x2, y2] = one.box;
      const margin = 0.12 * Math.max(x2 - x1, y2 - y1);
      const box = [x1 - margin, y1 - margin, x2 + margin, y2 + margin].map(Math.round).join(",");
      const image = h("img", { attrs: { alt: texts.landmark.crop(one.recording, one.frame_index), loading: "lazy" } });
      load(image, `/v1/keyframes/${one.keyframe}/image?width=240&box=${box}`, context.until);
      return h("li", null, a(link(["maps", context.name, "keyframes", one.keyframe]), { title: texts.landmark.crop(one.recording, one.frame_index) }, image));
    }),
  );
}

function classes(found: Record<string, number>): Child {
  const rows = Object.entries(found)
    .filter(([, value]) => value >= 0.01)
    .sort(([, one], [, two]) => two - one);
  const most = Math.max(...rows.map(([, value]) => value), 1e-9);
  return h(
    "ul",
    { class: "bars" },
    rows.slice(0, 5).map(([name, value]) => {
      const bar = h("span", { class: "bar" });
      bar.style.width = `${Math.round((100 * value) / most)}%`;
      return h("li", null, h("span", { class: "bar-name" }, bdi(name)), h("span", { class: "bar-place" }, bar));
    }),
  );
}

function relations(context: MapContext, item: LandmarkItem, found: readonly Relation[]): Child {
  const mine = found.filter((one) => one.landmark === item.id).sort((one, two) => two.score - one.score);
  if (mine.length === 0) return h("p", { class: "faint" }, texts.landmark.noRelations);
  return h(
    "ul",
    { class: "row-list" },
    mine.slice(0, 12).map((one) => {
      const other = context.scene.landmark(one.other_landmark);
      const name = other ? other.category : String(one.other_landmark);
      return h(
        "li",
        null,
        h("span", { class: "faint" }, texts.landmark.kinds[one.kind] ?? one.kind),
        h("span", { class: "grow" }, a(link(["maps", context.name, "landmarks", one.other_landmark]), null, bdi(name))),
        h("span", { class: "faint small" }, texts.landmark.relationScore(one.score)),
      );
    }),
    mine.length > 12 && h("li", { class: "faint" }, texts.landmark.more(mine.length - 12)),
  );
}

function visits(found: readonly Visit[]): Child {
  if (found.length === 0) return h("p", { class: "faint" }, texts.landmark.noVisits);
  return h(
    "ul",
    { class: "row-list" },
    found.map((one) =>
      h(
        "li",
        null,
        h("span", { class: `tag ${one.presence === "present" ? "good" : one.presence === "absent" ? "bad" : ""}` }, texts.landmark.presence[one.presence]),
        h("span", { class: "grow ellipsis" }, bdi(one.recording)),
        h("span", { class: "faint small" }, one.position ? metres(one.position) : ""),
      ),
    ),
  );
}

function sightings(context: MapContext, found: readonly Sighting[]): Child {
  const shown = found.slice(0, 40);
  return h(
    "ul",
    { class: "row-list" },
    shown.map((one) =>
      h(
        "li",
        null,
        h("span", { class: "grow ellipsis" }, a(link(["maps", context.name, "keyframes", one.keyframe]), null, bdi(`${one.recording} · ${texts.map.frame(one.frame_index)}`))),
        h("span", { class: "faint small" }, bdi(one.category), ` ${Math.round(100 * one.score)} %`),
      ),
    ),
    found.length > shown.length && h("li", { class: "faint" }, texts.landmark.more(found.length - shown.length)),
  );
}
