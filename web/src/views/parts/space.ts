// The map in space with cameras that are none of its own: photos, queries, robots. Without WebGL, a plan.
import { getBytes, isAbort, part } from "../../api";
import { type KeyframeItem, MOST_POINTS, type MapScene, axesOf, pointsOf } from "../../model";
import { setQuery } from "../../router";
import type { Extra, Mode, Viewer } from "../../scene/viewer";
import { texts } from "../../texts";
import type { Pose, Vector3 } from "../../types";
import { fill, h } from "../../ui/h";
import { key } from "../../ui/keys";
import { button, loading, toast } from "../../ui/parts";
import { theme } from "../../ui/theme";
import { TopMap } from "../../ui/topmap";
import { kindOf } from "./evidence";

const PAINTS = { good: "--good", warn: "--warn", bad: "--bad", accent: "--accent", old: "--ink-2" } as const;

/** A camera that is drawn: where, how sure, under which name. */
export interface Placed {
  pose: Pose;
  verdict: string;
  label?: string;
  covariance?: number[][] | null;
  /** Numbers of its camera, fx,fy,cx,cy, where they are known. */
  camera?: string;
  path?: readonly Vector3[];
  by?: readonly KeyframeItem[];
  faint?: boolean;
}

export class Space {
  readonly element: HTMLElement;
  private readonly stage = h("div", { class: "stage" }, loading());
  private viewer: Viewer | null = null;
  private plan: TopMap | null = null;
  private shown: { cameras: readonly Placed[]; keyframes: readonly KeyframeItem[] } = { cameras: [], keyframes: [] };
  private goal: Placed | null = null;
  private mode: Mode = "3d";
  private at = "";
  private readonly modes: HTMLButtonElement[];

  constructor(
    private readonly scene: MapScene,
    private readonly until: AbortSignal,
  ) {
    const choice = (["3d", "top"] as const).map((mode) => ({ mode, text: mode === "3d" ? texts.map.view3d : texts.map.viewTop }));
    this.modes = choice.map(({ mode, text }) => h("button", { title: "v", attrs: { type: "button" }, on: { click: () => this.turn(mode) } }, text));
    const bar = h("div", { class: "space-bar" }, h("div", { class: "segmented", attrs: { role: "group" } }, this.modes), button(texts.map.home, () => this.viewer?.home(), { title: "h" }));
    this.element = h("section", { class: "space", attrs: { "aria-label": texts.map.scene(scene.name) } }, bar, this.stage);
    key("v", () => this.turn(this.mode === "top" ? "3d" : "top"), until);
    key("h", () => this.viewer?.home(), until);
    until.addEventListener("abort", () => this.viewer?.dispose());
    this.mark();
    void this.begin();
  }

  private async begin(): Promise<void> {
    const asked = getBytes(`/v1/maps/${part(this.scene.name)}/points?count=${MOST_POINTS}`, this.until).catch((error: unknown) => {
      if (!isAbort(error)) toast(texts.map.noPoints);
      return null;
    });
    try {
      const { Viewer } = await import("../../scene/viewer");
      if (this.until.aborted) return;
      this.viewer = new Viewer(this.scene, { moved: () => this.remember() }, ["uncertainty"]);
    } catch {
      this.plan = new TopMap(this.scene);
      fill(this.stage, this.plan.element);
      this.element.classList.add("flat");
      this.draw();
      return;
    }
    const { viewer } = this;
    Object.assign(viewer.element, { viewer }); // for those who measure
    viewer.canvas.setAttribute("aria-label", texts.map.scene(this.scene.name));
    fill(this.stage, viewer.element);
    theme.watch(() => viewer.build(), this.until);
    this.follow(new URLSearchParams(location.search));
    this.draw();
    if (this.goal && this.at === "") this.flyTo(this.goal);
    const points = await asked;
    if (points && !this.until.aborted) viewer.setPoints(pointsOf(points));
  }

  /** Replaces the cameras, and the keyframes that are marked. */
  show(cameras: readonly Placed[], keyframes: readonly KeyframeItem[] = []): void {
    this.shown = { cameras, keyframes };
    this.draw();
  }

  /** Goes behind a camera. */
  flyTo(camera: Placed): void {
    this.goal = camera;
    this.at = "";
    this.viewer?.flyToKeyframe({ position: camera.pose.position, axes: axesOf(...camera.pose.quat_wxyz) });
  }

  /** The address says from where one looks. */
  follow(query: URLSearchParams): void {
    const mode: Mode = query.get("view") === "top" ? "top" : "3d";
    const turned = mode !== this.mode;
    this.mode = mode;
    this.mark();
    if (!this.viewer) return;
    this.viewer.setMode(mode);
    const before = this.at;
    this.at = query.get("at") ?? "";
    const at = this.at.split(",").map(Number);
    const [x, y, z, u, v, w, zoom] = at as [number, number, number, number, number, number, number];
    if (this.at !== before && at.length === 7 && at.every(Number.isFinite)) this.viewer.state = { position: [x, y, z], target: [u, v, w], zoom };
    else if (turned && this.goal) this.flyTo(this.goal);
  }

  private turn(mode: Mode): void {
    setQuery({ view: mode === "top" ? "top" : null, at: null }, false);
  }

  private remember(): void {
    if (!this.viewer || this.until.aborted) return;
    const { position, target, zoom } = this.viewer.state;
    this.at = [...position, ...target, zoom].map((value) => Number(value.toFixed(3))).join(",");
    setQuery({ at: this.at });
  }

  private mark(): void {
    this.modes.forEach((button, k) => button.setAttribute("aria-pressed", String((k === 1) === (this.mode === "top"))));
  }

  private draw(): void {
    const { cameras, keyframes } = this.shown;
    this.viewer?.setExtras(cameras.map((one) => this.extra(one)));
    this.viewer?.highlight(keyframes, []);
    this.plan?.show(
      cameras.map((one) => ({ position: one.pose.position, forward: axesOf(...one.pose.quat_wxyz)[2], kind: one.faint ? "old" : kindOf(one.verdict), ...(one.label === undefined ? {} : { label: one.label }) })),
      [],
      [],
      new Set(keyframes.map((item) => item.id)),
      new Set(),
      cameras.flatMap((one) => (one.path ? [one.path] : [])),
    );
  }

  private extra(one: Placed): Extra {
    const c = one.covariance ?? null;
    const row = (i: number, k: number): number => c?.[i]?.[k] ?? 0;
    return {
      item: { position: one.pose.position, axes: axesOf(...one.pose.quat_wxyz), camera: cameraOf(one.camera, this.scene) },
      paint: PAINTS[one.faint ? "old" : kindOf(one.verdict)],
      ...(one.label === undefined ? {} : { label: one.label }),
      ...(c ? { covariance: [row(0, 0), row(0, 1), row(0, 2), row(1, 1), row(1, 2), row(2, 2)] } : {}),
      ...(one.path ? { path: one.path } : {}),
      ...(one.by ? { by: one.by.map((item) => item.position) } : {}),
      ...(one.faint ? { faint: true } : {}),
    };
  }
}

/** What is drawn of a camera: its own numbers, or those of the map's keyframes. */
function cameraOf(text: string | undefined, scene: MapScene): KeyframeItem["camera"] {
  const [fx, fy, cx, cy] = (text ?? "").split(",").map(Number) as [number, number, number, number];
  if ([fx, fy, cx, cy].every((value) => Number.isFinite(value) && value > 0)) return { width: 2 * cx + 1, height: 2 * cy + 1, fx, fy, cx, cy };
  return scene.keyframes[0]?.camera ?? { width: 640, height: 480, fx: 525, fy: 525, cx: 319.5, cy: 239.5 };
}
