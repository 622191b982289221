// The map in space. It draws when something changed, and not otherwise.
import {
  type BufferGeometry,
  type Camera,
  Color,
  Group,
  type LineBasicMaterial,
  type LineSegments,
  type Material,
  type Object3D,
  OrthographicCamera,
  PerspectiveCamera,
  Plane,
  type Points,
  type PointsMaterial,
  Scene,
  Vector3 as V3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { type KeyframeItem, type LandmarkItem, type MapScene, type PointCloud, css, distance, dot, hueColour, plus, scaled, unit } from "../model";
import type { Vector3 } from "../types";
import { colour, theme } from "../ui/theme";
import { type Label, Labels } from "./labels";
import { boxLines, cloudPoints, corners, dots, ellipsoids, floorGrid, frustumLines, lines, linkLines, trails } from "./layers";
import { hitBox } from "./pick";

export const LAYERS = ["points", "cameras", "landmarks", "names", "trails", "links", "uncertainty", "grid"] as const;
export type Layer = (typeof LAYERS)[number];
export type Mode = "3d" | "top";
export type Picked = { kind: "keyframe"; id: number } | { kind: "landmark"; id: number } | null;

const MOVING_POINTS = 25_000;
const REST_MS = 220;
/** So many frusta and boxes have edges, at rest and while the view moves; of all others there are dots. */
const EDGES = { rest: 1500, moving: 250 };
const MOST_LABELLED = 600;

export interface ViewerOptions {
  picked: (what: Picked) => void;
  /** The view was moved by hand: see `state`. */
  moved: () => void;
}

/** Where the view is: what it turns about, angles in radians, metres. */
export interface ViewState {
  target: Vector3;
  position: Vector3;
  zoom: number;
}

export class Viewer {
  readonly element: HTMLElement;
  /** How long the last pictures took, milliseconds. */
  readonly frames: number[] = [];
  private readonly renderer: WebGLRenderer;
  private readonly world = new Scene();
  private readonly perspective = new PerspectiveCamera(55, 1, 0.02, 500);
  private readonly above = new OrthographicCamera(-1, 1, 1, -1, -500, 500);
  private controls: OrbitControls;
  private readonly labels = new Labels();
  private readonly layers = new Map<Layer, Object3D>();
  private readonly extras = new Map<string, Object3D>();
  private readonly hidden = new Set<Layer>();
  private points: Points | null = null;
  private edges: { edges: LineSegments; vertices: number }[] = [];
  private labelled: Label[] = [];
  private cloud: PointCloud | null = null;
  private selection: Object3D[] = [];
  private chosenLandmarks = new Set<number>();
  private asked = 0;
  private moving = 0;
  private flight = 0;
  private mode: Mode = "3d";
  private radius = 2;
  private centre: Vector3 = [0, 0, 0];
  private ceiling = Infinity;
  private readonly resize: ResizeObserver;

  /** Raises where there is no WebGL. */
  constructor(
    readonly scene: MapScene,
    private readonly options: ViewerOptions,
  ) {
    const software = isSoftware();
    this.renderer = new WebGLRenderer({ antialias: !software, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(software ? 1 : Math.min(devicePixelRatio, 2));
    const canvas = this.renderer.domElement;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application");
    this.element = document.createElement("div");
    this.element.className = "viewer";
    this.element.append(canvas, this.labels.element);
    this.measure();
    for (const camera of [this.perspective, this.above]) camera.up.set(...scene.up);
    this.controls = this.control(this.perspective);
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
    cancelAnimationFrame(this.asked);
    cancelAnimationFrame(this.flight);
    clearTimeout(this.moving);
    this.controls.dispose();
    this.world.traverse(release);
    this.renderer.dispose();
    this.renderer.forceContextLoss();
    this.element.remove();
  }

  // what is drawn

  setPoints(cloud: PointCloud): void {
    this.cloud = cloud;
    if (this.scene.keyframes.length === 0 && cloud.count > 0) this.measure();
    this.build();
  }

  show(layer: Layer, on: boolean): void {
    if (on) this.hidden.delete(layer);
    else this.hidden.add(layer);
    const found = this.layers.get(layer);
    if (found) found.visible = on;
    this.invalidate();
  }

  /** Draws all layers anew: after the theme changed, too. */
  build(): void {
    for (const object of this.layers.values()) this.drop(object);
    this.layers.clear();
    const { scene } = this;
    const dark = theme.get() === "dark";
    this.world.background = new Color(colour("--scene"));
    const size = this.frustumSize();
    this.edges = [];
    const cameras = scattered(scene.keyframes);
    const ofRecording = (item: KeyframeItem): [number, number, number] => hueColour(item.recordingIndex, dark);
    this.putMany("cameras", frustumLines(cameras, size, cameras.map(ofRecording)), cameras, ofRecording, 16);
    const things = scene.landmarks.filter(present).sort((a, b) => weight(b) - weight(a));
    const ofClass = (item: LandmarkItem): [number, number, number] => hueColour(item.categoryIndex, dark);
    this.putMany("landmarks", boxLines(things, ofClass), things, ofClass, 24);
    this.labelled = this.makeLabels(dark, things);
    if (scene.keyframes.length > 1) this.put("trails", trails(scene, dark));
    if (scene.links.length > 0) this.put("links", linkLines(scene, colour("--scene-loop")));
    if (things.length > 0) this.put("uncertainty", ellipsoids(things.slice(0, EDGES.rest), colour("--scene-sure")));
    this.put("grid", floorGrid(scene, this.centre, this.radius, this.floor(), colour("--line-strong")));
    this.points = null;
    if (this.cloud && this.cloud.count > 0) {
      this.points = cloudPoints(this.cloud, this.pointSize(this.cloud));
      this.dress(this.points.material as PointsMaterial);
      this.put("points", this.points);
    }
    this.invalidate();
  }

  /** About as large as points are apart. */
  private pointSize(cloud: PointCloud): number {
    return Math.min(0.06, Math.max(0.006, 2.5 * this.radius / Math.sqrt(cloud.count)));
  }

  /** A layer of things with edges, and with dots where they are too many for that. */
  private putMany<T extends { position: Vector3 }>(layer: Layer, edges: LineSegments, items: readonly T[], paint: (item: T) => [number, number, number], vertices: number): void {
    const group = new Group();
    group.add(edges);
    this.edges.push({ edges, vertices });
    if (items.length > EDGES.moving) group.add(dots(items.map((item) => item.position), items.map(paint), 4 * this.renderer.getPixelRatio()));
    this.put(layer, group);
  }

  /** A camera that is none of the map's, by a name: a photo, or one that moves. `item` null takes it away. */
  extra(name: string, item: Pick<KeyframeItem, "position" | "axes" | "camera"> | null, paint = "--scene-select", size = 1.6): void {
    const before = this.extras.get(name);
    if (before) this.drop(before);
    this.extras.delete(name);
    if (item) {
      const { r, g, b } = new Color(colour(paint)).convertLinearToSRGB();
      const made = frustumLines([item], this.frustumSize() * size, [[r, g, b]]);
      onTop(made);
      this.world.add(made);
      this.extras.set(name, made);
    }
    this.invalidate();
  }

  /** A path that is none of the map's: positions one after the other. */
  extraPath(name: string, path: readonly Vector3[], paint = "--scene-select"): void {
    const before = this.extras.get(name);
    if (before) this.drop(before);
    this.extras.delete(name);
    if (path.length > 1) {
      const positions = new Float32Array(path.slice(1).flatMap((to, i) => [...(path[i] ?? to), ...to]));
      const made = lines(positions, null, colour(paint));
      onTop(made);
      this.world.add(made);
      this.extras.set(name, made);
    }
    this.invalidate();
  }

  /** Marks keyframes and things; what they were before is forgotten. */
  highlight(keyframes: readonly KeyframeItem[], landmarks: readonly LandmarkItem[]): void {
    for (const object of this.selection) this.drop(object);
    this.selection = [];
    this.chosenLandmarks = new Set(landmarks.map((item) => item.id));
    const { r, g, b } = new Color(colour("--scene-select")).convertLinearToSRGB();
    const paint: [number, number, number] = [r, g, b];
    if (keyframes.length > 0) this.selection.push(frustumLines(keyframes, 1.3 * this.frustumSize(), [paint]));
    if (landmarks.length > 0) this.selection.push(boxLines(landmarks, () => paint));
    for (const object of this.selection) {
      onTop(object as LineSegments);
      this.world.add(object);
    }
    this.invalidate();
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

  // sizes

  private measure(): void {
    const places = [...this.scene.keyframes.map((item) => item.position), ...this.scene.landmarks.filter(present).map((item) => item.position)];
    if (this.cloud) for (let i = 0; i < Math.min(this.cloud.count, 2000); i++) places.push(this.cloud.positions.slice(3 * i, 3 * i + 3) as unknown as Vector3);
    if (places.length === 0) return;
    const middle = (axis: 0 | 1 | 2): number => {
      const sorted = places.map((place) => place[axis]).sort((a, b) => a - b);
      return ((sorted[Math.floor(0.02 * sorted.length)] ?? 0) + (sorted[Math.ceil(0.98 * sorted.length) - 1] ?? 0)) / 2;
    };
    this.centre = [middle(0), middle(1), middle(2)];
    const far = places.map((place) => distance(place, this.centre)).sort((a, b) => a - b);
    this.radius = Math.max(0.8, 1.15 * (far[Math.floor(0.97 * (far.length - 1))] ?? 1));
    const heights = this.scene.keyframes.map((item) => dot(item.position, this.scene.up)).sort((a, b) => a - b);
    this.ceiling = (heights[Math.floor(heights.length / 2)] ?? Infinity) + 0.35;
  }

  private frustumSize(): number {
    const crowd = Math.cbrt(Math.max(1, this.scene.keyframes.length / 60));
    return Math.max(0.04, Math.min(0.16, 0.05 * this.radius) / Math.min(crowd, 3));
  }

  private floor(): number {
    const { up } = this.scene;
    const heights: number[] = [];
    if (this.cloud) for (let i = 0; i < Math.min(this.cloud.count, 5000); i++) heights.push(dot([this.cloud.positions[3 * i] ?? 0, this.cloud.positions[3 * i + 1] ?? 0, this.cloud.positions[3 * i + 2] ?? 0], up));
    for (const item of this.scene.landmarks) heights.push(dot(item.position, up) - item.size[2] / 2);
    if (heights.length === 0) return dot(this.centre, up) - 1;
    heights.sort((a, b) => a - b);
    return heights[Math.floor(0.01 * heights.length)] ?? 0;
  }

  /** From above points are as large in pixels, and what is over the heads is left out. */
  private dress(material: PointsMaterial): void {
    const top = this.mode === "top";
    material.sizeAttenuation = !top;
    material.size = top ? 2.2 * this.renderer.getPixelRatio() : this.cloud ? this.pointSize(this.cloud) : 0.02;
    material.clippingPlanes = this.clipping();
    material.needsUpdate = true;
  }

  private clipping(): Plane[] {
    if (this.mode !== "top" || !Number.isFinite(this.ceiling)) return [];
    return [new Plane(new V3(...scaled(this.scene.up, -1)), this.ceiling)];
  }

  // where it is looked at from

  get camera(): Camera {
    return this.mode === "top" ? this.above : this.perspective;
  }

  setMode(mode: Mode): void {
    if (mode === this.mode) return;
    this.mode = mode;
    this.controls.dispose();
    this.controls = this.control(mode === "top" ? this.above : this.perspective);
    this.renderer.localClippingEnabled = mode === "top";
    if (this.points) this.dress(this.points.material as PointsMaterial);
    this.home(false);
  }

  private control(camera: PerspectiveCamera | OrthographicCamera): OrbitControls {
    const controls = new OrbitControls(camera, this.renderer.domElement);
    controls.zoomToCursor = true;
    controls.screenSpacePanning = true;
    controls.minDistance = 0.05;
    controls.maxDistance = 20 * this.radius;
    controls.enableRotate = this.mode === "3d";
    if (this.mode === "top") {
      controls.mouseButtons.LEFT = 2; // to move, since there is nothing to turn
      controls.touches.ONE = 1;
    }
    controls.addEventListener("change", () => this.stir());
    controls.addEventListener("end", () => this.options.moved());
    return controls;
  }

  /** All of the map in sight. */
  home(animated = true): void {
    const { up } = this.scene;
    const back = unit(plus(this.sideways(), scaled(up, 0.75)));
    if (this.mode === "top") {
      this.above.zoom = 1;
      this.flyTo(plus(this.centre, scaled(up, 50)), this.centre, animated);
    } else this.flyTo(plus(this.centre, scaled(back, 1.8 * this.radius)), this.centre, animated);
    this.fit();
  }

  /** A level direction from which the keyframes look away, so that one sees what they saw. */
  private sideways(): Vector3 {
    const { up, keyframes } = this.scene;
    const sum = keyframes.reduce<Vector3>((total, item) => plus(total, item.axes[2]), [0, 0, 0]);
    const level = plus(sum, scaled(up, -dot(sum, up)));
    if (Math.hypot(...level) < 0.15 * Math.max(1, keyframes.length)) {
      const side: Vector3 = Math.abs(up[0]) < 0.9 ? [1, 0.6, 0] : [0, 1, 0.6];
      return unit(plus(side, scaled(up, -dot(side, up))));
    }
    return unit(scaled(level, -1));
  }

  get state(): ViewState {
    const { target } = this.controls;
    const { position } = this.controls.object;
    return { target: [target.x, target.y, target.z], position: [position.x, position.y, position.z], zoom: this.above.zoom };
  }

  set state(state: ViewState) {
    this.above.zoom = state.zoom;
    this.above.updateProjectionMatrix();
    this.flyTo(state.position, state.target, false);
  }

  flyToLandmark(item: LandmarkItem): void {
    const reach = Math.max(...item.size, 0.25);
    if (this.mode === "top") return this.flyAbove(item.position);
    const from = unit(plus(plus(this.state.position, scaled(item.position, -1)), scaled(this.scene.up, 0.2 * this.radius)));
    this.flyTo(plus(item.position, scaled(from, Math.max(1.5, 3.4 * reach))), item.position);
  }

  /** Behind a keyframe, looking where it looks. */
  flyToKeyframe(item: Pick<KeyframeItem, "position" | "axes">): void {
    if (this.mode === "top") return this.flyAbove(item.position);
    const back = plus(plus(item.position, scaled(item.axes[2], -0.8)), scaled(this.scene.up, 0.3));
    this.flyTo(back, plus(item.position, scaled(item.axes[2], 1.2)));
  }

  private flyAbove(place: Vector3): void {
    this.flyTo(plus(place, scaled(this.scene.up, 50)), place);
  }

  private flyTo(position: Vector3, target: Vector3, animated = true): void {
    cancelAnimationFrame(this.flight);
    const { controls } = this;
    const from = { position: controls.object.position.clone(), target: controls.target.clone() };
    const to = { position: new V3(...position), target: new V3(...target) };
    const still = !animated || matchMedia("(prefers-reduced-motion: reduce)").matches;
    const began = performance.now();
    const step = (now: number): void => {
      const share = still ? 1 : Math.min(1, (now - began) / 650);
      const eased = share < 0.5 ? 2 * share * share : 1 - 2 * (1 - share) * (1 - share);
      controls.object.position.lerpVectors(from.position, to.position, eased);
      controls.target.lerpVectors(from.target, to.target, eased);
      controls.update();
      this.stir();
      if (share < 1) this.flight = requestAnimationFrame(step);
      else if (animated) this.options.moved();
    };
    step(still ? began : performance.now());
  }

  private fit(): void {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height);
    this.perspective.aspect = width / height;
    this.perspective.updateProjectionMatrix();
    const reach = 1.1 * this.radius;
    const across = width / height;
    const [w, t] = across > 1 ? [reach * across, reach] : [reach, reach / across];
    Object.assign(this.above, { left: -w, right: w, top: t, bottom: -t });
    this.above.updateProjectionMatrix();
    this.invalidate();
  }

  // drawing

  invalidate(): void {
    if (this.asked) return;
    this.asked = requestAnimationFrame(() => {
      this.asked = 0;
      this.draw();
    });
  }

  /** Something moves: fewer points until it rests. */
  private stir(): void {
    clearTimeout(this.moving);
    this.moving = setTimeout(() => {
      this.moving = 0;
      this.invalidate();
    }, REST_MS) as unknown as number;
    this.invalidate();
  }

  private draw(): void {
    const began = performance.now();
    if (this.points && this.cloud) this.points.geometry.setDrawRange(0, this.moving ? Math.min(MOVING_POINTS, this.cloud.count) : this.cloud.count);
    const most = this.moving ? EDGES.moving : EDGES.rest;
    for (const { edges, vertices } of this.edges) edges.geometry.setDrawRange(0, most * vertices);
    const paths = this.layers.get("trails");
    if (paths) paths.visible = !this.hidden.has("trails") && !(this.moving && this.scene.keyframes.length > EDGES.rest);
    this.renderer.render(this.world, this.camera);
    this.drawLabels();
    this.frames.push(performance.now() - began);
    if (this.frames.length > 200) this.frames.shift();
  }

  private drawLabels(): void {
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
    const shown = this.hidden.has("landmarks") ? [] : this.labelled.filter((label) => !chosen.has(label.id));
    const first = this.labelled.filter((label) => chosen.has(label.id)).map((label) => ({ ...label, weight: 1e6 }));
    this.labels.draw([...first, ...shown.slice(0, MOST_LABELLED)], project, width, height);
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
    canvas.addEventListener("pointerdown", (event) => (down = { x: event.offsetX, y: event.offsetY }));
    canvas.addEventListener("pointerup", (event) => {
      if (!down || Math.hypot(event.offsetX - down.x, event.offsetY - down.y) > 4) return;
      this.options.picked(this.pick(event.offsetX, event.offsetY, event.pointerType === "touch" ? 20 : 11));
    });
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons === 0) canvas.style.cursor = this.pick(event.offsetX, event.offsetY, 9) ? "pointer" : "";
    });
  }

  /** What is at a place of the picture: the nearest keyframe within `reach` pixels, or the thing that is hit first. */
  pick(x: number, y: number, reach: number): Picked {
    const { clientWidth: width, clientHeight: height } = this.element;
    const spot = new V3();
    let best: Picked = null;
    let least = reach;
    if (!this.hidden.has("cameras"))
      for (const item of this.scene.keyframes) {
        spot.set(...item.position).project(this.camera);
        if (spot.z > 1 || spot.z < -1) continue;
        const off = Math.hypot(((spot.x + 1) / 2) * width - x, ((1 - spot.y) / 2) * height - y);
        if (off < least) [least, best] = [off, { kind: "keyframe", id: item.id }];
      }
    if (best || this.hidden.has("landmarks")) return best;
    const near = new V3((2 * x) / width - 1, 1 - (2 * y) / height, -1).unproject(this.camera);
    const far = new V3((2 * x) / width - 1, 1 - (2 * y) / height, 1).unproject(this.camera);
    const from: Vector3 = [near.x, near.y, near.z];
    const along: Vector3 = [far.x - near.x, far.y - near.y, far.z - near.z];
    let smallest = Infinity;
    for (const item of this.scene.landmarks) {
      if (!present(item) || hitBox(from, along, item) === null) continue;
      const volume = Math.hypot(...item.size); // a cup on a table is meant, not the table
      if (volume < smallest) [smallest, best] = [volume, { kind: "landmark", id: item.id }];
    }
    return best;
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

/** How much a thing is worth to be named: sure and large ones first. */
function weight(item: LandmarkItem): number {
  return item.probability * (1 + Math.cbrt(item.size[0] * item.size[1] * item.size[2]));
}

/** The same in an order of which every beginning is spread over all. */
function scattered<T>(items: readonly T[]): T[] {
  const step = 7919; // a prime
  return items.length % step === 0 ? [...items] : items.map((_, i) => items[(i * step) % items.length] as T);
}

/** Whether pictures are drawn by the processor, as in machines without a graphics card. */
function isSoftware(): boolean {
  const gl = document.createElement("canvas").getContext("webgl2");
  const about = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = gl && about ? String(gl.getParameter(about.UNMASKED_RENDERER_WEBGL)) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

export function present(item: LandmarkItem): boolean {
  return item.state !== "gone";
}

function onTop(object: LineSegments): void {
  object.renderOrder = 10;
  (object.material as LineBasicMaterial).depthTest = false;
}

function release(object: Object3D): void {
  const { geometry, material } = object as Object3D & { geometry?: BufferGeometry; material?: Material | Material[] };
  geometry?.dispose();
  for (const one of [material ?? []].flat()) one.dispose();
}
