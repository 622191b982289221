// Rows of a statement in the map: their keyframes, landmarks and places.
import { getAll } from "../../api";
import { link } from "../../router";
import { texts } from "../../texts";
import type { MapInfo, Vector3 } from "../../types";
import { bdi, fill, h } from "../../ui/h";
import { a, empty, loading } from "../../ui/parts";
import { type Mark, TopMap } from "../../ui/topmap";
import type { Rows } from "../sql";
import { sceneOfMap } from "./evidence";

const KEYFRAMES = ["keyframe_id", "keyframe"];
const LANDMARKS = ["landmark_id", "landmark"];
const MOST_MAPS = 4;
const MOST_MARKS = 500;

function column(found: Rows, names: readonly string[]): number {
  return found.columns.findIndex((name) => names.includes(name.toLowerCase()));
}

function places(found: Rows): number[] | null {
  const at = ["x", "y", "z"].map((name) => column(found, [name]));
  return at.every((k) => k >= 0) ? at : null;
}

async function show(place: HTMLElement, found: Rows, until: AbortSignal): Promise<void> {
  fill(place, loading());
  const [keyframe, landmark, map] = [column(found, KEYFRAMES), column(found, LANDMARKS), column(found, ["map", "map_name"])];
  const xyz = places(found);
  const named = new Set(found.rows.map((row) => (map < 0 ? null : row[map])).filter((name): name is string => typeof name === "string"));
  const maps = (await getAll<MapInfo>("/v1/maps", until)).map((one) => one.name).filter((name) => named.size === 0 || named.has(name));
  const figures: HTMLElement[] = [];
  for (const name of maps.slice(0, MOST_MAPS)) {
    const scene = await sceneOfMap(name, until);
    const rows = found.rows.filter((row) => map < 0 || row[map] === name);
    const keyframes = new Set(rows.map((row) => Number(row[keyframe])).filter((id) => keyframe >= 0 && scene.keyframe(id)));
    const landmarks = new Set(rows.map((row) => Number(row[landmark])).filter((id) => landmark >= 0 && scene.landmark(id)));
    const marks: Mark[] = [];
    if (xyz !== null && (named.size > 0 || maps.length === 1))
      for (const row of rows.slice(0, MOST_MARKS)) {
        const position = xyz.map((k) => row[k]);
        if (position.every((value) => typeof value === "number")) marks.push({ position: position as Vector3, kind: "accent", label: "" });
      }
    if (keyframes.size + landmarks.size + marks.length === 0) continue;
    const plan = new TopMap(scene);
    plan.show([], [], marks, keyframes, landmarks);
    const ids = (kind: "keyframes" | "landmarks", all: Set<number>): HTMLElement[] => [...all].slice(0, 40).map((id) => a(link(["maps", name, kind, id]), null, String(id)));
    figures.push(
      h("figure", { class: "in-map" }, plan.element, h("figcaption", { class: "row" }, h("strong", null, bdi(name)), texts.sql.highlighted(keyframes.size, landmarks.size, marks.length), ids("keyframes", keyframes), ids("landmarks", landmarks))),
    );
  }
  if (!until.aborted) fill(place, figures.length > 0 ? figures : empty(texts.sql.nothingInMap));
}

export const rowsInMaps = {
  /** Whether there is something in the rows that a map can show. */
  can: (found: Rows): boolean => found.rows.length > 0 && (column(found, KEYFRAMES) >= 0 || column(found, LANDMARKS) >= 0 || places(found) !== null),
  show,
};
