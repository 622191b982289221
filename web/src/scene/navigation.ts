// Where a map is looked at from: two cameras, the hand that moves them, flights.
import { OrthographicCamera, PerspectiveCamera, Vector3 as V3 } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { type KeyframeItem, type LandmarkItem, type MapScene, dot, plus, scaled, unit } from "../model";
import type { Vector3 } from "../types";
import type { Extent } from "./extent";

export type Mode = "3d" | "top";

/** Where the view is: what it turns about, angles in radians, metres. */
export interface ViewState {
  target: Vector3;
  position: Vector3;
  zoom: number;
}

export interface NavigationOptions {
  /** Something moves. */
  stirred: () => void;
  /** It came to rest, by a hand or after a flight. */
  moved: () => void;
}

const FLIGHT_MS = 650;

export class Navigation {
  mode: Mode = "3d";
  private readonly perspective = new PerspectiveCamera(55, 1, 0.02, 500);
  private readonly above = new OrthographicCamera(-1, 1, 1, -1, -500, 500);
  private controls: OrbitControls;
  private flight = 0;

  constructor(
    private readonly scene: MapScene,
    private readonly canvas: HTMLCanvasElement,
    public extent: Extent,
    private readonly options: NavigationOptions,
  ) {
    for (const camera of [this.perspective, this.above]) camera.up.set(...scene.up);
    this.controls = this.control(this.perspective);
  }

  dispose(): void {
    cancelAnimationFrame(this.flight);
    this.controls.dispose();
  }

  get camera(): PerspectiveCamera | OrthographicCamera {
    return this.mode === "top" ? this.above : this.perspective;
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

  setMode(mode: Mode): void {
    if (mode === this.mode) return;
    this.mode = mode;
    this.controls.dispose();
    this.controls = this.control(this.camera);
    this.home(false);
  }

  private control(camera: PerspectiveCamera | OrthographicCamera): OrbitControls {
    const controls = new OrbitControls(camera, this.canvas);
    controls.zoomToCursor = true;
    controls.screenSpacePanning = true;
    controls.minDistance = 0.05;
    controls.maxDistance = 20 * this.extent.radius;
    controls.enableRotate = this.mode === "3d";
    if (this.mode === "top") {
      controls.mouseButtons.LEFT = 2; // to move, since there is nothing to turn
      controls.touches.ONE = 1;
    }
    controls.listenToKeyEvents(this.canvas); // arrows move, with Ctrl, Shift or Meta they turn
    controls.addEventListener("change", () => this.options.stirred());
    controls.addEventListener("start", () => cancelAnimationFrame(this.flight));
    controls.addEventListener("end", () => this.options.moved());
    return controls;
  }

  /** All of the map in sight. */
  home(animated = true): void {
    const { up } = this.scene;
    const { centre, radius } = this.extent;
    if (this.mode === "top") {
      this.above.zoom = 1;
      this.flyTo(plus(centre, scaled(up, 50)), centre, animated);
    } else this.flyTo(plus(centre, scaled(unit(plus(this.sideways(), scaled(up, 0.75))), 1.8 * radius)), centre, animated);
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

  toLandmark(item: LandmarkItem): void {
    if (this.mode === "top") return this.toAbove(item.position);
    const reach = Math.max(...item.size, 0.25);
    const from = unit(plus(plus(this.state.position, scaled(item.position, -1)), scaled(this.scene.up, 0.2 * this.extent.radius)));
    this.flyTo(plus(item.position, scaled(from, Math.max(1.5, 3.4 * reach))), item.position);
  }

  /** Behind a camera, looking where it looks. */
  toCamera(item: Pick<KeyframeItem, "position" | "axes">): void {
    if (this.mode === "top") return this.toAbove(item.position);
    const back = plus(plus(item.position, scaled(item.axes[2], -0.8)), scaled(this.scene.up, 0.3));
    this.flyTo(back, plus(item.position, scaled(item.axes[2], 1.2)));
  }

  /** Comes nearer to what it turns about, by a factor of the distance. */
  nearer(factor: number): void {
    const { target, position } = this.state;
    this.above.zoom /= factor;
    this.above.updateProjectionMatrix();
    this.flyTo(this.mode === "top" ? position : plus(target, scaled(plus(position, scaled(target, -1)), factor)), target, false);
  }

  private toAbove(place: Vector3): void {
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
      const share = still ? 1 : Math.min(1, (now - began) / FLIGHT_MS);
      const eased = share < 0.5 ? 2 * share * share : 1 - 2 * (1 - share) * (1 - share);
      controls.object.position.lerpVectors(from.position, to.position, eased);
      controls.target.lerpVectors(from.target, to.target, eased);
      controls.update();
      this.options.stirred();
      if (share < 1) this.flight = requestAnimationFrame(step);
      else if (animated) this.options.moved();
    };
    step(still ? began : performance.now());
  }

  fit(width: number, height: number): void {
    this.perspective.aspect = width / height;
    this.perspective.updateProjectionMatrix();
    const reach = 1.1 * this.extent.radius;
    const across = width / height;
    const [w, t] = across > 1 ? [reach * across, reach] : [reach, reach / across];
    Object.assign(this.above, { left: -w, right: w, top: t, bottom: -t });
    this.above.updateProjectionMatrix();
  }
}
