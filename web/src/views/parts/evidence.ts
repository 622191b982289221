// What an answer rests on: the pose in words, the keyframes that were looked at, the place in the map.
import { get, load, part } from "../../api";
import { type KeyframeItem, type MapScene, type SceneColumns, sceneOf } from "../../model";
import { link } from "../../router";
import { texts } from "../../texts";
import type { Pose } from "../../types";
import { bdi, h } from "../../ui/h";
import { a } from "../../ui/parts";
import type { Shown } from "../../ui/topmap";
import { metres, place, sigmas } from "../../ui/verdict";

export interface Candidate {
  keyframe: number;
  recording: string;
  frame_index: number;
  inliers: number;
  class_score?: number | null;
  cosine?: number | null;
}

const scenes = new Map<string, Promise<MapScene>>();

/** The scene of a map, asked for once while one looks at it. */
export function sceneOfMap(map: string, until?: AbortSignal): Promise<MapScene> {
  const known = scenes.get(map);
  if (known) return known;
  const asked = get<SceneColumns>(`/v1/maps/${part(map)}/scene`, until).then(sceneOf);
  scenes.clear();
  scenes.set(map, asked);
  asked.catch(() => scenes.delete(map));
  return asked;
}

export function kindOf(verdict: string): Shown["kind"] {
  return verdict === "localized" ? "good" : verdict === "failed" ? "bad" : "warn";
}

/** Keyframes that an answer rests on, those with most matches first. */
export function matchedOf(scene: MapScene, candidates: readonly Candidate[]): KeyframeItem[] {
  const found = candidates.filter((one) => one.inliers > 0).sort((a, b) => b.inliers - a.inliers);
  return found.map((one) => scene.keyframe(one.keyframe)).filter((item) => item !== undefined);
}

export function poseFacts(pose: Pose | null, covariance: number[][] | null, confidence: number | null, inliers: number): HTMLElement {
  const t = texts.answer;
  const sigma = sigmas(covariance);
  const facts: [string, string][] = [
    [t.position, place(pose?.position ?? null)],
    ...(sigma ? ([[t.sigma, t.sigmaOf(metres(sigma.m), sigma.deg.toFixed(2))]] as [string, string][]) : []),
    [t.confidence, pose === null || confidence === null ? "–" : `${(100 * confidence).toFixed(1)} %`],
    [t.inliers, String(inliers)],
  ];
  return h("dl", { class: "facts" }, facts.map(([name, text]) => [h("dt", null, name), h("dd", null, text)]));
}

export function candidatesTable(map: string, candidates: readonly Candidate[]): HTMLElement {
  const t = texts.answer;
  if (candidates.length === 0) return h("p", { class: "faint" }, t.noCandidates);
  const number = (value: number | null | undefined): string => (value === null || value === undefined ? "–" : value.toFixed(2));
  return h(
    "section",
    { class: "stack" },
    h("h3", null, t.candidates),
    h("ul", { class: "strip", attrs: { "aria-label": t.candidates } }, candidates.slice(0, 24).map((one) =>
      h("li", null, a(link(["maps", map, "keyframes", one.keyframe]), null, thumbnail(one.keyframe, t.keyframe(one.keyframe)),
        h("span", null, bdi(one.recording), ` ${one.frame_index}`),
        h("span", { class: "faint" }, t.matched(one.inliers), h("br"), t.scores(number(one.class_score), number(one.cosine)))))),
    ),
  );
}

export function thumbnail(keyframe: number, alt: string, width = 240, box?: readonly number[]): HTMLImageElement {
  const image = h("img", { attrs: { alt, loading: "lazy", width } });
  load(image, `/v1/keyframes/${keyframe}/image?width=${width}${box ? `&box=${box.map((value) => value.toFixed(1)).join(",")}` : ""}`);
  return image;
}
