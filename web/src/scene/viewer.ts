// The map in space. It draws when something changed, and not otherwise.
import { type BufferGeometry, type Camera, Color, Group, type LineSegments, type Material, type Object3D, Plane, type Points, type PointsMaterial, Scene, Vector3 as V3, WebGLRenderer } from "three";
import { type KeyframeItem, type LandmarkItem, type MapScene, type PointCloud, css, hueColour, plus, scaled } from "../model";
import type { Vector3 } from "../types";
import { colour, theme } from "../ui/theme";
import { Extent, present } from "./extent";
import { type Label, Labels } from "./labels";
import { VERTICES, boxLines, cloudPoints, dots, floorGrid, frustumLines, linkLines, ringLines, trails } from "./layers";
import { type Mode, Navigation, type ViewState } from "./navigation";
import { nearestFirst } from "./nearest";
import { type Extra, Overlay } from "./overlay";
import { Painter, type Part } from "./painter";
import { type Picked, pick } from "./pick";
import { corners } from "./shapes";

export type { Extra, Mode, Picked, ViewState };
export const LAYERS = ["points", "cameras", "landmarks", "names", "trails", "links", "uncertainty", "grid"] as const;
export type Layer = (typeof LAYERS)[number];

/** So many of each kind have edges, at rest and while the view moves; of all others there are dots. */
const EDGES = { rest: 1500, moving: 250 };
const RINGS = { rest: 1500, moving: 60 };
const DOTS_MOVING = 2500;
const SEGMENT_COST = 4; // of a line, in points of the cloud
const DOT_COST = 3;
const MOST_LABELLED = 600;
const LABELS_IN_HASTE = 14; // while the view moves, where the processor draws

export interface ViewerOptions {
  /** Something was clicked; without it nothing can be. */
  picked?: (what: Picked) => void;
  /** The view was moved by hand, or flew: see `state`. */
  moved: () => void;
}

/** A layer of items with edges; of many, those nearest to the eye. */
interface Edged {
  layer: Layer;
  part: Part;
  lines: LineSegments;
  items: readonly { position: Vector3 }[];
  most: number;
}

export class Viewer {
  readonly element: HTMLElement;
  private readonly renderer: WebGLRenderer;
  private readonly world = new Scene();
  private readonly navigation: Navigation;
  private readonly painter: Painter;
  private readonly overlay: Overlay;
  private readonly labels = new Labels();
  private readonly layers = new Map<Layer, Object3D>();
  private readonly hidden: Set<Layer>;
  private extent: Extent;
  private points: Points | null = null;
  private edged: Edged[] = [];
  private dotted: Part[] = [];
  private labelled: Label[] = [];
  private cloud: PointCloud | null = null;
  private chosen: { keyframes: readonly KeyframeItem[]; landmarks: readonly LandmarkItem[] } = { keyframes: [], landmarks: [] };
  private chosenLandmarks = new Set<number>();
  private overlayAsked = 0;
  private readonly resize: ResizeObserver;

  /** Raises where there is no WebGL. */
  constructor(
    readonly scene: MapScene,
    private readonly options: ViewerOptions,
    hidden: Iterable<Layer> = [],
  ) {
    this.hidden = new Set(hidden);
    const software = isSoftware();
    // what was drawn stays: the rest of a picture is drawn over its beginning
    this.renderer = new WebGLRenderer({ antialias: !software, powerPreference: "high-performance", preserveDrawingBuffer: true });
    const ratio = software ? 1 : Math.min(devicePixelRatio, 2);
    this.renderer.setPixelRatio(ratio);
    this.overlay = new Overlay(ratio);
    const canvas = this.renderer.domElement;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application");
    this.element = document.createElement("div");
    this.element.className = "viewer";
    this.element.append(canvas, this.overlay.element, this.labels.element);
    this.extent = new Extent(scene, null);
    this.navigation = new Navigation(scene, canvas, this.extent, { stirred: () => this.painter.stir(), moved: () => options.moved() });
    const around = { before: (moving: boolean) => this.prepare(moving), after: (moving: boolean) => this.drawOver(moving && software) };
    this.painter = new Painter(this.renderer, this.world, () => this.camera, around, software);
    this.build();
    this.listen(canvas);
    this.resize = new ResizeObserver(() => this.fit());
    this.resize.observe(this.element);
    this.home(false);
  }

  get canvas(): HTMLCanvasElement {
    return this.renderer.domElement;
  }

  dispose(): void {
    this.resize.disconnect();
    this.painter.dispose();
    cancelAnimationFrame(this.overlayAsked);
    this.navigation.dispose();
    this.world.traverse(release);
    this.renderer.dispose();
    this.renderer.forceContextLoss();
    this.element.remove();
  }

  /** All of the picture is drawn; for tests and pictures. */
  get complete(): boolean {
    return this.painter.complete;
  }

  /** Times between the last frames, milliseconds. */
  get frames(): readonly number[] {
    return this.painter.frames;
  }

  // what is drawn

  setPoints(cloud: PointCloud): void {
    this.cloud = cloud;
    this.extent = new Extent(this.scene, cloud);
    this.navigation.extent = this.extent;
    this.build();
  }

  show(layer: Layer, on: boolean): void {
    if (on) this.hidden.delete(layer);
    else this.hidden.add(layer);
    const found = this.layers.get(layer);
    if (found) found.visible = on;
    else if (on && layer === "uncertainty") this.build(); // of many things they take a while, and are seldom wanted
    this.painter.invalidate();
  }

  /** Draws all layers anew: after the theme changed, too. */
  build(): void {
    for (const object of this.layers.values()) this.drop(object);
    this.layers.clear();
    this.edged = [];
    this.dotted = [];
    const { scene, extent } = this;
    const dark = theme.get() === "dark";
    const under = new Color(colour("--scene"));
    this.renderer.setClearColor(under, 1);
    const ofRecording = (item: KeyframeItem): [number, number, number] => hueColour(item.recordingIndex, dark);
    const ofClass = (item: LandmarkItem): [number, number, number] => hueColour(item.categoryIndex, dark);
    const things = scene.landmarks.filter(present).sort((a, b) => weight(b) - weight(a));
    this.putMany("cameras", frustumLines(scene.keyframes, extent.frustumSize, ofRecording), scene.keyframes, ofRecording, VERTICES.frustum);
    this.putMany("landmarks", boxLines(things, ofClass), things, ofClass, VERTICES.box);
    if (!this.hidden.has("uncertainty")) this.putMany("uncertainty", ringLines(things, colour("--scene-sure")), things, null, VERTICES.rings);
    this.labelled = this.makeLabels(dark, things);
    if (scene.keyframes.length > 1) this.put("trails", trails(scene, dark, under));
    if (scene.links.length > 0) this.put("links", linkLines(scene, colour("--scene-loop"), under));
    this.put("grid", floorGrid(scene, extent.centre, extent.radius, extent.floor, colour("--line-strong"), under));
    this.points = null;
    const parts = [...this.edged.map(({ part }) => part), ...this.dotted];
    if (this.cloud && this.cloud.count > 0) {
      this.points = cloudPoints(this.cloud, extent.pointSize);
      this.dress();
      this.put("points", this.points);
      parts.push({ object: this.points, items: this.cloud.count, vertices: 1, cost: 1, moving: Infinity });
    }
    this.painter.set(parts);
    this.mark();
  }

  /** A layer of things with edges, and with dots where they are too many for that. */
  private putMany<T extends { position: Vector3 }>(layer: Layer, lines: LineSegments, items: readonly T[], paint: ((item: T) => [number, number, number]) | null, vertices: number): void {
    const limits = paint ? EDGES : RINGS;
    const group = new Group();
    group.add(lines);
    const part = { object: lines, items: items.length, vertices, cost: (SEGMENT_COST * vertices) / 2, moving: limits.moving };
    this.edged.push({ layer, part, lines, items, most: limits.rest });
    if (paint && items.length > EDGES.moving) {
      const spread = scattered(items);
      const object = dots(spread.map((item) => item.position), spread.map(paint), 4 * this.renderer.getPixelRatio());
      group.add(object);
      this.dotted.push({ object, items: items.length, vertices: 1, cost: DOT_COST, moving: DOTS_MOVING });
    }
    this.put(layer, group);
  }

  /** From above points are as large in pixels, and what is over the heads is left out. */
  private dress(): void {
    if (!this.points) return;
    const material = this.points.material as PointsMaterial;
    const top = this.mode === "top";
    material.sizeAttenuation = !top;
    material.size = top ? 2.2 * this.renderer.getPixelRatio() : this.extent.pointSize;
    const cut = top && Number.isFinite(this.extent.ceiling);
    material.clippingPlanes = cut ? [new Plane(new V3(...scaled(this.scene.up, -1)), this.extent.ceiling)] : [];
    material.needsUpdate = true;
  }

  /** Marks keyframes and things; what they were before is forgotten. */
  highlight(keyframes: readonly KeyframeItem[], landmarks: readonly LandmarkItem[]): void {
    this.chosen = { keyframes, landmarks };
    this.mark();
  }

  private mark(): void {
    const { keyframes, landmarks } = this.chosen;
    this.chosenLandmarks = new Set(landmarks.map((item) => item.id));
    this.overlay.choose(keyframes, landmarks, this.extent.frustumSize);
    this.later();
  }

  /** Cameras that are none of the map's; those that were there before are gone. */
  setExtras(extras: readonly Extra[]): void {
    this.overlay.show(extras, this.extent.frustumSize);
    this.later();
  }

  private put(layer: Layer, object: Object3D): void {
    object.visible = !this.hidden.has(layer);
    this.layers.set(layer, object);
    this.world.add(object);
  }

  private drop(object: Object3D): void {
    this.world.remove(object);
    object.traverse(release);
  }

  // where it is looked at from

  get camera(): Camera {
    return this.navigation.camera;
  }

  get mode(): Mode {
    return this.navigation.mode;
  }

  get state(): ViewState {
    return this.navigation.state;
  }

  set state(state: ViewState) {
    this.navigation.state = state;
  }

  setMode(mode: Mode): void {
    if (mode === this.mode) return;
    this.renderer.localClippingEnabled = mode === "top";
    this.navigation.setMode(mode);
    this.dress();
    this.fit();
  }

  /** All of the map in sight. */
  home(animated = true): void {
    this.navigation.home(animated);
    this.fit();
  }

  flyToLandmark(item: LandmarkItem): void {
    this.navigation.toLandmark(item);
  }

  /** Behind a camera, looking where it looks. */
  flyToKeyframe(item: Pick<KeyframeItem, "position" | "axes">): void {
    this.navigation.toCamera(item);
  }

  private fit(): void {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height);
    this.navigation.fit(width, height);
    this.painter.invalidate();
  }

  // drawing

  private prepare(moving: boolean): void {
    if (!moving)
      for (const { layer, part, lines, items, most } of this.edged) {
        if (items.length > EDGES.moving && !this.hidden.has(layer)) part.items = nearestFirst(lines, items, part.vertices, this.camera, most);
      }
    const paths = this.layers.get("trails");
    if (paths) paths.visible = !this.hidden.has("trails") && !(moving && this.scene.keyframes.length > EDGES.rest);
  }

  private drawOver(hasty = false): void {
    this.drawLabels(hasty ? LABELS_IN_HASTE : undefined);
    this.overlay.draw(this.camera, this.element.clientWidth, this.element.clientHeight);
  }

  /** What is over the picture changed, and nothing else. */
  private later(): void {
    cancelAnimationFrame(this.overlayAsked);
    this.overlayAsked = requestAnimationFrame(() => this.drawOver());
  }

  private drawLabels(most?: number): void {
    const { clientWidth: width, clientHeight: height } = this.element;
    this.labels.element.hidden = this.hidden.has("names");
    if (this.hidden.has("names")) return;
    const spot = new V3();
    const eye = this.camera.position;
    const project = (at: Vector3): { x: number; y: number; far: number } | null => {
      spot.set(...at);
      const far = this.mode === "top" ? 1 : spot.distanceTo(eye);
      spot.project(this.camera);
      return spot.z > 1 || spot.z < -1 ? null : { x: ((spot.x + 1) / 2) * width, y: ((1 - spot.y) / 2) * height, far };
    };
    const chosen = this.chosenLandmarks;
    const first = this.labelled.filter((label) => chosen.has(label.id)).map((label) => ({ ...label, weight: 1e6 }));
    const shown = this.hidden.has("landmarks") ? [] : this.labelled.slice(0, MOST_LABELLED).filter((label) => !chosen.has(label.id));
    this.labels.draw([...first, ...shown], project, width, height, most);
  }

  private makeLabels(dark: boolean, things: readonly LandmarkItem[]): Label[] {
    return things.map((item) => ({
      id: item.id,
      key: String(item.id),
      text: item.category,
      at: plus(item.position, scaled(this.scene.up, item.size[2] / 2 + 0.02)),
      colour: css(hueColour(item.categoryIndex, dark)),
      weight: weight(item),
    }));
  }

  // picking

  private listen(canvas: HTMLCanvasElement): void {
    let down: { x: number; y: number } | null = null;
    let hovering = 0;
    canvas.addEventListener("pointerdown", (event) => (down = { x: event.offsetX, y: event.offsetY }));
    canvas.addEventListener("pointerup", (event) => {
      if (!down || Math.hypot(event.offsetX - down.x, event.offsetY - down.y) > 4) return;
      this.options.picked?.(this.pick(event.offsetX, event.offsetY, event.pointerType === "touch" ? 20 : 11));
    });
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons !== 0 || !this.options.picked) return;
      cancelAnimationFrame(hovering);
      hovering = requestAnimationFrame(() => (canvas.style.cursor = this.pick(event.offsetX, event.offsetY, 9) ? "pointer" : ""));
    });
    canvas.addEventListener("keydown", (event) => {
      const nearer = { "+": 0.8, "=": 0.8, "-": 1.25 }[event.key];
      if (nearer === undefined || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      this.navigation.nearer(nearer);
    });
    canvas.addEventListener("keyup", (event) => /^Arrow|^[-+=]$/.test(event.key) && this.options.moved());
  }

  /** What is at a place of the picture: the nearest keyframe within `reach` pixels, or the thing that is hit. */
  pick(x: number, y: number, reach: number): Picked {
    const { clientWidth: width, clientHeight: height } = this.element;
    const { keyframes, landmarks } = this.scene;
    return pick(this.camera, { width, height }, { x, y, reach }, this.hidden.has("cameras") ? [] : keyframes, this.hidden.has("landmarks") ? [] : landmarks);
  }

  /** Corners of a thing in pixels, for tests and pictures. */
  outline(item: LandmarkItem): { x: number; y: number }[] {
    const { clientWidth: width, clientHeight: height } = this.element;
    return corners(item).map((corner) => {
      const spot = new V3(...corner).project(this.camera);
      return { x: ((spot.x + 1) / 2) * width, y: ((1 - spot.y) / 2) * height };
    });
  }
}

/** The same in an order of which every beginning is spread over all. */
function scattered<T>(items: readonly T[]): T[] {
  const step = 7919; // a prime
  return items.length % step === 0 ? [...items] : items.map((_, i) => items[(i * step) % items.length] as T);
}

/** How much a thing is worth to be named: sure and large ones first. */
function weight(item: LandmarkItem): number {
  return item.probability * (1 + Math.cbrt(item.size[0] * item.size[1] * item.size[2]));
}

/** Whether pictures are drawn by the processor, as in machines without a graphics card. */
function isSoftware(): boolean {
  const gl = document.createElement("canvas").getContext("webgl2");
  const about = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = gl && about ? String(gl.getParameter(about.UNMASKED_RENDERER_WEBGL)) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

function release(object: Object3D): void {
  const { geometry, material } = object as Object3D & { geometry?: BufferGeometry; material?: Material | Material[] };
  geometry?.dispose();
  for (const one of [material ?? []].flat()) one.dispose();
}
