// A keyframe: its image with what is seen in it, what is near it, what it was good for.
import { get, load, part, token } from "../../api";
import { type KeyframeItem, css, distance, dot, hueColour } from "../../model";
import { link, setQuery } from "../../router";
import { texts } from "../../texts";
import type { KeypointColumns, LoggedQuery, RunLengths, SeenObject, Sighting } from "../../types";
import { type Child, bdi, fill, h } from "../../ui/h";
import { a, button, save, show } from "../../ui/parts";
import { theme } from "../../ui/theme";
import type { MapContext } from "../map";
import { facts, metres, when } from "./facts";

export function showKeyframe(context: MapContext, item: KeyframeItem, place: HTMLElement): void {
  const { until } = context;
  const objects = get<{ objects: SeenObject[] }>(`/v1/keyframes/${item.id}/objects?masks=true`, until);
  const landmarks = get<{ sightings: Sighting[] }>(`/v1/keyframes/${item.id}/landmarks`, until);
  objects.catch(() => undefined);
  landmarks.catch(() => undefined);
  const seen = h("div");
  const used = h("div");
  const keypoints = h("p", { class: "faint small" });
  fill(
    place,
    h("h2", null, texts.keyframe.title(item.id)),
    picture(context, item, objects, keypoints),
    h("div", { class: "row" }, button(texts.keyframe.lookHere, () => context.viewer()?.flyToKeyframe(item))),
    facts([
      [texts.map.recording, bdi(item.recording)],
      [texts.map.frame(item.frameIndex), when(item.timestampNs)],
      [texts.map.place, metres(item.position)],
    ]),
    keypoints,
    h("h3", null, texts.keyframe.objects),
    seen,
    h("h3", null, texts.keyframe.neighbours),
    neighbours(context, item),
    h("h3", null, texts.keyframe.used),
    used,
    h("h3", null, texts.keyframe.files),
    h(
      "p",
      { class: "row" },
      token.get() === null
        ? h("a", { attrs: { href: `/v1/keyframes/${item.id}/image`, target: "_blank", rel: "noopener" } }, texts.keyframe.original)
        : button(texts.keyframe.original, () => void save(`/v1/keyframes/${item.id}/image`, `keyframe-${item.id}`, until)),
      a(link(["sql"], { q: `SELECT category, score, x1, y1, x2, y2 FROM keyframe_objects WHERE keyframe_id = ${item.id}` }), null, texts.keyframe.sql),
    ),
  );
  void show(seen, until, async () => seenList(context, (await objects).objects, (await landmarks).sightings));
  void show(used, until, async () => usedList(context.name, item, (await get<{ items: LoggedQuery[] }>(`/v1/maps/${part(context.name)}/queries?keyframe=${item.id}&limit=20`, until)).items));
}

/** The image with masks and keypoints over it, each to be switched. */
function picture(context: MapContext, item: KeyframeItem, objects: Promise<{ objects: SeenObject[] }>, told: HTMLElement): HTMLElement {
  const { width, height } = item.camera;
  const image = h("img", { attrs: { alt: texts.keyframe.image, width, height, dir: "auto" } });
  load(image, `/v1/keyframes/${item.id}/image`, context.until);
  const masks = h("canvas", { class: "overlay", attrs: { width, height, "aria-hidden": "true" } });
  const points = h("canvas", { class: "overlay", attrs: { width, height, hidden: true, "aria-hidden": "true" } });
  objects.then((found) => drawMasks(masks, found.objects)).catch(() => undefined);
  let asked = false;
  const showPoints = (on: boolean): void => {
    points.hidden = !on;
    if (!on || asked) return;
    asked = true;
    get<KeypointColumns>(`/v1/keyframes/${item.id}/keypoints`, context.until)
      .then((found) => {
        drawKeypoints(points, found);
        const placed = found.points.filter((point) => point[0] !== null).length;
        fill(told, texts.keyframe.keypointCount(found.x.length, placed));
      })
      .catch(() => (asked = false));
  };
  const tick = (label: string, on: boolean, act: (on: boolean) => void): HTMLElement =>
    h("label", { class: "inline" }, h("input", { attrs: { type: "checkbox", checked: on }, on: { change: (event) => act((event.target as HTMLInputElement).checked) } }), label);
  // what is marked is part of the address: objects, unless it says otherwise
  const marks = new Set((new URLSearchParams(location.search).get("marks") ?? "objects").split(","));
  const mark = (name: string, on: boolean): void => {
    if (on) marks.add(name);
    else marks.delete(name);
    const names = [...marks].filter((one) => one === "objects" || one === "keypoints").sort();
    setQuery({ marks: names.join() === "objects" ? null : names.join() || "none" });
  };
  masks.hidden = !marks.has("objects");
  showPoints(marks.has("keypoints"));
  return h(
    "figure",
    { class: "keyframe-picture" },
    h("div", { class: "layers-of-picture" }, image, masks, points),
    h("figcaption", { class: "row small" }, tick(texts.keyframe.masks, marks.has("objects"), (on) => {
      masks.hidden = !on;
      mark("objects", on);
    }), tick(texts.keyframe.points, marks.has("keypoints"), (on) => {
      showPoints(on);
      mark("keypoints", on);
    })),
  );
}

export function drawMasks(canvas: HTMLCanvasElement, objects: readonly SeenObject[]): void {
  const pen = canvas.getContext("2d");
  if (!pen) return;
  const { width, height } = canvas;
  const pixels = pen.createImageData(width, height);
  objects.forEach((thing, index) => {
    if (thing.mask?.size[0] === height && thing.mask.size[1] === width) paint(pixels, thing.mask, hueColour(index, true));
  });
  pen.putImageData(pixels, 0, 0);
  const size = Math.max(12, Math.round(width / 40));
  pen.font = `600 ${size}px system-ui, sans-serif`;
  pen.textBaseline = "top";
  pen.lineWidth = Math.max(1.5, width / 400);
  objects.forEach((thing, index) => {
    const [x1, y1, x2, y2] = thing.box;
    const colour = css(hueColour(index, true));
    pen.strokeStyle = colour;
    pen.strokeRect(x1 + 0.5, y1 + 0.5, x2 - x1, y2 - y1);
    const text = `${thing.category} ${Math.round(100 * thing.score)} %`;
    const wide = pen.measureText(text).width + size * 0.6;
    const left = Math.max(0, Math.min(x1, width - wide));
    const top = Math.max(0, y1 - size * 1.35);
    pen.fillStyle = colour;
    pen.fillRect(left, top, wide, size * 1.35);
    pen.fillStyle = "#0b1216";
    pen.fillText(text, left + size * 0.3, top + size * 0.16);
  });
}

function paint(pixels: ImageData, mask: RunLengths, [r, g, b]: readonly [number, number, number]): void {
  const [height] = mask.size;
  let at = 0;
  mask.counts.forEach((count, run) => {
    if (run % 2 === 1)
      for (let i = at; i < at + count; i++) {
        const row = i % height;
        const offset = 4 * (row * pixels.width + (i - row) / height);
        pixels.data[offset] = 255 * r;
        pixels.data[offset + 1] = 255 * g;
        pixels.data[offset + 2] = 255 * b;
        pixels.data[offset + 3] = 95;
      }
    at += count;
  });
}

export function drawKeypoints(canvas: HTMLCanvasElement, found: KeypointColumns): void {
  const pen = canvas.getContext("2d");
  if (!pen) return;
  pen.clearRect(0, 0, canvas.width, canvas.height);
  pen.lineWidth = Math.max(1, canvas.width / 640);
  found.x.forEach((x, i) => {
    pen.strokeStyle = found.points[i]?.[0] == null ? "#ff8a80" : "#69f0ae";
    pen.beginPath();
    pen.arc(x, found.y[i] ?? 0, Math.max(1.5, Math.min(14, (found.size[i] ?? 4) / 4)), 0, 2 * Math.PI);
    pen.stroke();
  });
}

function seenList(context: MapContext, objects: readonly SeenObject[], sightings: readonly Sighting[]): Child {
  if (objects.length === 0) return h("p", { class: "faint" }, texts.keyframe.noObjects);
  const landmarkOf = new Map(sightings.map((one) => [one.ordinal, one.landmark]));
  return h(
    "ul",
    { class: "row-list" },
    objects.map((thing, index) => {
      const mark = h("span", { class: "dot" });
      mark.style.background = css(hueColour(index, theme.get() === "dark"));
      const landmark = landmarkOf.get(index);
      const target = landmark === undefined ? null : a(link(["maps", context.name, "landmarks", landmark]), null, texts.keyframe.shows(landmark));
      return h("li", null, mark, h("span", { class: "grow" }, bdi(thing.category), " ", h("span", { class: "faint small" }, `${Math.round(100 * thing.score)} %`)), target);
    }),
  );
}

/** Those that lie near and look alike, the nearest first. */
function neighbours(context: MapContext, item: KeyframeItem): Child {
  const near = context.scene.keyframes
    .filter((other) => other.id !== item.id)
    .map((other) => {
      const turned = Math.acos(Math.max(-1, Math.min(1, dot(other.axes[2], item.axes[2]))));
      const away = distance(other.position, item.position);
      return { other, away, turned, cost: away + turned };
    })
    .sort((one, two) => one.cost - two.cost)
    .slice(0, 6);
  return h(
    "ul",
    { class: "thumbs" },
    near.map(({ other, away, turned }) => {
      const image = h("img", { attrs: { alt: texts.keyframe.title(other.id), loading: "lazy", width: 160, height: Math.round((160 * other.camera.height) / other.camera.width) } });
      load(image, `/v1/keyframes/${other.id}/image?width=320`, context.until);
      return h("li", null, a(link(["maps", context.name, "keyframes", other.id]), null, image, h("span", { class: "small" }, texts.keyframe.neighbour(away, (turned * 180) / Math.PI))));
    }),
  );
}

function usedList(mapName: string, item: KeyframeItem, queries: readonly LoggedQuery[]): Child {
  if (queries.length === 0) return h("p", { class: "faint" }, texts.keyframe.unused);
  return h(
    "ul",
    { class: "row-list" },
    queries.map((query) => {
      const mine = query.candidates.find((one) => one.keyframe === item.id);
      return h(
        "li",
        null,
        h("span", { class: `tag ${query.verdict === "localized" ? "good" : query.verdict === "failed" ? "bad" : "warn"}` }, query.verdict),
        h("span", { class: "grow ellipsis" }, a(link(["maps", mapName, "queries"], { query: query.id }), null, bdi(query.image))),
        h("span", { class: "faint small" }, texts.keyframe.query(mine?.inliers ?? 0)),
      );
    }),
  );
}
